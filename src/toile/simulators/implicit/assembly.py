"""Energy, gradient and Hessian of the internal energy over element stencils, as Warp kernels on the CPU.

The pure functions in ``toile.cloth.energies`` are the oracle; these kernels compute the same numbers (a test
compares them) and write the Hessian directly into LAPACK's lower band storage.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.cloth.stencils import Stencils
from toile.simulators.implicit.assembly_kernels import (
    angle_derivatives,
    angle_energy,
    edge_derivatives,
    edge_energy,
)
from toile.simulators.implicit.banded import bandwidth_order
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]


class Assembly:
    """Internal energy of one cloth: E = Y e_Y + S e_S + B e_B with unit-stiffness energies e.

    Args:
        stencils: element index lists.
        rest_lengths: (E,) [m].
        rest_corner_angles: (C,) [rad].
        held: flattened indices of held vertices; their rows leave the band (identity instead).
        weights: optional per-element factors on Y, S and B, each (E,), (C,), (S,); for materials that vary
            over the cloth.
    """

    def __init__(
        self,
        stencils: Stencils,
        rest_lengths: Array,
        rest_corner_angles: Array,
        held: NDArray[np.int64],
        weights: tuple[Array, Array, Array] | None = None,
    ) -> None:
        start_warp()
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
        self._position = view(position.astype(np.int32), wp.int32)
        self._held = view(slots, wp.int32)
        self._index = [view(i.astype(np.int32, order="C"), wp.int32) for i in index]
        rest = [rest_lengths, rest_corner_angles, np.zeros(len(index[2]))]
        self._rest = [view(np.array(r, np.float64), wp.float64) for r in rest]
        weights = weights or (np.ones(len(index[0])), np.ones(len(index[1])), np.ones(len(index[2])))
        self._weight = [view(np.array(w, np.float64), wp.float64) for w in weights]
        self._sign = [0.0, 1.0, -1.0]
        self._no_band = view(np.zeros((1, 1)), wp.float64)

    def energies(self, x: Array) -> Array:
        """Unit-stiffness energies (3,) of stretching, shearing and bending at positions x (N, 3)."""
        out = np.zeros(3)
        positions = view(np.ascontiguousarray(x, np.float64).reshape(-1, 3), wp.vec3d)
        target = view(out, wp.float64)
        wp.launch(
            edge_energy,
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
            wp.launch(angle_energy, dim=self._index[term].shape[0], inputs=inputs, device="cpu")
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
            gradients (3, N, 3); band (3N, b + 1) with zero rows at held vertices; coupling (3 n_held, 3N),
            the rows ∂²E/∂x_held∂x_free in the vertices' own order.
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
        positions = view(np.ascontiguousarray(x, np.float64).reshape(-1, 3), wp.vec3d)
        wants = int(band is not None)
        matrix = self._no_band if band is None else view(band, wp.float64)
        side = self._no_band if coupling is None else view(coupling, wp.float64)
        for term in range(3):
            if self._index[term].shape[0] == 0:
                continue
            target = view(gradients[term], wp.vec3d)
            kernel: Any = edge_derivatives if term == 0 else angle_derivatives
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
