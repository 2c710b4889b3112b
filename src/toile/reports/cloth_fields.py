"""Quantities that every vertex of the cloth has in every frame: errors and forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from toile.geometry.camera import Camera
from toile.reports.palette import ERROR_SCALE, FORCE_SCALE
from toile.scenes.scene import GroundTruth

TURBULENCE = "turbulence [m/s²]"
"""Name under which a fit saves the force per vertex and frame, (F - 1, H, W, 3)."""
SMOOTHING = 5
"""Side of the square of pixels [px] over which an image difference at a vertex is averaged."""


@dataclass(frozen=True)
class ClothField:
    """One number per vertex and frame.

    Attributes:
        key: short name, unique on a page.
        title: what a figure calls it.
        unit: unit of the values.
        note: what it is, in a sentence or two.
        values: (F, H, W); NaN where there is none.
        scale: colours from zero upwards.
    """

    key: str
    title: str
    unit: str
    note: str
    values: npt.NDArray[np.float64]
    scale: tuple[tuple[float, str], ...] = ERROR_SCALE

    @property
    def limit(self) -> float:
        """Value of the strongest colour: the 99th percentile, so that single vertices hide nothing."""
        finite = self.values[np.isfinite(self.values)]
        return max(float(np.percentile(finite, 99)), 1e-12) if finite.size else 1.0


def distance_to_points(
    positions: npt.NDArray[np.floating], ground_truth: Sequence[npt.NDArray[np.floating]]
) -> npt.NDArray[np.float64]:
    """Distance of every vertex to the nearest ground-truth point of its frame, (F, H, W) [m]."""
    found = [
        cKDTree(np.asarray(cloud, dtype=np.float64))
        .query(x.reshape(-1, 3), workers=1)[0]
        .reshape(x.shape[:2])
        for x, cloud in zip(positions, ground_truth, strict=False)
    ]
    return np.stack(found)


def error_field(positions: npt.NDArray[np.floating], truth: GroundTruth | None) -> ClothField | None:
    """Distance of every vertex to the truth [mm], as directly as the ground truth allows; None without it.

    Args:
        positions: trajectory (F, H, W, 3) [m].
        truth: may have more frames than the trajectory.
    """
    n = len(positions)
    if truth is None:
        return None
    if truth.vertices is not None and truth.vertices[:n].shape == positions.shape:
        distance = np.linalg.norm(positions - truth.vertices[:n].double().numpy(), axis=-1)
        note = "Distance of each vertex to its true position; no alignment."
    elif truth.point_clouds is not None and len(truth.point_clouds) >= n:
        distance = distance_to_points(positions, [c.numpy() for c in truth.point_clouds[:n]])
        note = (
            "Distance of each vertex to the nearest ground-truth point of its frame; no alignment. It "
            "holds the spacing and the noise of the points, and is large where the scanner saw nothing."
        )
    else:
        return None
    return ClothField("error", "Error", "mm", note, 1e3 * distance)


def colour_residual(
    observed: Tensor,
    mask: Tensor,
    rendered: Tensor,
    positions: Tensor,
    visible: Tensor,
    camera: Camera,
) -> npt.NDArray[np.float64]:
    """Colour difference of image and reconstruction where the vertices of one frame are seen.

    Args:
        observed: RGB frame (h, w, 3) in [0, 1].
        mask: observed mask (h, w) in [0, 1].
        rendered: rendered RGB image (h, w, 3) in [0, 1], black where there is no cloth.
        positions: (H, W, 3) [m], camera frame.
        visible: (H, W), bool; the others have no value.
        camera: of the frame.

    Returns:
        Mean absolute difference of the channels, averaged over a few pixels, (H, W) in [0, 1]; NaN if hidden.
    """
    difference = (observed * mask[..., None] - rendered).abs().mean(-1)[None, None]
    smooth = torch.nn.functional.avg_pool2d(difference, SMOOTHING, 1, SMOOTHING // 2)[0, 0]
    column, row = camera.project(positions).floor().unbind(-1)
    found = smooth[
        row.nan_to_num().clamp(0, camera.height - 1).long(),
        column.nan_to_num().clamp(0, camera.width - 1).long(),
    ]
    return torch.where(visible, found, torch.nan).double().numpy()


def residual_field(values: npt.NDArray[np.float64]) -> ClothField:
    """Image residuals (F, H, W) in [0, 1] as a field; stands in for the error where there is no truth."""
    note = (
        "Mean colour difference between the video and the rendered reconstruction at each vertex, "
        f"over {SMOOTHING} × {SMOOTHING} pixels, in percent of the range of colours. "
        "Empty where a vertex is hidden."
    )
    return ClothField("residual", "Image residual", "%", note, 100 * values)


def force_field(parameters: Mapping[str, npt.NDArray[Any]], n_frames: int) -> ClothField | None:
    """Strength of the turbulence [m/s²] of a saved run, or None where it has none."""
    turbulence = parameters.get(TURBULENCE)
    if turbulence is None or turbulence.ndim != 4 or turbulence.shape[-1] != 3 or not turbulence.any():
        return None
    strength = np.linalg.norm(np.asarray(turbulence, dtype=np.float64), axis=-1)[:n_frames]
    # An entry acts between its frame and the next one, so the last frame has none.
    missing = np.full((n_frames - len(strength), *strength.shape[1:]), np.nan)
    note = (
        "Strength of the fitted force on each vertex, beside gravity and steady wind, divided by the mass of "
        "an interior vertex. The entry of a frame acts until the next frame; the last one has none."
    )
    return ClothField(
        "force", "Turbulence", "m/s²", note, np.concatenate((strength, missing)), scale=FORCE_SCALE
    )


@dataclass(frozen=True)
class Upright:
    """Turns grid arrays the way the cloth lies in the image, so that a map is read like the video.

    Attributes:
        transposed: the grid's first axis runs across the image.
        flipped: whether rows and columns then run upwards and leftwards.
    """

    transposed: bool
    flipped: tuple[bool, bool]

    @staticmethod
    def of(positions: npt.NDArray[np.floating]) -> Upright:
        """How to turn a grid with these positions (H, W, 3) [m], camera frame."""
        along_i = (positions[-1] - positions[0]).mean(axis=0)[:2]
        along_j = (positions[:, -1] - positions[:, 0]).mean(axis=0)[:2]
        transposed = abs(along_i[0]) * abs(along_j[1]) > abs(along_i[1]) * abs(along_j[0])
        down, right = (along_j, along_i) if transposed else (along_i, along_j)
        return Upright(bool(transposed), (bool(down[1] < 0), bool(right[0] < 0)))

    def __call__(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """(..., H, W) to (..., rows from top to bottom, columns from left to right)."""
        turned = np.swapaxes(values, -1, -2) if self.transposed else values
        steps = tuple(slice(None, None, -1) if flip else slice(None) for flip in self.flipped)
        return np.ascontiguousarray(turned[(..., *steps)])
