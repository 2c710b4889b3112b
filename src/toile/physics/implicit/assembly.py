"""Energy, gradient and Hessian of the internal energy over element stencils, as Warp kernels on the CPU.

The pure functions in ``toile.physics.energies`` are the oracle; these kernels compute the same numbers (a
test compares them) and write the Hessian directly into LAPACK's lower band storage.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.physics.implicit.assembly_kernels import (
    CONVEX_HESSIAN,
    EXACT_HESSIAN,
    GRADIENT_ONLY,
    derivatives,
    energies,
)
from toile.physics.implicit.banded import bandwidth_order
from toile.physics.stencils import Stencils
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
        self._stencils = stencils
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
        held_dofs = (3 * position[self.held][:, None] + np.arange(3)).reshape(-1)
        self._held_band_dofs = held_dofs
        place = position.copy()
        place[self.held] = -1 - np.arange(len(self.held))
        self.free = np.repeat((place >= 0).astype(np.float64), 3).reshape(self.n, 3)
        weights = weights or (np.ones(len(index[0])), np.ones(len(index[1])), np.ones(len(index[2])))
        # The kernels read these four whenever they run.
        self._rest_lengths = np.array(rest_lengths, np.float64)
        self._edge_weights = np.array(weights[0], np.float64)
        self._rest_angles = np.concatenate((rest_corner_angles, np.zeros(len(index[2]))))
        self._angle_weights = np.concatenate(weights[1:])
        elements = [
            view(index[0].astype(np.int32, order="C"), wp.int32),
            view(self._rest_lengths, wp.float64),
            view(self._edge_weights, wp.float64),
            view(np.concatenate(index[1:]).astype(np.int32, order="C"), wp.int32),
            len(index[1]),
            view(self._rest_angles, wp.float64),
            view(self._angle_weights, wp.float64),
        ]
        # Launches are recorded once, with arguments of their own: to pack those anew takes longer than to
        # compute. What a caller gets is always a copy.
        self._x = np.zeros((self.n, 3))
        self._energies = np.zeros(3)
        self._gradients = np.zeros((3, self.n, 3))
        self._stiffness = np.zeros(3)
        positions = view(self._x, wp.vec3d)
        self._launch_energies = wp.launch(
            energies,
            dim=sum(map(len, index)),
            inputs=[positions, *elements, view(self._energies, wp.float64)],
            device="cpu",
            record_cmd=True,
        )
        self._launch_derivatives = wp.launch(
            derivatives,
            dim=sum(map(len, index)),
            inputs=[
                positions,
                *elements,
                view(self._gradients, wp.vec3d),
                view(self._stiffness, wp.float64),
                self.half_bandwidth + 1,
                view(place.astype(np.int32), wp.int32),
                GRADIENT_ONLY,
                view(np.zeros(1), wp.float64),
                view(np.zeros((1, 1)), wp.float64),
            ],
            device="cpu",
            record_cmd=True,
        )

    def __reduce__(self) -> tuple[object, ...]:
        """Recorded launches stay in their process; a copy elsewhere records its own."""
        corners = len(self._stencils.corners)
        weights = (self._edge_weights, self._angle_weights[:corners], self._angle_weights[corners:])
        angles = self._rest_angles[:corners]
        made_from = (self._stencils, self._rest_lengths, angles, self.held, weights)
        return (Assembly, made_from, self._rest_angles)

    def __setstate__(self, rest_angles: Array) -> None:
        self._rest_angles[:] = rest_angles

    def set_elements(
        self,
        weights: tuple[Array, Array, Array],
        rest_lengths: Array,
        rest_corner_angles: Array,
        rest_straight_angles: Array,
    ) -> None:
        """Replace factors on Y, S, B (E,), (C,), (S,), and rest shape (E,) [m], (C,) and (S,) [rad]."""
        self._edge_weights[:] = weights[0]
        self._angle_weights[:] = np.concatenate(weights[1:])
        self._rest_lengths[:] = rest_lengths
        self._rest_angles[:] = np.concatenate((rest_corner_angles, rest_straight_angles))

    def energies(self, x: Array) -> Array:
        """Unit-stiffness energies (3,) of stretching, shearing and bending at positions x (N, 3)."""
        self._x[:] = x
        self._energies.fill(0.0)
        self._launch_energies.launch()
        return self._energies.copy()

    def gradients(self, x: Array) -> Array:
        """Unit-stiffness gradients (3, N, 3) of the three energies."""
        return self._launch(x, GRADIENT_ONLY)

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
        band = np.zeros((3 * self.n, self.half_bandwidth + 1))
        coupling = np.zeros((max(3 * len(self.held), 1), 3 * self.n))
        self._stiffness[:] = stiffness
        self._launch_derivatives.set_param_by_name("band", view(band.reshape(-1), wp.float64))
        self._launch_derivatives.set_param_by_name("coupling", view(coupling, wp.float64))
        gradients = self._launch(x, CONVEX_HESSIAN if convex else EXACT_HESSIAN)
        return gradients, band, coupling[: 3 * len(self.held)]

    def add_diagonal(self, band: Array, diagonal: Array) -> None:
        """Add a diagonal (N,) to the free rows of the band and put 1 on the held rows."""
        values = (diagonal[:, None] * self.free).reshape(-1)
        band[self._to_band, 0] += values
        band[self._held_band_dofs, 0] = 1.0

    def add_blocks(self, band: Array, blocks: Array) -> None:
        """Add symmetric blocks (N, 3, 3), ∂²/∂x_i², to the free rows of the band."""
        blocks = blocks * self.free[:, :, None]
        first = 3 * self.position
        for column in range(3):
            for row in range(column, 3):
                band[first + column, row - column] += blocks[:, row, column]

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

    def _launch(self, x: Array, order: int) -> Array:
        self._x[:] = x
        self._gradients.fill(0.0)
        self._launch_derivatives.set_param_by_name("order", order)
        self._launch_derivatives.launch()
        return self._gradients.copy()
