"""Making and checking the template of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from toile.errors import InputError
from toile.geometry.mesh import face_normals, grid_faces
from toile.geometry.quadrilateral import CORNERS
from toile.geometry.surface import Floats
from toile.preparation.template_making.still import Still
from toile.preparation.template_making.surface import Layout, Surface, SurfaceGrid
from toile.scenes.findings import Finding, Severity, require
from toile.scenes.scene import Scene
from toile.scenes.texture_coordinates import project_coordinates
from toile.scenes.validation import (
    check_pinned_vertices,
    check_scene,
    check_template,
    silhouette_overlap,
)

_SMALLEST, _LARGEST = 0.02, 20.0  # [m], sides of a cloth
MOST_SHEAR = 40.0
"""Shear [degrees] of a cell above which the grid lies wrongly, or the cloth is not at rest.

The nine published templates of real cloths reach 39 (R7, at one corner), and at most one corner of a cell in
a hundred is above 17: what is sheared more is no cloth at rest.
"""
_CELL = ((0, 0), (1, 0), (1, 1), (0, 1))
"""Corners of a cell in the order of ``_shear``."""


@dataclass(frozen=True)
class MadeTemplate:
    """A template and what was measured on it.

    Attributes:
        scene: with frame 0 and mask 0 only; its template, texture and pinned vertices are what was made.
        n_frames: frames in the folder.
        times: of those frames [s]; None where they are evenly spaced.
        surface: the grid as it was laid, with distances to the input surface.
        edges: lengths (n,) [m] of the edges along axis 0 and along axis 1.
        shear: angles [degrees] by which the corners of the cells differ from a right angle.
        iou: intersection over union of the projected template with mask 0.
        warnings: what a fit will suffer from.
    """

    scene: Scene
    n_frames: int
    times: tuple[float, ...] | None
    surface: SurfaceGrid
    edges: tuple[Floats, Floats]
    shear: Floats
    iou: float
    warnings: tuple[Finding, ...]


def corner_vertices(grid: tuple[int, int]) -> dict[str, int]:
    """Flattened indices of the corners of a grid (H, W) by their names."""
    H, W = grid
    return dict(zip(CORNERS, (0, (H - 1) * W, H * W - 1, W - 1), strict=True))


def make_template(
    still: Still,
    surface: Surface,
    layout: Layout,
    *,
    name: str,
    pinned_vertices: Sequence[int] | None,
    gravity: Sequence[float],
    minimum_iou: float,
) -> MadeTemplate:
    """Lay a grid on a surface and check that it is the cloth of frame 0.

    Args:
        still: the first frame.
        surface: mesh, points or sheet.
        layout: the grid; without a cloth size that of the surface is taken.
        name: of the scene.
        pinned_vertices: flattened indices; None for the two upper corners in the image.
        gravity: [m/s²], camera frame.
        minimum_iou: of the projected template with mask 0.

    Raises:
        InputError: anything that would make the scene unusable.
    """
    _require_layout(layout)
    laid = surface.lay_grid(still, layout)
    positions = torch.from_numpy(np.ascontiguousarray(laid.positions, dtype=np.float64))
    edges = tuple(positions.diff(dim=axis).norm(dim=-1).flatten().numpy() for axis in (0, 1))
    measured = (float(edges[0].mean()) * (layout.grid[0] - 1), float(edges[1].mean()) * (layout.grid[1] - 1))
    cloth_size = measured if layout.cloth_size is None else layout.cloth_size
    corners = corner_vertices(layout.grid)
    upper = (corners["upper left"], corners["upper right"])
    pinned = upper if pinned_vertices is None else tuple(int(k) for k in pinned_vertices)
    require(check_pinned_vertices(pinned, layout.grid, "settings"))
    found = [
        *still.remarks,
        *check_template(positions.reshape(-1, 3), layout.grid, cloth_size, "surface"),
        *_check_size(measured),
    ]
    require(found)
    h, w = still.mask.shape
    scene = Scene(
        name=name,
        frames=still.frame[None],
        masks=still.mask[None],
        camera=still.camera,
        texture=still.frame,
        texture_coordinates=project_coordinates(positions, still.camera),
        template=positions,
        cloth_size=cloth_size,
        gravity=torch.tensor(list(gravity), dtype=torch.float64),
        fps=still.fps,
        pinned_vertices=pinned,
        original_size=(h, w),
        source=still.folder,
    )
    found += require(check_scene(scene))
    iou, _ = silhouette_overlap(positions, still.camera, still.mask)
    found += require([*_check_overlap(iou, minimum_iou), *_check_facing(scene), *_check_border(still)])
    shear = _shear(laid.positions)
    found += _check_shear(shear)
    warnings = dict.fromkeys(f for f in found if f.severity is Severity.WARNING)
    return MadeTemplate(
        scene,
        still.n_frames,
        still.times,
        laid,
        (edges[0], edges[1]),
        shear.ravel(),
        iou,
        tuple(warnings),
    )


def _require_layout(layout: Layout) -> None:
    """Raise InputError for settings that no surface could make good."""
    if len(layout.grid) != 2 or min(layout.grid) < 2:
        raise InputError(
            "Grid is too small", where="grid", expected="[H, W], both at least 2", got=str(list(layout.grid))
        )
    size = layout.cloth_size
    if size is not None and (len(size) != 2 or not all(np.isfinite(side) and side > 0 for side in size)):
        raise InputError(
            "Cloth size is not positive",
            where="cloth_size",
            expected="two lengths > 0 [m]",
            got=str(list(size)),
        )
    corners = layout.corners
    if corners is not None and (corners.shape != (4, 2) or not np.isfinite(corners).all()):
        raise InputError(
            "Corners cannot be understood",
            where="corners",
            expected="[[x, y], ...] in px: upper left, upper right, lower right, lower left",
            got=str(corners.tolist()),
        )


def _check_size(measured: tuple[float, float]) -> list[Finding]:
    if all(_SMALLEST <= side <= _LARGEST for side in measured):
        return []
    return [
        Finding(
            Severity.ERROR,
            "Size of the surface is implausible",
            "surface",
            f"sides between {_SMALLEST:g} and {_LARGEST:g} m; axes.scale converts other units",
            f"{measured[0]:.4g} m x {measured[1]:.4g} m",
        )
    ]


def _check_overlap(iou: float, least: float) -> list[Finding]:
    if iou >= least:
        return []
    return [
        Finding(
            Severity.ERROR,
            "Template does not project onto mask 0",
            "surface, camera",
            f"intersection over union of at least {least:g} (minimum_iou)",
            f"{iou:.3f}",
        )
    ]


def _check_facing(scene: Scene) -> list[Finding]:
    """The grid's normals face the camera, as its corners run clockwise in the image."""
    faces = grid_faces(*scene.grid)
    flat = scene.template.reshape(-1, 3)
    normals = face_normals(flat, faces)
    away = float(((normals * flat[faces].mean(1)).sum(-1) > 0).double().mean())
    if away <= 0.01:
        return []
    return [
        Finding(
            Severity.ERROR if away > 0.5 else Severity.WARNING,
            "Template shows its back to the camera",
            "surface",
            "normals towards the camera; where cloth is folded over, the texture is not its own",
            f"{100 * away:.0f} % of the triangles face away",
        )
    ]


def _check_border(still: Still) -> list[Finding]:
    """The cloth is inside the image; otherwise its corners are those of the image."""
    mask = still.mask > 0.5
    cut = sum(int(line.sum()) for line in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    if cut <= 2:
        return []
    return [
        Finding(
            Severity.WARNING,
            "Cloth leaves the image in frame 0",
            "mask 0",
            "a cloth that is seen whole",
            f"{cut} pixels of the mask at the image border",
        )
    ]


def _check_shear(shear: Floats) -> list[Finding]:
    """Shear (4, H - 1, W - 1) [degrees] that a cloth at rest has."""
    most = float(np.abs(shear).max())
    if most <= MOST_SHEAR:
        return []
    corner, i, j = np.unravel_index(int(np.abs(shear).argmax()), shear.shape)
    down, along = _CELL[int(corner)]
    count = int((np.abs(shear).max(0) > MOST_SHEAR).sum())
    return [
        Finding(
            Severity.WARNING,
            "Template is sheared more than a cloth at rest",
            f"vertex [{int(i) + down}, {int(j) + along}]",
            f"at most {MOST_SHEAR:g}°; a corner in the wrong place (corners=...) shears the grid beside it, "
            "and a fit takes the template's angles for those of the cloth at rest",
            f"{most:.0f}° there, {count} cell{'s' if count > 1 else ''} above {MOST_SHEAR:g}°",
        )
    ]


def _shear(positions: Floats) -> Floats:
    """How far from a right angle the corners of every cell are [degrees], signed, (4, H - 1, W - 1)."""
    H, W = positions.shape[:2]
    cells = [positions[i : H - 1 + i, j : W - 1 + j] for i, j in _CELL]
    found = []
    for k in range(4):
        a, b = cells[k - 1] - cells[k], cells[(k + 1) % 4] - cells[k]
        cosine = (a * b).sum(-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))
        found.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))) - 90)
    return np.stack(found)
