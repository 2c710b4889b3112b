"""Step terms within an implicit step: their values for the solver, their forces for the adjoint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.potential import StepPotential
from toile.physics.material import Material
from toile.physics.step_terms import ElementTerm, PotentialDerivatives, StepContext, StepTerm, VertexTerm

Array = NDArray[np.float64]


class VertexPotential(StepPotential):
    """Sum of vertex terms during one step of one scene.

    A quadratic potential is expanded where the step begins, exactly: the solver asks for it a dozen times.

    Args:
        terms: at least one.
        now: without gradients.
    """

    def __init__(self, terms: Sequence[VertexTerm], now: StepContext) -> None:
        self._terms, self._now = terms, now
        self._last: tuple[Array, Array, Array] | None = None
        self._closed: tuple[Array, list[PotentialDerivatives | None]] | None = None
        self._quadratic = all(term.quadratic for term in terms)

    def energy(self, x: Array) -> Array:
        """Potential (N,) [J] at positions (N, 3) [m]."""
        return self._evaluate(x)[0]

    def total(self, x: Array, free: Array) -> float:
        """See StepPotential."""
        return float(self.energy(x) @ free[:, 0])

    def gradient(self, x: Array) -> Array:
        """Its gradient (N, 3) [N]."""
        return self._evaluate(x)[1]

    def add_hessian(self, blocks: Array, pattern: BlockPattern, x: Array, *, convex: bool) -> None:
        """See StepPotential."""
        blocks[pattern.diagonal] += self.blocks(x, convex=convex)

    def blocks(self, x: Array, *, convex: bool) -> Array:
        """Its second derivatives (N, 3, 3) [N/m]; without negative eigenvalues if ``convex``."""
        blocks = self._expansion[3] if self._quadratic else self._derivatives(x)[2]
        if not convex:
            return blocks
        values, vectors = np.linalg.eigh(blocks)
        if values.min(initial=0.0) >= 0.0:
            return blocks
        projected: Array = (vectors * values.clip(min=0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)
        return projected

    @cached_property
    def _expansion(self) -> tuple[Array, Array, Array, Array]:
        """Where the step begins (N, 3): the place, potential (N,), gradient and second derivatives there."""
        x = self._now.positions.numpy()
        return x, *self._derivatives(x)

    def _derivatives(self, x: Array) -> PotentialDerivatives:
        """At positions x (N, 3)."""
        found, others = self._in_closed_form(x)
        if others:
            with torch.enable_grad():
                positions = torch.tensor(x, requires_grad=True)
                energy = vertex_energy(others, positions, self._now)
                gradient = _gradient(energy, positions, graph=True)
                rows = [_gradient(gradient[:, axis], positions, graph=False) for axis in range(3)]
            parts = energy.detach(), gradient.detach(), torch.stack(rows, 1)
            found.append(PotentialDerivatives(*(part.numpy() for part in parts)))
        if len(found) == 1:
            return found[0]
        return PotentialDerivatives(
            np.sum([one.energy for one in found], 0),
            np.sum([one.gradient for one in found], 0),
            np.sum([one.blocks for one in found], 0),
        )

    def _in_closed_form(self, x: Array) -> tuple[list[PotentialDerivatives], list[VertexTerm]]:
        """Derivatives of the terms that have them in closed form, and the other terms."""
        # The Hessian is asked for where the gradient has been.
        if self._closed is None or not np.array_equal(self._closed[0], x):
            self._closed = x.copy(), [term.derivatives(x, self._now) for term in self._terms]
        pairs = list(zip(self._terms, self._closed[1], strict=True))
        return [one for _, one in pairs if one is not None], [term for term, one in pairs if one is None]

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        if self._quadratic:
            begin, level, slope, blocks = self._expansion
            away = x - begin
            bent = (blocks @ away[:, :, None])[:, :, 0]
            return level + ((slope + 0.5 * bent) * away).sum(-1), slope + bent
        # The line search asks for the potential, then the residual for the gradient at the same place.
        if self._last is None or not np.array_equal(self._last[0], x):
            found, others = self._in_closed_form(x)
            level, slope = np.zeros(len(x)), np.zeros_like(x)
            for one in found:
                level, slope = level + one.energy, slope + one.gradient
            if others:
                with torch.enable_grad():
                    positions = torch.tensor(x, requires_grad=True)
                    energy = vertex_energy(others, positions, self._now)
                    gradient = _gradient(energy, positions, graph=False)
                level, slope = level + energy.detach().numpy(), slope + gradient.detach().numpy()
            self._last = (x.copy(), level, slope)
        return self._last[1], self._last[2]


@dataclass(frozen=True)
class SceneTerms:
    """What the step terms are for the solver during one step of one scene.

    Attributes:
        vertices: potential of the vertex terms or whatever else acts within the step, if anything does.
        elements: factors and rest shape, if there are element terms; without gradients.
    """

    vertices: StepPotential | None = None
    elements: Elements | None = None

    @staticmethod
    def of(terms: Sequence[StepTerm], now: StepContext) -> SceneTerms:
        """Evaluate the terms where the step begins."""
        now = now.detached()
        vertex_terms, element_terms = split(terms)
        with torch.no_grad():
            elements = changed_elements(element_terms, now) if element_terms else None
        return SceneTerms(VertexPotential(vertex_terms, now) if vertex_terms else None, elements)

    def prepare(self, assembly: Assembly) -> None:
        """Give the assembly the elements of this step."""
        if self.elements is not None:
            assembly.set_elements(self.elements)


def split(terms: Sequence[StepTerm]) -> tuple[list[VertexTerm], list[ElementTerm]]:
    """Vertex terms and element terms, each in the given order."""
    return (
        [term for term in terms if isinstance(term, VertexTerm)],
        [term for term in terms if isinstance(term, ElementTerm)],
    )


def vertex_energy(terms: Sequence[VertexTerm], positions: Tensor, now: StepContext) -> Tensor:
    """Sum of the terms' potentials, (N,) [J]."""
    total = positions.new_zeros(len(positions))
    for term in terms:
        total = total + term.energy(positions, now)
    return total


def in_order(terms: Sequence[ElementTerm]) -> list[ElementTerm]:
    """Terms in the order in which they apply, see ElementTerm.rank."""
    return sorted(terms, key=lambda term: term.rank)


def nominal_elements(terms: Sequence[ElementTerm], cloth: Cloth) -> Elements:
    """Elements before all the terms, with the tensions that one of them gives to the rest shape."""
    elements = cloth.energies.elements()
    for term in terms:
        if term.tensions is not None:
            elements = replace(elements, tensions=term.tensions)
    return elements


def changed_elements(terms: Sequence[ElementTerm], now: StepContext) -> Elements:
    """Elements after all the terms."""
    elements = nominal_elements(terms, now.cloth)
    for term in in_order(terms):
        elements = term.elements(elements, now)
    return elements


def term_forces(terms: Sequence[StepTerm], now: StepContext, positions: Tensor) -> Tensor:
    """Force of the vertex terms, and internal force if there are element terms, (N, 3) [N].

    Differentiable with respect to everything in ``now`` and the numbers inside the terms, except for
    stiffnesses as such and the new positions: those the step's own adjoint takes care of.

    Args:
        terms: see StepTerm.
        now: with gradients.
        positions: x_{n+1} (N, 3) [m], without gradients.
    """
    vertex_terms, element_terms = split(terms)
    with torch.enable_grad():
        at = positions.detach().requires_grad_()
        energy = vertex_energy(vertex_terms, at, now).sum()
        if element_terms:
            # No gradients by the coefficients as such.
            coefficients = now.cloth.energies.coefficients(now.material.values[0]).detach()
            energy = energy + now.cloth.energies.energy(
                at, coefficients, changed_elements(element_terms, now)
            )
        return -_gradient(energy, at, graph=True)


def depends_on_gradients(terms: Sequence[StepTerm], now: StepContext) -> bool:
    """Whether anything that a term's force depends on requires gradients."""
    inputs = [
        now.cloth.masses,
        now.material.values,
        now.positions,
        now.velocities,
        now.boundary,
        torch.as_tensor(now.time_step),
        *(term.values for term in terms),
    ]
    return any(tensor.requires_grad for tensor in inputs)


class TermMemory:
    """Derivatives of the terms' force in one step by what it knows of the past, at fixed new positions.

    Args:
        terms: see StepTerm.
        now: of the step.
        positions: x_{n+1} (N, 3) [m].

    Attributes:
        values: numbers inside the terms that require gradients, one tensor (n,) per term that has any.
    """

    def __init__(self, terms: Sequence[StepTerm], now: StepContext, positions: Tensor) -> None:
        plain = now.detached()
        self._leaves = [
            t.clone().requires_grad_()
            for t in (plain.positions, plain.velocities, plain.boundary, plain.material.values[0])
        ]
        x, v, boundary, material = self._leaves
        leaf = replace(
            plain,
            material=Material(plain.material.parameters, material[None]),
            positions=x,
            velocities=v,
            boundary=boundary,
        )
        self.values = [term.values for term in terms if term.values.requires_grad]
        self._forces = term_forces(terms, leaf, positions)
        self._slopes: tuple[Tensor, list[Tensor]] | None = None

    @property
    def n_values(self) -> int:
        """Numbers in all ``values``."""
        return sum(map(len, self.values))

    def tangent(self, x: Array, v: Array, boundary: Array, stiffness: Array, values: Array) -> Array:
        """Change of the force (N, 3) for changes of x_n, v_n, boundary, material (P,) and all values (n,).

        No values, (0,), stands for no change of them.
        """
        if not self._forces.requires_grad:
            return np.zeros_like(x)
        if self._slopes is None:
            # The adjoint is linear in the vector it is applied to; its own adjoint is the tangent.
            dummy = torch.zeros_like(self._forces, requires_grad=True)
            self._slopes = dummy, self._adjoint(dummy, graph=True)
        dummy, slopes = self._slopes
        changes = [torch.from_numpy(np.ascontiguousarray(c)) for c in (x, v, boundary, stiffness)]
        if len(values):
            changes += torch.from_numpy(values).split([len(v) for v in self.values])
        total = sum(((s * c).sum() for s, c in zip(slopes, changes, strict=False)), start=0 * dummy.sum())
        (force,) = torch.autograd.grad(total, dummy, retain_graph=True, materialize_grads=True)
        found: Array = force.detach().numpy()
        return found

    def adjoint(self, gradient: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Gradients by x_n, v_n, boundary, material (P,) and all values for one by the force (N, 3)."""
        found = [g.detach().numpy() for g in self._adjoint(torch.from_numpy(gradient), graph=False)]
        values: Array = np.concatenate(found[4:]) if found[4:] else np.zeros(0)
        return found[0], found[1], found[2], found[3], values

    def _adjoint(self, gradient: Tensor, *, graph: bool) -> list[Tensor]:
        inputs = [*self._leaves, *self.values]
        if not self._forces.requires_grad:
            return [torch.zeros_like(i) for i in inputs]
        return list(
            torch.autograd.grad(
                self._forces,
                inputs,
                gradient,
                create_graph=graph,
                retain_graph=True,
                materialize_grads=True,
            )
        )


def _gradient(energy: Tensor, positions: Tensor, *, graph: bool) -> Tensor:
    """Gradient of the sum of ``energy``, 0 where it does not depend on the positions."""
    if not energy.requires_grad:
        return torch.zeros_like(positions)
    (gradient,) = torch.autograd.grad(
        energy.sum(), positions, create_graph=graph, retain_graph=True, materialize_grads=True
    )
    return gradient
