"""The points that a reconstruction is compared with: scanned, or drawn from the true mesh."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from toile.geometry.mesh import grid_faces, sample_surface
from toile.scenes.scene import GroundTruth

TRUE_MESH_SAMPLES = 20_000
"""Points drawn from a true mesh where a scene has true vertices but no point clouds."""
TRUE_MESH_SEED_OFFSET = 1_000_000
"""Keeps the samples of the true mesh independent of those of the reconstruction."""
TRUE_MESH_NOTE = (
    f"; the ground-truth points are {TRUE_MESH_SAMPLES} area-weighted samples of the true mesh per frame, "
    f"sampling seed = seed + {TRUE_MESH_SEED_OFFSET} + frame"
)
"""What a protocol says where the points were drawn."""


def known_frames(truth: GroundTruth | None) -> int:
    """Number of frames, from the first on, of which there are target points."""
    if truth is None:
        return 0
    known = truth.vertices if truth.point_clouds is None else truth.point_clouds
    return 0 if known is None else len(known)


def target_points(
    truth: GroundTruth | None, frames: Iterable[int], seed: int
) -> tuple[tuple[Tensor, ...] | None, str]:
    """Ground-truth points of some frames, drawn from the true mesh where there are no point clouds.

    Args:
        truth: of the scene.
        frames: which frames; each must be in the ground truth.
        seed: of the drawing, which has a generator of its own.

    Returns:
        Points (n, 3) [m] of every frame, or None where nothing is known; and what a protocol adds about them.
    """
    if truth is None:
        return None, ""
    if truth.point_clouds is not None:
        return tuple(truth.point_clouds[f] for f in frames), ""
    if truth.vertices is None:
        return None, ""
    vertices = truth.vertices.detach().cpu().double()
    faces = grid_faces(vertices.shape[1], vertices.shape[2])
    drawn = tuple(
        sample_surface(
            vertices[f].reshape(-1, 3),
            faces,
            TRUE_MESH_SAMPLES,
            torch.Generator().manual_seed(seed + TRUE_MESH_SEED_OFFSET + f),
        )
        for f in frames
    )
    return drawn, TRUE_MESH_NOTE
