"""Image term on a dense set of template points: what a point looked like in frame 0, it should look like later.

A point's position is a fixed mix of four vertices, its projection samples the features of the frame, and the
difference to its features in the first frame is a robust residual. The last feature channel is the blurred
mask: points on the cloth's border must stay on the border of the mask, all others inside it.

The term is a sum of squares up to its robust weights, so it offers what Gauss-Newton needs: per point a 3×3
matrix and a vector, applied without ever forming a Jacobian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from toile.geometry.camera import Camera

wp.config.quiet = True

Array = NDArray[np.float64]

# Below this blurred mask value a point has left the cloth: its colour says nothing, the mask pulls it back.
_INSIDE = 0.3
# Mask residuals above this are treated as outliers (holes and frayed edges of real masks).
_MASK_SCALE = 0.15


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


def grid_points(grid: tuple[int, int], per_side: int) -> TexturePoints:
    """A per_side × per_side lattice of points on an H×W vertex grid, borders included."""
    height, width = grid
    a, b = np.meshgrid(np.linspace(0, height - 1, per_side), np.linspace(0, width - 1, per_side), indexing="ij")
    a, b = a.ravel(), b.ravel()
    i = np.minimum(a.astype(np.int64), height - 2)
    j = np.minimum(b.astype(np.int64), width - 2)
    s, t = a - i, b - j
    corner = i * width + j
    vertices = np.stack((corner, corner + 1, corner + width, corner + width + 1), 1).astype(np.int32)
    weights = np.stack(((1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t), 1)
    border = (a == 0) | (a == height - 1) | (b == 0) | (b == width - 1)
    return TexturePoints(vertices, weights, border)


@wp.func
def _texel(features: wp.array(dtype=wp.vec4, ndim=3), frame: wp.int32, row: wp.int32, column: wp.int32):
    r = wp.clamp(row, 0, features.shape[1] - 1)
    c = wp.clamp(column, 0, features.shape[2] - 1)
    return features[frame, r, c]


@wp.func
def _bilinear(features: wp.array(dtype=wp.vec4, ndim=3), frame: wp.int32, x: wp.float32, y: wp.float32):
    column = wp.int32(wp.floor(x - 0.5))
    row = wp.int32(wp.floor(y - 0.5))
    fx = x - 0.5 - wp.float32(column)
    fy = y - 0.5 - wp.float32(row)
    top = _texel(features, frame, row, column) * (1.0 - fx) + _texel(features, frame, row, column + 1) * fx
    bottom = _texel(features, frame, row + 1, column) * (1.0 - fx) + _texel(features, frame, row + 1, column + 1) * fx
    return top * (1.0 - fy) + bottom * fy


@wp.kernel(enable_backward=False)
def _sample(
    features: wp.array(dtype=wp.vec4, ndim=3),
    pixels: wp.array(dtype=wp.vec2),
    out: wp.array(dtype=wp.vec4),
):
    p = wp.tid()
    out[p] = _bilinear(features, 0, pixels[p][0], pixels[p][1])


@wp.kernel(enable_backward=False)
def _point_term(
    x: wp.array(dtype=wp.vec3d, ndim=2),
    vertices: wp.array(dtype=wp.int32, ndim=2),
    weights: wp.array(dtype=wp.float64, ndim=2),
    border: wp.array(dtype=wp.int32),
    reference: wp.array(dtype=wp.vec4),
    visible: wp.array(dtype=wp.float32, ndim=2),
    features: wp.array(dtype=wp.vec4, ndim=3),
    first_frame: wp.int32,
    intrinsics: wp.vec4d,
    colour_weight: wp.float64,
    border_weight: wp.float64,
    inner_weight: wp.float64,
    colour_scale: wp.float64,
    mask_scale: wp.float64,
    inside_threshold: wp.float32,
    derivatives: wp.int32,
    cost: wp.array(dtype=wp.vec2d),
    gradient: wp.array(dtype=wp.vec3d, ndim=2),
    matrix: wp.array(dtype=wp.mat33d, ndim=2),
):
    f, p = wp.tid()
    seen = wp.float64(visible[f, p])
    point = wp.vec3d()
    for c in range(4):
        point += weights[p, c] * x[f, vertices[p, c]]
    z = point[2]
    matrix[f, p] = wp.mat33d()
    if z <= wp.float64(1.0e-3) or seen == wp.float64(0.0):
        return
    px = wp.float32(intrinsics[0] * point[0] / z + intrinsics[2])
    py = wp.float32(intrinsics[1] * point[1] / z + intrinsics[3])
    frame = first_frame + f
    value = _bilinear(features, frame, px, py)
    target = reference[p]
    r = wp.vec3d()
    for c in range(3):
        r[c] = wp.float64(value[c] - target[c])
    colour = wp.float64(0.0)
    if value[3] > inside_threshold and target[3] > 0.5:
        colour = colour_weight * seen
    # Pseudo-Huber: δ² (√(1 + |r|²/δ²) - 1), as a multiple of δ².
    norm = wp.sqrt(wp.dot(r, r) + colour_scale * colour_scale)
    energy = colour * (norm - colour_scale) / colour_scale
    wc = colour / (norm * colour_scale)
    m = wp.float64(value[3] - target[3])
    weight = border_weight
    if border[p] == 0:
        m = wp.min(m, wp.float64(0.0))
        weight = inner_weight
    m_norm = wp.sqrt(m * m + mask_scale * mask_scale)
    mask_energy = seen * weight * (m_norm - mask_scale) / mask_scale
    wm = seen * weight / (m_norm * mask_scale)
    wp.atomic_add(cost, f, wp.vec2d(energy, mask_energy))
    if derivatives == 0:
        return
    gx = 0.5 * (_bilinear(features, frame, px + 1.0, py) - _bilinear(features, frame, px - 1.0, py))
    gy = 0.5 * (_bilinear(features, frame, px, py + 1.0) - _bilinear(features, frame, px, py - 1.0))
    a = wp.float64(0.0)
    b = wp.float64(0.0)
    d = wp.float64(0.0)
    g0 = wp.float64(0.0)
    g1 = wp.float64(0.0)
    for c in range(3):
        u = wp.float64(gx[c])
        v = wp.float64(gy[c])
        a += wc * u * u
        b += wc * u * v
        d += wc * v * v
        g0 += wc * u * r[c]
        g1 += wc * v * r[c]
    mu = wp.float64(gx[3])
    mv = wp.float64(gy[3])
    a += wm * mu * mu
    b += wm * mu * mv
    d += wm * mv * mv
    g0 += wm * mu * m
    g1 += wm * mv * m
    jx = wp.vec3d(intrinsics[0] / z, wp.float64(0.0), -intrinsics[0] * point[0] / (z * z))
    jy = wp.vec3d(wp.float64(0.0), intrinsics[1] / z, -intrinsics[1] * point[1] / (z * z))
    g = g0 * jx + g1 * jy
    for c in range(4):
        wp.atomic_add(gradient, f, vertices[p, c], weights[p, c] * g)
    cross = wp.outer(jx, jy)
    matrix[f, p] = a * wp.outer(jx, jx) + b * (cross + wp.transpose(cross)) + d * wp.outer(jy, jy)


@wp.kernel(enable_backward=False)
def _apply(
    change: wp.array(dtype=wp.vec3d, ndim=2),
    vertices: wp.array(dtype=wp.int32, ndim=2),
    weights: wp.array(dtype=wp.float64, ndim=2),
    matrix: wp.array(dtype=wp.mat33d, ndim=2),
    out: wp.array(dtype=wp.vec3d, ndim=2),
):
    f, p = wp.tid()
    moved = wp.vec3d()
    for c in range(4):
        moved += weights[p, c] * change[f, vertices[p, c]]
    force = matrix[f, p] * moved
    for c in range(4):
        wp.atomic_add(out, f, vertices[p, c], weights[p, c] * force)


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
    """

    per_side: int
    blur: float
    neighbourhood: float | None
    colour_weight: float
    mask_weight: float
    colour_scale: float = 0.1


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
        camera: of the frames.
        points: where on the template.
        template: (N, 3) vertex positions in frame 0 [m]; the reference is sampled at their projection.
        settings: see PointTermSettings.
    """

    def __init__(
        self, features: Tensor, camera: Camera, points: TexturePoints, template: Array, settings: PointTermSettings
    ) -> None:
        self.points = points
        self.settings = settings
        self.n_points = len(points.vertices)
        self._features_memory = features.contiguous()
        self._features = wp.from_torch(self._features_memory, dtype=wp.vec4)
        self._vertices = wp.array(points.vertices, dtype=wp.int32, ndim=2, device="cpu")
        self._weights = wp.array(points.weights, dtype=wp.float64, ndim=2, device="cpu")
        self._border = wp.array(points.border.astype(np.int32), dtype=wp.int32, device="cpu")
        self._intrinsics = wp.vec4d(camera.fx, camera.fy, camera.cx, camera.cy)
        pixels = camera.project(torch.from_numpy(points.positions(template))).to(torch.float32).numpy()
        self._reference = wp.zeros(self.n_points, dtype=wp.vec4, device="cpu")
        pixel_array = wp.array(np.ascontiguousarray(pixels), dtype=wp.vec2, device="cpu")
        wp.launch(_sample, dim=self.n_points, inputs=[self._features, pixel_array, self._reference], device="cpu")

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
            _view(np.ascontiguousarray(x), wp.vec3d, 2),
            self._vertices,
            self._weights,
            self._border,
            self._reference,
            _view(np.ascontiguousarray(visible, np.float32), wp.float32, 2),
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
            _view(cost, wp.vec2d, 1),
            _view(gradient, wp.vec3d, 2),
            _view(matrices, wp.mat33d, 2),
        ]
        wp.launch(_point_term, dim=(n, self.n_points), inputs=inputs, device="cpu")
        return PointTermValue(cost[:, 0], cost[:, 1], gradient, matrices)

    def apply(self, value: PointTermValue, change: Array) -> Array:
        """Gauss-Newton Hessian times a change of the vertices (n, N, 3)."""
        out = np.zeros_like(change)
        inputs = [
            _view(np.ascontiguousarray(change), wp.vec3d, 2),
            self._vertices,
            self._weights,
            _view(value.matrices, wp.mat33d, 2),
            _view(out, wp.vec3d, 2),
        ]
        wp.launch(_apply, dim=(len(change), self.n_points), inputs=inputs, device="cpu")
        return out


# The inner points together weigh this much against the border points.
_INNER_SHARE = 4.0


def _view(a: NDArray[np.generic], dtype: type, ndim: int) -> wp.array:
    view = wp.array(ptr=a.ctypes.data, dtype=dtype, shape=a.shape[:ndim], device="cpu")
    view._owner = a  # keeps the memory alive as long as the view
    return view
