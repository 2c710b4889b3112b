"""Energy, gradient and Hessian of the internal energy over element stencils, as Warp kernels on the CPU.

The pure functions in ``toile.cloth.energies`` are the oracle; these kernels compute the same numbers (a test
compares them) and write the Hessian directly into LAPACK's lower band storage.

Both angle energies are functions of the cosine c of the angle between the edges u and v:

    ∂c/∂u   = (v̂ - c û) / |u|
    ∂²c/∂u² = (3 c ûûᵀ - v̂ûᵀ - ûv̂ᵀ - c I) / |u|²
    ∂²c/∂u∂v = (I - ûûᵀ)(I - v̂v̂ᵀ) / (|u| |v|)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.cloth.stencils import Stencils
from toile.simulators.implicit.banded import bandwidth_order

wp.config.quiet = True

Array = NDArray[np.float64]

# Below this sine an angle energy with a non-zero rest angle is treated as if at this sine: its true gradient
# has no direction at a complete fold.
_MIN_SINE = 1.0e-4


@wp.func
def _edge_terms(d: wp.vec3d, rest: wp.float64):
    length = wp.max(wp.length(d), wp.float64(1.0e-12))
    return length, d / length, length - rest


@wp.func
def _angle_terms(c: wp.float64, s: wp.float64, rest: wp.float64):
    """Value, first and second derivative with respect to c of ½ (θ - rest)², θ = atan2(s, c)."""
    theta = wp.atan2(s, c)
    if rest == wp.float64(0.0) and theta < wp.float64(0.02):
        t2 = theta * theta
        g1 = -(wp.float64(1.0) + t2 / wp.float64(6.0) + wp.float64(7.0 / 360.0) * t2 * t2)
        g2 = wp.float64(1.0 / 3.0) + wp.float64(2.0 / 15.0) * t2
        return wp.float64(0.5) * t2, g1, g2
    sine = wp.max(s, wp.float64(_MIN_SINE))
    g1 = -(theta - rest) / sine
    g2 = (wp.float64(1.0) + g1 * c) / (sine * sine)
    return wp.float64(0.5) * (theta - rest) * (theta - rest), g1, g2


@wp.kernel(enable_backward=False)
def _edge_energy(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64),
):
    e = wp.tid()
    length, direction, stretch = _edge_terms(x[index[e, 1]] - x[index[e, 0]], rest[e])
    wp.atomic_add(out, 0, wp.float64(0.5) * weight[e] * stretch * stretch)


@wp.kernel(enable_backward=False)
def _angle_energy(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    sign: wp.float64,
    slot: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    e = wp.tid()
    k = x[index[e, 1]]
    u = wp.normalize(sign * (x[index[e, 0]] - k))
    v = wp.normalize(x[index[e, 2]] - k)
    energy, g1, g2 = _angle_terms(wp.dot(u, v), wp.length(wp.cross(u, v)), rest[e])
    wp.atomic_add(out, slot, weight[e] * energy)


@wp.func
def _add_block(
    band: wp.array(dtype=wp.float64, ndim=2),
    coupling: wp.array(dtype=wp.float64, ndim=2),
    position: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    p: wp.int32,
    q: wp.int32,
    block: wp.mat33d,
):
    """Add ∂²E/∂x_p∂x_q: to the band where both are free, to the coupling where q is held."""
    if held[p] >= 0:
        return
    if held[q] >= 0:
        for r in range(3):
            for c in range(3):
                wp.atomic_add(coupling, 3 * held[q] + c, 3 * p + r, block[r, c])
        return
    row = 3 * position[p]
    column = 3 * position[q]
    if row < column:
        return
    for r in range(3):
        for c in range(3):
            if row + r >= column + c:
                wp.atomic_add(band, column + c, row + r - column - c, block[r, c])


@wp.kernel(enable_backward=False)
def _edge_derivatives(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    stiffness: wp.float64,
    hessian: wp.int32,
    convex: wp.int32,
    position: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    gradient: wp.array(dtype=wp.vec3d),
    band: wp.array(dtype=wp.float64, ndim=2),
    coupling: wp.array(dtype=wp.float64, ndim=2),
):
    e = wp.tid()
    p = index[e, 0]
    q = index[e, 1]
    length, direction, stretch = _edge_terms(x[q] - x[p], rest[e])
    g = weight[e] * stretch * direction
    wp.atomic_add(gradient, q, g)
    wp.atomic_add(gradient, p, -g)
    if hessian == 1:
        transverse = stretch / length
        if convex == 1:
            transverse = wp.max(transverse, wp.float64(0.0))
        outer = wp.outer(direction, direction)
        identity = wp.identity(n=3, dtype=wp.float64)
        block = stiffness * weight[e] * (outer + transverse * (identity - outer))
        _add_block(band, coupling, position, held, p, p, block)
        _add_block(band, coupling, position, held, q, q, block)
        _add_block(band, coupling, position, held, p, q, -block)
        _add_block(band, coupling, position, held, q, p, -block)


@wp.kernel(enable_backward=False)
def _angle_derivatives(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    sign: wp.float64,
    stiffness: wp.float64,
    hessian: wp.int32,
    convex: wp.int32,
    position: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    gradient: wp.array(dtype=wp.vec3d),
    band: wp.array(dtype=wp.float64, ndim=2),
    coupling: wp.array(dtype=wp.float64, ndim=2),
):
    e = wp.tid()
    i = index[e, 0]
    k = index[e, 1]
    j = index[e, 2]
    u = sign * (x[i] - x[k])
    v = x[j] - x[k]
    lu = wp.max(wp.length(u), wp.float64(1.0e-12))
    lv = wp.max(wp.length(v), wp.float64(1.0e-12))
    u = u / lu
    v = v / lv
    c = wp.dot(u, v)
    s = wp.length(wp.cross(u, v))
    value, g1, g2 = _angle_terms(c, s, rest[e])
    # Derivatives with respect to the vectors x_i - x_k (a) and x_j - x_k (b); sign² = 1.
    da = sign * (v - c * u) / lu
    db = (u - c * v) / lv
    w = weight[e]
    ga = w * g1 * da
    gb = w * g1 * db
    wp.atomic_add(gradient, i, ga)
    wp.atomic_add(gradient, j, gb)
    wp.atomic_add(gradient, k, -ga - gb)
    if hessian == 1:
        identity = wp.identity(n=3, dtype=wp.float64)
        uu = wp.outer(u, u)
        vv = wp.outer(v, v)
        uv = wp.outer(u, v)
        mixed = (identity - uu) * (identity - vv)
        scale = stiffness * w
        haa = wp.mat33d()
        hbb = wp.mat33d()
        hab = wp.mat33d()
        if convex == 0:
            curvature_a = wp.float64(3.0) * c * uu - uv - wp.transpose(uv) - c * identity
            curvature_b = wp.float64(3.0) * c * vv - uv - wp.transpose(uv) - c * identity
            haa = scale * (g2 * wp.outer(da, da) + (g1 / (lu * lu)) * curvature_a)
            hbb = scale * (g2 * wp.outer(db, db) + (g1 / (lv * lv)) * curvature_b)
            hab = scale * (g2 * wp.outer(da, db) + (g1 * sign / (lu * lv)) * mixed)
        else:
            if rest[e] == wp.float64(0.0):
                # Gauss-Newton of ½ |v̂ - û|², which agrees with ½ θ² to second order in θ.
                haa = (scale / (lu * lu)) * (identity - uu)
                hbb = (scale / (lv * lv)) * (identity - vv)
                hab = (-sign * scale / (lu * lv)) * mixed
            else:
                sine = wp.max(s, wp.float64(0.05))
                gn = scale / (sine * sine)
                haa = gn * wp.outer(da, da)
                hbb = gn * wp.outer(db, db)
                hab = gn * wp.outer(da, db)
        hba = wp.transpose(hab)
        hak = -haa - hab
        hbk = -hba - hbb
        _add_block(band, coupling, position, held, i, i, haa)
        _add_block(band, coupling, position, held, j, j, hbb)
        _add_block(band, coupling, position, held, i, j, hab)
        _add_block(band, coupling, position, held, j, i, hba)
        _add_block(band, coupling, position, held, i, k, hak)
        _add_block(band, coupling, position, held, k, i, wp.transpose(hak))
        _add_block(band, coupling, position, held, j, k, hbk)
        _add_block(band, coupling, position, held, k, j, wp.transpose(hbk))
        _add_block(band, coupling, position, held, k, k, -hak - hbk)


class Assembly:
    """Internal energy of one cloth: E = Y e_Y + S e_S + B e_B with unit-stiffness energies e.

    Args:
        stencils: element index lists.
        rest_lengths: (E,) [m].
        rest_corner_angles: (C,) [rad].
        held: flattened indices of held vertices; their rows leave the band (identity instead).
        weights: optional per-element factors on Y, S and B, each (E,), (C,), (S,); for materials that vary over
            the cloth.
    """

    def __init__(
        self,
        stencils: Stencils,
        rest_lengths: Array,
        rest_corner_angles: Array,
        held: NDArray[np.int64],
        weights: tuple[Array, Array, Array] | None = None,
    ) -> None:
        self.n = stencils.n_vertices
        index = [stencils.edges.numpy(), stencils.corners.numpy(), stencils.straights.numpy()]
        pairs = [index[0]]
        for triple in index[1:]:
            pairs += [triple[:, [0, 1]], triple[:, [1, 2]], triple[:, [0, 2]]]
        position, half = bandwidth_order(self.n, np.concatenate(pairs))
        self.half_bandwidth = 3 * half + 2
        self.position = position
        self._natural = bool((position == np.arange(self.n)).all())
        dof = (3 * position[:, None] + np.arange(3)).reshape(-1)
        self._to_band = dof
        self.held = np.asarray(held, np.int64)
        slots = np.full(self.n, -1, np.int32)
        slots[self.held] = np.arange(len(self.held), dtype=np.int32)
        held_dofs = (3 * position[self.held][:, None] + np.arange(3)).reshape(-1)
        self._held_band_dofs = held_dofs
        self.free = np.repeat((slots < 0).astype(np.float64), 3).reshape(self.n, 3)
        self._position = wp.array(position.astype(np.int32), dtype=wp.int32, device="cpu")
        self._held = wp.array(slots, dtype=wp.int32, device="cpu")
        self._index = [wp.array(i.astype(np.int32), dtype=wp.int32, ndim=2, device="cpu") for i in index]
        rest = [rest_lengths, rest_corner_angles, np.zeros(len(index[2]))]
        self._rest = [
            wp.array(np.ascontiguousarray(r, np.float64), dtype=wp.float64, device="cpu") for r in rest
        ]
        weights = weights or (np.ones(len(index[0])), np.ones(len(index[1])), np.ones(len(index[2])))
        self._weight = [wp.array(np.ascontiguousarray(w), dtype=wp.float64, device="cpu") for w in weights]
        self._sign = [0.0, 1.0, -1.0]
        self._no_band = wp.zeros((1, 1), dtype=wp.float64, device="cpu")

    def energies(self, x: Array) -> Array:
        """Unit-stiffness energies (3,) of stretching, shearing and bending at positions x (N, 3)."""
        out = np.zeros(3)
        positions = _points(x)
        target = wp.array(ptr=out.ctypes.data, dtype=wp.float64, shape=(3,), device="cpu")
        wp.launch(
            _edge_energy,
            dim=self._index[0].shape[0],
            inputs=[positions, self._index[0], self._rest[0], self._weight[0], target],
            device="cpu",
        )
        for term in (1, 2):
            inputs = [
                positions,
                self._index[term],
                self._rest[term],
                self._weight[term],
                self._sign[term],
                term,
                target,
            ]
            wp.launch(_angle_energy, dim=self._index[term].shape[0], inputs=inputs, device="cpu")
        return out

    def gradients(self, x: Array) -> Array:
        """Unit-stiffness gradients (3, N, 3) of the three energies."""
        gradients = np.zeros((3, self.n, 3))
        self._launch(x, np.ones(3), gradients, None, None, convex=False)
        return gradients

    def hessian(self, x: Array, stiffness: Array, *, convex: bool) -> tuple[Array, Array, Array]:
        """Unit-stiffness gradients, Hessian band and coupling to the held vertices.

        Args:
            x: positions (N, 3).
            stiffness: (3,) Y, S, B.
            convex: drop every indefinite part (positive semi-definite, used when the exact one is not).

        Returns:
            gradients (3, N, 3); band (3N, b + 1) with zero rows at held vertices; coupling (3 n_held, 3N), the
            rows ∂²E/∂x_held∂x_free in the vertices' own order.
        """
        gradients = np.zeros((3, self.n, 3))
        band = np.zeros((3 * self.n, self.half_bandwidth + 1))
        coupling = np.zeros((max(3 * len(self.held), 1), 3 * self.n))
        self._launch(x, stiffness, gradients, band, coupling, convex=convex)
        return gradients, band, coupling[: 3 * len(self.held)]

    def add_diagonal(self, band: Array, diagonal: Array) -> None:
        """Add a diagonal (N,) to the free rows of the band and put 1 on the held rows."""
        values = (diagonal[:, None] * self.free).reshape(-1)
        band[self._to_band, 0] += values
        band[self._held_band_dofs, 0] = 1.0

    def to_band(self, x: Array) -> Array:
        """Reorder (..., N, 3) to the band's unknowns (..., 3N)."""
        flat = x.reshape(*x.shape[:-2], -1)
        if self._natural:
            return flat
        out = np.empty_like(flat)
        out[..., self._to_band] = flat
        return out

    def from_band(self, x: Array) -> Array:
        """Inverse of to_band: (..., 3N) -> (..., N, 3)."""
        if not self._natural:
            x = x[..., self._to_band]
        return x.reshape(*x.shape[:-1], self.n, 3)

    def _launch(
        self,
        x: Array,
        stiffness: Array,
        gradients: Array,
        band: Array | None,
        coupling: Array | None,
        *,
        convex: bool,
    ) -> None:
        positions = _points(x)
        wants = int(band is not None)
        matrix = self._no_band if band is None else _matrix(band)
        side = self._no_band if coupling is None else _matrix(coupling)
        for term in range(3):
            if self._index[term].shape[0] == 0:
                continue
            target = wp.array(ptr=gradients[term].ctypes.data, dtype=wp.vec3d, shape=(self.n,), device="cpu")
            kernel: Any = _edge_derivatives if term == 0 else _angle_derivatives
            inputs = [positions, self._index[term], self._rest[term], self._weight[term]]
            inputs += [] if term == 0 else [self._sign[term]]
            inputs += [
                float(stiffness[term]),
                wants,
                int(convex),
                self._position,
                self._held,
                target,
                matrix,
                side,
            ]
            wp.launch(kernel, dim=self._index[term].shape[0], inputs=inputs, device="cpu")


def _points(x: Array) -> wp.array:
    x = np.ascontiguousarray(x, np.float64)
    view = wp.array(ptr=x.ctypes.data, dtype=wp.vec3d, shape=(x.size // 3,), device="cpu")
    view._owner = x  # keeps the memory alive as long as the view
    return view


def _matrix(a: Array) -> wp.array:
    return wp.array(ptr=a.ctypes.data, dtype=wp.float64, shape=a.shape, device="cpu")
