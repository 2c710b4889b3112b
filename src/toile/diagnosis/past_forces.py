"""How the forces of step terms hang on the motion before the step: damping, drag, strains of the past.

A force at a vertex depends on positions and velocities of its neighbours up to r away on the grid, r at most
two. So rows of the derivative that are 2 r + 1 apart share no column, and (2 r + 1)² adjoints for each axis
give all of it (Curtis, Powell and Reid 1974, On the estimation of sparse Jacobian matrices).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.energies.term import EnergyTerm, InternalEnergy
from toile.physics.implicit.terms import in_order, nominal_elements, split, term_forces
from toile.physics.step_terms import ElementTerm, StepContext, StepTerm

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class PastForces:
    """Derivatives of the terms' forces by the positions and velocities at the begin of a step.

    Args:
        terms: see StepTerm.
        cloth: on a grid.

    Attributes:
        remember: whether there are any; known after the first step. Another stiffness has none.
    """

    def __init__(self, terms: Sequence[StepTerm], cloth: Cloth) -> None:
        of_vertices, of_elements = split(terms)
        self._elements: _ElementPast | None = None
        self._others: _VertexPast | None = None
        rest: Sequence[StepTerm] = terms
        if all(term.own_past or not term.past_reach for term in of_elements):
            rest = of_vertices
            if any(term.own_past for term in of_elements):
                self._elements = _ElementPast(of_elements, cloth)
        if rest:
            self._others = _VertexPast(rest, cloth)
        self._size = 3 * cloth.n_vertices
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
        of = [past.products(now, positions) for past in (self._elements, self._others) if past is not None]
        self.remember = any(of)
        for by_motion in of:
            for after, befores in by_motion:
                change = sum((before @ (speed if at_speed else moved) for before, at_speed in befores), _ZERO)
                total = total + (change if after is None else after @ change)
        return total


Products = list[tuple[csr_array | None, list[tuple[csr_array, bool]]]]
"""Derivatives of the forces: matrices to multiply, the first None for one, and for each of the others whether
it is by velocities."""

_ZERO = np.zeros((1, 1), np.float32)


class _VertexPast:
    """The derivative from adjoints of vertices that do not meet.

    Args:
        terms: at least one.
        cloth: on a grid.
    """

    def __init__(self, terms: Sequence[StepTerm], cloth: Cloth) -> None:
        assert cloth.grid is not None
        self._terms = terms
        H, W = cloth.grid
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

    def products(self, now: StepContext, positions: Array) -> Products:
        """Derivatives (3N, 3N) by positions [N/m] and velocities [N s/m]; arguments as for ``change``."""
        leaves = [t.detach().clone().requires_grad_() for t in (now.positions, now.velocities)]
        leaf = replace(now.detached(), positions=leaves[0], velocities=leaves[1])
        with torch.enable_grad():
            forces = term_forces(self._terms, leaf, torch.from_numpy(positions))
            if not forces.requires_grad:
                return []
            found = torch.autograd.grad(
                forces, leaves, self._probes, is_grads_batched=True, allow_unused=True
            )
        by_motion = self._by_motion(found)
        return [(None, by_motion)] if by_motion else []

    def _by_motion(self, found: Sequence[Tensor | None]) -> list[tuple[csr_array, bool]]:
        pairs = zip(found, (False, True), strict=True)
        return [(self._sparse(g.detach().numpy()), at_speed) for g, at_speed in pairs if g is not None]

    def _sparse(self, gradients: Array) -> csr_array:
        values = (gradients.reshape(-1) * self._inside).astype(np.float32)
        kept = values != 0
        at = (self._rows[kept], self._columns[kept])
        return csr_array((values[kept], at), shape=(self._size, self._size))


class _SplitCloth(Cloth):
    """A cloth whose elements share no vertex: those of its energies are not those of its topology."""

    def __post_init__(self) -> None:
        """Stencils are not those of the topology."""


class _ElementPast:
    """The derivative where the past changes every element through its own vertices alone.

    Args:
        terms: of elements; some with a past of their own, the others without any.
        cloth: whose elements they are.
    """

    def __init__(self, terms: Sequence[ElementTerm], cloth: Cloth) -> None:
        self._terms = terms
        split_terms, vertices, elements = [], [], []
        n_vertices = n_elements = 0
        for term in cloth.energies:
            E, K = term.stencil.shape
            own = n_vertices + torch.arange(E * K).reshape(E, K)
            split_terms.append(replace(term, stencil=own))
            vertices.append(term.stencil.reshape(-1))
            elements.append(n_elements + np.repeat(np.arange(E), K))
            n_vertices, n_elements = n_vertices + E * K, n_elements + E
        self._vertices = torch.cat(vertices)
        energies = InternalEnergy(split_terms)
        self._cloth = _SplitCloth(cloth.topology, energies, cloth.masses.detach(), cloth.pinned, cloth.law)
        at = (3 * self._vertices.numpy()[:, None] + np.arange(3)).reshape(-1)
        element = np.repeat(np.concatenate(elements), 3)
        self._before = _Pattern(element, at, (n_elements, 3 * cloth.n_vertices))
        self._after = _Pattern(at, element, (3 * cloth.n_vertices, n_elements))

    def products(self, now: StepContext, positions: Array) -> Products:
        """See ``change``; first what the elements do with a change, then how the past changes them."""
        now = now.detached()
        x, v = (t[self._vertices].requires_grad_() for t in (now.positions, now.velocities))
        apart = replace(now, cloth=self._cloth, positions=x, velocities=v)
        with torch.enable_grad():
            elements = nominal_elements(self._terms, now.cloth)
            for term in in_order(self._terms):
                elements = term.elements(elements, apart if term.own_past else now)
        at = torch.from_numpy(positions)[self._vertices]
        coefficients = now.cloth.energies.coefficients(now.material.values[0]).detach()
        found: Products = []
        for changed, response in (
            (elements.rest, self._by_rest),
            (elements.factors, self._by_factor),
        ):
            depending = {name: t for name, t in changed.items() if t.requires_grad}
            # Elements share no vertex, so one number of each at a time.
            for k in range(max((_numbers(t) for t in depending.values()), default=0)):
                kth = {name: _number(t, k) for name, t in depending.items() if k < _numbers(t)}
                total = sum((t.sum() for t in kth.values()), start=torch.zeros(()))
                by_past = torch.autograd.grad(total, (x, v), retain_graph=True, allow_unused=True)
                pairs = [
                    (g, at_speed) for g, at_speed in zip(by_past, (False, True), strict=True) if g is not None
                ]
                befores = [(self._before.filled(g), at_speed) for g, at_speed in pairs if bool(g.any())]
                if befores:
                    found.append((self._after.filled(response(kth, k, elements, at, coefficients)), befores))
                elif pairs:
                    # Nothing in this step, as of a strain that is zero: there may be something in the next.
                    found.append((None, []))
        return found

    def _by_rest(
        self, depending: Mapping[str, Tensor], k: int, elements: Elements, at: Tensor, coefficients: Tensor
    ) -> Tensor:
        """Forces (M, 3) of every element's own vertices by the k-th number of its own rest shape."""
        known = torch.zeros_like(at)
        with torch.enable_grad():
            y = at.clone().requires_grad_()
            energy, shapes = y.new_zeros(()), []
            for term, own in self._with_coefficients(coefficients):
                if term.name in depending:
                    factors = elements.factors[term.name].detach()
                    there = at[term.stencil]
                    forces = term.forces_by_rest(there, own, factors, k)
                    if forces is not None:
                        known[term.stencil] = forces
                        continue
                    rest = elements.rest[term.name].detach()
                    shapes.append(_number(rest, k).clone().requires_grad_())
                    if rest.ndim > 1:
                        rest = torch.stack((*rest.unbind(1)[:k], shapes[-1], *rest.unbind(1)[k + 1 :]), dim=1)
                    else:
                        rest = shapes[-1]
                    energy = energy + term.energy(y, own, factors, rest)
            if not shapes:
                return known
            (gradient,) = torch.autograd.grad(energy, y, create_graph=True)
            # The adjoint is linear in what it is applied to; its own adjoint is the tangent.
            dummy = torch.zeros_like(gradient, requires_grad=True)
            adjoints = torch.autograd.grad(gradient, shapes, dummy, create_graph=True)
            total = torch.stack([one.sum() for one in adjoints]).sum()
            return known - torch.autograd.grad(total, dummy)[0]

    def _by_factor(
        self, depending: Mapping[str, Tensor], _: int, elements: Elements, at: Tensor, coefficients: Tensor
    ) -> Tensor:
        """Forces (M, 3) of every element's own vertices by its own factor, in which they are linear."""
        with torch.enable_grad():
            y = at.clone().requires_grad_()
            energy = y.new_zeros(())
            for term, own in self._with_coefficients(coefficients):
                if term.name in depending:
                    ones = torch.ones_like(elements.factors[term.name])
                    energy = energy + term.energy(y, own, ones, elements.rest[term.name].detach())
            return -torch.autograd.grad(energy, y)[0]

    def _with_coefficients(self, coefficients: Tensor) -> list[tuple[EnergyTerm, Tensor]]:
        terms = list(self._cloth.energies)
        return list(zip(terms, coefficients.split([t.n_coefficients for t in terms]), strict=True))


def _numbers(of_elements: Tensor) -> int:
    """How many every element has, of (E,) or (E, R)."""
    return 1 if of_elements.ndim == 1 else of_elements.shape[1]


def _number(of_elements: Tensor, k: int) -> Tensor:
    """The k-th of every element (E,), of (E,) or (E, R)."""
    return of_elements if of_elements.ndim == 1 else of_elements[:, k]


class _Pattern:
    """Where the entries of a sparse matrix are, found once.

    Args:
        rows: of every entry (n,); entries at the same place add up.
        columns: of every entry (n,).
        shape: of the matrix.
    """

    def __init__(self, rows: NDArray[np.int64], columns: NDArray[np.int64], shape: tuple[int, int]) -> None:
        self._order = np.lexsort((columns, rows))
        self._columns = columns[self._order].astype(np.int32)
        self._starts = np.searchsorted(rows[self._order], np.arange(shape[0] + 1)).astype(np.int32)
        self._shape = shape

    def filled(self, values: Tensor) -> csr_array:
        """The matrix with these entries (n / 3, 3)."""
        data = values.detach().numpy().reshape(-1)[self._order].astype(np.float32)
        return csr_array((data, self._columns, self._starts), shape=self._shape)
