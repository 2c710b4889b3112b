"""Absolute depth error along the viewing ray, the error a single camera is weakest in."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toile.geometry.camera import Camera

DEPTH_PROTOCOL = (
    "mean absolute difference between the z of a ground-truth point and the rendered depth of the "
    "reconstruction at the pixel that point falls into, mm; points whose pixel the reconstruction does not "
    "cover are left out (their share is reported as depth coverage); mean over all frames"
)
DEPTH_MAP_PROTOCOL = (
    "mean absolute difference between the rendered depths of the reconstruction and of the true mesh, mm, "
    "over the pixels that both cover (their share of the pixels of the true mesh is reported as depth "
    "coverage); mean over all frames"
)
DEPTH_MAP_COVERAGE_PROTOCOL = "share of the pixels of the true mesh that the reconstruction covers too, %"
DEPTH_COVERAGE_PROTOCOL = (
    "share of the ground-truth points inside the image whose pixel is covered by the reconstruction, %"
)


@dataclass(frozen=True)
class DepthError:
    """Depth error of one frame.

    Attributes:
        mean: mean absolute depth error [m]; NaN where no point falls on the reconstruction.
        coverage: share in [0, 1] of the points inside the image (or of the pixels of the true mesh) that
            fall on the reconstruction; NaN where there is none.
    """

    mean: float
    coverage: float


def depth_map_error(
    depth: Tensor, silhouette: Tensor, true_depth: Tensor, true_silhouette: Tensor
) -> DepthError:
    """Compare two rendered depth maps at the pixels that both surfaces cover.

    Args:
        depth: rendered z of the reconstruction (h, w) [m].
        silhouette: rendered coverage of the reconstruction (h, w) in [0, 1].
        true_depth: rendered z of the true mesh (h, w) [m].
        true_silhouette: rendered coverage of the true mesh (h, w) in [0, 1].
    """
    covered, true_covered = _covered(depth, silhouette), _covered(true_depth, true_silhouette)
    n_true = int(true_covered.sum())
    if n_true == 0:
        return DepthError(mean=float("nan"), coverage=float("nan"))
    both = covered & true_covered
    difference = (depth - true_depth).detach().double().abs()[both]
    mean = float(difference.mean()) if bool(both.any()) else float("nan")
    return DepthError(mean=mean, coverage=int(both.sum()) / n_true)


def depth_error(points: Tensor, depth: Tensor, silhouette: Tensor, camera: Camera) -> DepthError:
    """Compare the z of ground-truth points with a rendered depth map at the pixels they project to.

    Pixel (row r, column c) covers x in [c, c + 1), y in [r, r + 1) (see ``Camera``). A pixel counts as
    covered where the silhouette exceeds ½ and the depth is positive, so neither anti-aliased borders nor
    the background value of the renderer enter the mean.

    Args:
        points: ground-truth points (n, 3) [m], camera frame, in front of the camera.
        depth: rendered z of the reconstruction (h, w) [m].
        silhouette: rendered coverage (h, w) in [0, 1].
        camera: camera of the rendered image.
    """
    points = points.detach().cpu().double()
    depth, silhouette = depth.detach().cpu().double(), silhouette.detach().cpu()
    points = points[points[:, 2] > 0]
    pixel = camera.project(points).floor().long()
    column, row = pixel[:, 0], pixel[:, 1]
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    n_inside = int(inside.sum())
    if n_inside == 0:
        return DepthError(mean=float("nan"), coverage=float("nan"))
    row, column, z = row[inside], column[inside], points[inside, 2]
    rendered = depth[row, column]
    covered = _covered(rendered, silhouette[row, column])
    mean = float((rendered[covered] - z[covered]).abs().mean()) if bool(covered.any()) else float("nan")
    return DepthError(mean=mean, coverage=int(covered.sum()) / n_inside)


def _covered(depth: Tensor, silhouette: Tensor) -> Tensor:
    return (silhouette > 0.5) & (depth > 0) & torch.isfinite(depth)
