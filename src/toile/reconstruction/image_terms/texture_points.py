"""Image term on a dense set of template points: each should look as it did in frame 0.

A point's position is a fixed mix of four vertices, its projection samples the features of the frame, and the
difference to its features in the first frame is a robust residual. The last feature channel is the blurred
mask: points on the cloth's border must stay on the border of the mask, all others inside it.

The term is a sum of squares up to its robust weights, so it offers what Gauss-Newton needs: per point a 3×3
matrix and a vector, applied without ever forming a Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from toile.geometry.camera import Camera
from toile.limits import NonNegative, Positive, TwoOrMore, Unit
from toile.reconstruction.image_terms.image_features import contrast_features
from toile.reconstruction.image_terms.reference_image import first_frame
from toile.reconstruction.image_terms.texture_point_kernels import apply_matrices, point_term, sample_features
from toile.reconstruction.problem import Reconstruction
from toile.rendering.visibility import visible_points
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]

# Below this blurred mask value a point has left the cloth: its colour says nothing, the mask pulls it back.
_INSIDE = 0.3
# Mask residuals above this are treated as outliers (holes and frayed edges of real masks).
_MASK_SCALE = 0.15
# Two surfaces closer than this are one: bilinear points leave the triangles by about this much [m].
_VISIBILITY_TOLERANCE = 4e-3
# Points lie anywhere in their lattice cell.
_JITTER = 1.0


@dataclass(frozen=True)
class TexturePoints:
    """Points on the template as mixtures of four vertices.

    Attributes:
        vertices: (P, 4) int32 vertex indices.
        weights: (P, 4) float64, each row sums to 1.
        border: (P,) bool, points on the cloth's border.
    """

    vertices: NDArray[np.int32]
    weights: Array
    border: NDArray[np.bool_]

    def positions(self, x: Array) -> Array:
        """Points (..., P, 3) for vertex positions x (..., N, 3)."""
        return np.asarray((x[..., self.vertices, :] * self.weights[..., None]).sum(-2))

    def triangle_coordinates(self, grid: tuple[int, int]) -> tuple[NDArray[np.int64], Array]:
        """Face index (P,) in ``grid_faces`` order and barycentric coordinates (P, 3) of every point."""
        width = grid[1]
        corner = self.vertices[:, 0]
        quad = (corner // width) * (width - 1) + corner % width
        s = self.weights[:, 2] + self.weights[:, 3]
        t = self.weights[:, 1] + self.weights[:, 3]
        upper = t >= s
        barycentrics = np.where(
            upper[:, None], np.stack((1 - t, t - s, s), 1), np.stack((1 - s, t, s - t), 1)
        )
        return (2 * quad + np.where(upper, 0, 1)).astype(np.int64), barycentrics


def grid_points(grid: tuple[int, int], per_side: int, jitter: float, seed: int) -> TexturePoints:
    """A per_side × per_side lattice of points on an H×W vertex grid, borders included.

    Args:
        grid: (H, W).
        per_side: points along each side.
        jitter: inner points move at random by up to this fraction of half a lattice cell, so that the lattice
            has no fixed phase against the weave of the texture; border points stay on their border.
        seed: of the jitter.
    """
    height, width = grid
    a = np.repeat(np.arange(per_side, dtype=np.float64), per_side)
    b = np.tile(np.arange(per_side, dtype=np.float64), per_side)
    move = jitter * (np.random.default_rng(seed).random((2, per_side**2)) - 0.5)
    last = per_side - 1
    a = np.where((a > 0) & (a < last), a + move[0], a) * ((height - 1) / last)
    b = np.where((b > 0) & (b < last), b + move[1], b) * ((width - 1) / last)
    i = np.minimum(a.astype(np.int64), height - 2)
    j = np.minimum(b.astype(np.int64), width - 2)
    s, t = a - i, b - j
    corner = i * width + j
    vertices = np.stack((corner, corner + 1, corner + width, corner + width + 1), 1).astype(np.int32)
    weights = np.stack(((1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t), 1)
    border = (a == 0) | (a == height - 1) | (b == 0) | (b == width - 1)
    return TexturePoints(vertices, weights, border)


def visible(reconstruction: Reconstruction, points: TexturePoints, positions: Array) -> NDArray[np.float32]:
    """Visible points (n, P) as 0 or 1 for frame positions (n, N, 3)."""
    x = torch.from_numpy(positions)
    camera = reconstruction.scene.camera
    fragments = reconstruction.renderer.rasterize(x, reconstruction.faces, camera)
    faces, barycentrics = points.triangle_coordinates(reconstruction.scene.grid)
    seen = visible_points(
        fragments,
        x,
        reconstruction.faces,
        camera,
        torch.from_numpy(faces),
        torch.from_numpy(barycentrics),
        _VISIBILITY_TOLERANCE,
    )
    return np.asarray(seen.numpy(), np.float32)


@dataclass(frozen=True)
class PointTermSettings:
    """Weights and scales of the term.

    Attributes:
        per_side: points along each side of the cloth.
        blur: σ of the pre-blur [px].
        neighbourhood: σ of the contrast normalisation [px], or None.
        colour_weight: weight of the colour residuals, whatever the number of points.
        mask_weight: weight of the mask residuals; 0 removes the silhouette.
        colour_scale: residual at which colours start to count as outliers.
        reference: the picture (h, w, 3) of frame 0 that the points take their colours from.
    """

    per_side: Annotated[TwoOrMore, Unit("points")]
    blur: Annotated[NonNegative, Unit("px")]
    neighbourhood: Annotated[Positive, Unit("px")] | None
    colour_weight: NonNegative
    mask_weight: NonNegative
    colour_scale: Positive = 0.1
    reference: Callable[[Reconstruction], Tensor] = first_frame


@dataclass(frozen=True)
class PointTermValue:
    """Value of the term on some frames.

    Attributes:
        colour: (n,) cost per frame.
        mask: (n,) cost per frame.
        gradient: (n, N, 3) with respect to the vertices [1/m].
        matrices: (n, P, 3, 3) Gauss-Newton matrix per point [1/m²].
    """

    colour: Array
    mask: Array
    gradient: Array
    matrices: Array

    @property
    def total(self) -> float:
        """Sum over frames."""
        return float(self.colour.sum() + self.mask.sum())


class TexturePointTerm:
    """The term of one scene at one scale.

    Args:
        features: (F, h, w, 4) from contrast_features.
        reference: (h, w, 4), those of the picture that gives the points their colours.
        camera: of the frames.
        points: where on the template.
        template: (N, 3) vertex positions in frame 0 [m]; the reference is sampled at their projection.
        settings: see PointTermSettings.
    """

    def __init__(
        self,
        features: Tensor,
        reference: Tensor,
        camera: Camera,
        points: TexturePoints,
        template: Array,
        settings: PointTermSettings,
    ) -> None:
        start_warp()
        self.points = points
        self.settings = settings
        self.n_points = len(points.vertices)
        self._features = view(features.contiguous().numpy(), wp.vec4)
        self._vertices = view(np.ascontiguousarray(points.vertices, np.int32), wp.int32)
        self._weights = view(np.ascontiguousarray(points.weights), wp.float64)
        self._border = view(points.border.astype(np.int32), wp.int32)
        self._intrinsics = wp.vec4d(camera.fx, camera.fy, camera.cx, camera.cy)
        pixels = camera.project(torch.from_numpy(points.positions(template))).to(torch.float32).numpy()
        self._reference = view(np.zeros((self.n_points, 4), np.float32), wp.vec4)
        picture = view(reference[None].contiguous().numpy(), wp.vec4)
        inputs = [picture, view(np.ascontiguousarray(pixels), wp.vec2), self._reference]
        wp.launch(sample_features, dim=self.n_points, inputs=inputs, device="cpu")

    @classmethod
    def of(cls, reconstruction: Reconstruction, settings: PointTermSettings, seed: int) -> TexturePointTerm:
        """The term of a problem's scene, its points at random places by the seed."""
        scene, scales = reconstruction.scene, (settings.blur, settings.neighbourhood)
        return cls(
            contrast_features(scene.frames, scene.masks, *scales),
            contrast_features(settings.reference(reconstruction)[None], scene.masks[:1], *scales)[0],
            scene.camera,
            grid_points(scene.grid, settings.per_side, _JITTER, seed),
            reconstruction.template.numpy(),
            settings,
        )

    def evaluate(
        self, x: Array, first_frame: int, visible: NDArray[np.float32] | None, *, derivatives: bool
    ) -> PointTermValue:
        """Evaluate on frames first_frame ... first_frame + n - 1.

        Args:
            x: vertex positions (n, N, 3) [m].
            first_frame: frame that x[0] belongs to.
            visible: (n, P) in [0, 1], or None for all.
            derivatives: also compute gradient and matrices.
        """
        n, n_vertices = x.shape[:2]
        cost = np.zeros((n, 2))
        gradient = np.zeros((n, n_vertices, 3))
        matrices = np.empty((n, self.n_points, 3, 3))
        if visible is None:
            visible = np.ones((n, self.n_points), np.float32)
        s = self.settings
        n_border = max(int(self.points.border.sum()), 1)
        inputs = [
            view(np.ascontiguousarray(x), wp.vec3d),
            self._vertices,
            self._weights,
            self._border,
            self._reference,
            view(np.ascontiguousarray(visible, np.float32), wp.float32),
            self._features,
            first_frame,
            self._intrinsics,
            s.colour_weight / self.n_points,
            s.mask_weight / n_border,
            s.mask_weight * _INNER_SHARE / self.n_points,
            s.colour_scale,
            _MASK_SCALE,
            _INSIDE,
            int(derivatives),
            view(cost, wp.vec2d),
            view(gradient, wp.vec3d),
            view(matrices, wp.mat33d),
        ]
        wp.launch(point_term, dim=(n, self.n_points), inputs=inputs, device="cpu")
        return PointTermValue(cost[:, 0], cost[:, 1], gradient, matrices)

    def apply(self, value: PointTermValue, change: Array) -> Array:
        """Gauss-Newton Hessian times a change of the vertices (n, N, 3)."""
        out = np.zeros_like(change)
        inputs = [
            view(np.ascontiguousarray(change), wp.vec3d),
            self._vertices,
            self._weights,
            view(value.matrices, wp.mat33d),
            view(out, wp.vec3d),
        ]
        wp.launch(apply_matrices, dim=(len(change), self.n_points), inputs=inputs, device="cpu")
        return out


# The inner points together weigh this much against the border points.
_INNER_SHARE = 4.0
