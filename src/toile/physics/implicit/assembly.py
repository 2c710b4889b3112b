"""Energies, gradients and Hessian of a cloth's internal energy, as Warp kernels on the CPU.

The torch functions of the terms (``toile.physics.energies``) are the oracle; the kernels compute the same
numbers (tests compare them) and write the Hessian as 3×3 blocks for whichever linear solver takes them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.energies.block_kernels import CONVEX_HESSIAN, EXACT_HESSIAN, GRADIENT_ONLY
from toile.physics.energies.term import EnergyTerm, InternalEnergy
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.warp_runtime import start_warp, view

Array = NDArray[np.float64]


class Assembly:
    """Internal energy of one cloth, E = Σ_c k_c e_c with unit energies e_c; C coefficients, N vertices.

    Args:
        n_vertices: N.
        energies: see InternalEnergy.
        pinned: (n_pinned,) vertices whose motion is prescribed.

    Attributes:
        pattern: which blocks the Hessian has.
        free: (N, 3) 1 where a vertex may move, else 0.
    """

    def __init__(self, n_vertices: int, energies: InternalEnergy, pinned: NDArray[np.int64]) -> None:
        start_warp()
        self.n = n_vertices
        self.internal = energies
        self.pinned = np.asarray(pinned, np.int64)
        self.free = np.ones((self.n, 3))
        self.free[self.pinned] = 0.0
        self.pattern = BlockPattern.of_pairs(self.n, energies.pairs())
        self._couplings = self._coupled_blocks()
        # Launches are recorded once, with arguments of their own: to pack those anew takes longer than to
        # compute. What a caller gets is always a copy.
        n_coefficients = energies.n_coefficients
        self._x = np.zeros((self.n, 3))
        self._energies = np.zeros(n_coefficients)
        self._gradients = np.zeros((n_coefficients, self.n, 3))
        self._coefficients = np.zeros(n_coefficients)
        # The kernels read these whenever they run.
        undisturbed = energies.elements().factors
        self._factors = {t.name: np.array(undisturbed[t.name].numpy(), np.float64) for t in energies}
        self._rest = {t.name: np.array(t.rest.numpy(), np.float64) for t in energies}
        self._launch_energies: list[Any] = []
        self._launch_derivatives: list[Any] = []
        for term, first in zip(energies, energies.first_coefficients(), strict=True):
            self._record(term, first)

    @staticmethod
    def of(cloth: Cloth) -> Assembly:
        """The assembly of a cloth."""
        return Assembly(cloth.n_vertices, cloth.energies, cloth.pinned.numpy())

    def _record(self, term: EnergyTerm, first: int) -> None:
        """Record the launches of a term whose first coefficient has that place."""
        stencil = term.stencil.numpy()
        n_elements, k = stencil.shape
        pairs = [(a, a) for a in range(k)] + [(a, b) for a in range(k) for b in range(a + 1, k)]
        slots = np.empty((n_elements, len(pairs)), np.int32)
        for column, (a, b) in enumerate(pairs):
            place, transposed = self.pattern.slots(stencil[:, a], stencil[:, b])
            slots[:, column] = np.where(transposed, -1 - place, place)
        if not n_elements:
            return
        kernels = term.kernels()
        rest = self._rest[term.name]
        shared = [
            view(self._x, wp.vec3d),
            view(stencil.astype(np.int32, order="C"), wp.int32),
            view(rest[:, None] if rest.ndim == 1 else rest, wp.float64),
            view(self._factors[term.name], wp.float64),
            first,
        ]
        of_energies = [view(self._energies, wp.float64)]
        of_derivatives = [
            view(self._coefficients, wp.float64),
            GRADIENT_ONLY,
            view(slots, wp.int32),
            view(self._gradients, wp.vec3d),
            view(np.zeros((1, 3, 3)), wp.mat33d),
        ]
        for kernel, more, launches in (
            (kernels.energies, of_energies, self._launch_energies),
            (kernels.derivatives, of_derivatives, self._launch_derivatives),
        ):
            launches.append(
                wp.launch(kernel, dim=n_elements, inputs=[*shared, *more], device="cpu", record_cmd=True)
            )

    def __reduce__(self) -> tuple[object, ...]:
        """Recorded launches stay in their process; a copy elsewhere records its own."""
        return (Assembly, (self.n, self.internal, self.pinned), (self._factors, self._rest))

    def __setstate__(self, elements: tuple[dict[str, Array], dict[str, Array]]) -> None:
        for kept, given in zip((self._factors, self._rest), elements, strict=True):
            for name, values in given.items():
                kept[name][...] = values

    def set_elements(self, elements: Elements) -> None:
        """Replace factors and rest shapes of all elements."""
        for name, values in elements.factors.items():
            self._factors[name][...] = values.numpy()
        for name, values in elements.rest.items():
            self._rest[name][...] = values.numpy()

    def energies(self, x: Array) -> Array:
        """Unit energies (C,) at positions x (N, 3)."""
        self._x[:] = x
        self._energies.fill(0.0)
        for launch in self._launch_energies:
            launch.launch()
        return self._energies.copy()

    def gradients(self, x: Array) -> Array:
        """Gradients (C, N, 3) of the unit energies."""
        return self._launch(x, GRADIENT_ONLY)

    def hessian(self, x: Array, coefficients: Array, *, convex: bool) -> tuple[Array, Array]:
        """Gradients of the unit energies, and Hessian of the whole energy.

        Args:
            x: positions (N, 3).
            coefficients: (C,).
            convex: drop every indefinite part (positive semi-definite, used when the exact one is not).

        Returns:
            gradients (C, N, 3); blocks (n_blocks, 3, 3) in the order of the pattern, pinned vertices
            included.
        """
        blocks = np.zeros((len(self.pattern.rows), 3, 3))
        self._coefficients[:] = coefficients
        shared = view(blocks, wp.mat33d)
        for launch in self._launch_derivatives:
            launch.set_param_by_name("blocks", shared)
        return self._launch(x, CONVEX_HESSIAN if convex else EXACT_HESSIAN), blocks

    def coupling(self, blocks: Array) -> Array:
        """The rows (3 n_pinned, 3N) of the Hessian that are ∂²E/∂x_pinned∂x_free."""
        rows = np.zeros((len(self.pinned), 3, self.n, 3))
        for place, pinned, vertex, transposed in self._couplings:
            found = blocks[place]
            rows[pinned, :, vertex, :] = found.transpose(0, 2, 1) if transposed else found
        return rows.reshape(3 * len(self.pinned), 3 * self.n)

    def _coupled_blocks(self) -> list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], bool]]:
        """Blocks between a pinned and a free vertex: place, number of the pinned, free one, transposed."""
        number = np.full(self.n, -1)
        number[self.pinned] = np.arange(len(self.pinned))
        found = []
        for pinned, other, transposed in (
            (self.pattern.rows, self.pattern.columns, False),
            (self.pattern.columns, self.pattern.rows, True),
        ):
            place = np.flatnonzero((number[pinned] >= 0) & (number[other] < 0))
            found.append((place, number[pinned[place]], other[place], transposed))
        return found

    def _launch(self, x: Array, order: int) -> Array:
        self._x[:] = x
        self._gradients.fill(0.0)
        for launch in self._launch_derivatives:
            launch.set_param_by_name("order", order)
            launch.launch()
        return self._gradients.copy()
