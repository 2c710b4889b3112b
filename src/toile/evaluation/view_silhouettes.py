"""Overlap of silhouettes with masks in several views: all of them, all but the input, the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from toile.errors import InputError
from toile.evaluation.silhouette import intersection_over_union
from toile.geometry.camera import Camera
from toile.rendering.base import Renderer

VIEWS_PROTOCOL = (
    "intersection over union of rendered silhouette > ½ and mask > ½ of body and garment together, mean over "
    "the frames; of all views, of all but the one that was reconstructed from, of that one (AMV, RV, SV of "
    "Li et al., 3DV 2021); with the translation as it was found"
)


@dataclass(frozen=True)
class ViewOverlap:
    """Intersection over union in C views.

    Attributes:
        values: (C, F), float64.
        input_view: number of the view that was reconstructed from.
    """

    values: Tensor
    input_view: int

    @property
    def all_views(self) -> float:
        """Mean over all views."""
        return float(self.values.mean())

    @property
    def reference_views(self) -> float:
        """Mean over all views but the input; NaN where there is no other."""
        others = [k for k in range(len(self.values)) if k != self.input_view]
        return float(self.values[others].mean()) if others else float("nan")

    @property
    def single_view(self) -> float:
        """Mean over the input view."""
        return float(self.values[self.input_view].mean())


def silhouettes(renderer: Renderer, camera: Camera, positions: Tensor, faces: Tensor) -> Tensor:
    """Silhouette of a moving mesh in one view.

    Args:
        renderer: any renderer.
        camera: with its pose.
        positions: (F, V, 3) [m].
        faces: (T, 3).

    Returns:
        (F, h, w) in [0, 1], antialiased.
    """
    uv = positions.new_zeros(positions.shape[1], 2, dtype=torch.float32)
    texture = torch.ones(1, 1, 3)
    return renderer.render(positions, faces, uv, texture, camera).silhouette


def overlap_in_views(
    renderer: Renderer,
    cameras: Sequence[Camera],
    masks: Tensor | Sequence[Tensor],
    positions: Tensor,
    faces: Tensor,
    *,
    input_view: int = 0,
) -> ViewOverlap:
    """Overlap of a moving mesh, body and garment as one, with the masks of every view.

    Args:
        renderer: any renderer.
        cameras: C cameras with poses.
        masks: per camera (F, h, w) in [0, 1].
        positions: (F, V, 3) [m].
        faces: (T, 3).
        input_view: the view that was reconstructed from.

    Raises:
        InputError: masks of another number or size, or no such view.
    """
    if len(masks) != len(cameras) or not 0 <= input_view < len(cameras):
        raise InputError(
            "Views do not fit together",
            where="masks, input_view",
            expected=f"masks of {len(cameras)} cameras, input_view from 0 to {len(cameras) - 1}",
            got=f"masks of {len(masks)}, input_view {input_view}",
        )
    found = [
        intersection_over_union(silhouettes(renderer, camera, positions, faces), mask)
        for camera, mask in zip(cameras, masks, strict=True)
    ]
    return ViewOverlap(torch.stack(found), input_view)
