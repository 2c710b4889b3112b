"""How the forces of step terms hang on the motion before the step: damping, drag, strains of the past.

A force at a vertex depends on positions and velocities of its neighbours up to r away on the grid, r at most
two. So rows of the derivative that are 2 r + 1 apart share no column, and (2 r + 1)² adjoints for each axis
give all of it (Curtis, Powell and Reid 1974, On the estimation of sparse Jacobian matrices).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array

from toile.physics.implicit.terms import term_forces
from toile.physics.step_terms import StepContext, StepTerm

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class PastForces:
    """Derivatives of the terms' forces by the positions and velocities at the begin of a step.

    Args:
        terms: see StepTerm.
        grid: (H, W).

    Attributes:
        remember: whether there are any; known after the first step. Another stiffness has none.
    """

    def __init__(self, terms: Sequence[StepTerm], grid: tuple[int, int]) -> None:
        self._terms = terms
        H, W = grid
        reach = max(term.past_reach for term in terms)
        n, apart = H * W, 2 * reach + 1
        i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(H), np.arange(W), indexing="ij"))
        colours = [(a, b) for a in range(apart) for b in range(apart)]
        probes = np.zeros((len(colours), 3, n, 3))
        rows = np.zeros((len(colours), n), int)
        inside = np.zeros((len(colours), n), bool)
        for k, (a, b) in enumerate(colours):
            chosen = (i % apart == a) & (j % apart == b)
            for axis in range(3):
                probes[k, axis, chosen, axis] = 1.0
            # The one vertex of this colour that a vertex can act on.
            near = i + (a - i + reach) % apart - reach, j + (b - j + reach) % apart - reach
            inside[k] = (near[0] >= 0) & (near[0] < H) & (near[1] >= 0) & (near[1] < W)
            rows[k] = np.where(inside[k], near[0] * W + near[1], 0)
        self._probes = torch.from_numpy(probes.reshape(-1, n, 3))
        shape = (len(colours), 3, n, 3)
        axes = np.arange(3)
        self._rows = np.broadcast_to(3 * rows[:, None, :, None] + axes[:, None, None], shape).reshape(-1)
        self._columns = np.broadcast_to(3 * np.arange(n)[:, None] + axes, shape).reshape(-1)
        self._inside = np.broadcast_to(inside[:, None, :, None], shape).reshape(-1)
        self._size = 3 * n
        self.remember = True

    def change(self, now: StepContext, positions: Array, moved: Single, speed: Single) -> Single:
        """Change of the forces (3N, R) [N] for changes of positions and velocities before (3N, R).

        Args:
            now: of the step.
            positions: at its end (N, 3) [m].
            moved: [m].
            speed: [m/s].
        """
        total: Single = np.zeros((self._size, 1), np.float32)
        for matrix, columns in zip(self.matrices(now, positions), (moved, speed), strict=True):
            if matrix is not None:
                total = total + matrix @ columns
        return total

    def matrices(self, now: StepContext, positions: Array) -> tuple[csr_array | None, csr_array | None]:
        """Derivatives (3N, 3N) by positions [N/m] and velocities [N s/m]; None for no dependence."""
        leaves = [t.detach().clone().requires_grad_() for t in (now.positions, now.velocities)]
        leaf = replace(now.detached(), positions=leaves[0], velocities=leaves[1])
        with torch.enable_grad():
            forces = term_forces(self._terms, leaf, torch.from_numpy(positions))
            found = torch.autograd.grad(
                forces, leaves, self._probes, is_grads_batched=True, allow_unused=True
            )
        self.remember = any(g is not None for g in found)
        x, v = (None if g is None else self._sparse(g.detach().numpy()) for g in found)
        return x, v

    def _sparse(self, gradients: Array) -> csr_array:
        values = (gradients.reshape(-1) * self._inside).astype(np.float32)
        kept = values != 0
        at = (self._rows[kept], self._columns[kept])
        return csr_array((values[kept], at), shape=(self._size, self._size))
