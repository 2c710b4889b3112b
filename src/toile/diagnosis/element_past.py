"""How elements hang on the motion before the step through their own vertices: damping, stiffening."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from toile.diagnosis.past_products import PastProducts, some_at_once
from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.energies.term import EnergyTerm, InternalEnergy
from toile.physics.implicit.terms import in_order, nominal_elements
from toile.physics.step_terms import ElementTerm, StepContext

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class _SplitCloth(Cloth):
    """A cloth whose elements share no vertex: those of its energies are not those of its topology."""

    def __post_init__(self) -> None:
        """Stencils are not those of the topology."""


class ElementPast:
    """The derivative where the past changes every element through its own vertices alone.

    Elements of many steps stand side by side as those of one cloth in which no two share a vertex.

    Args:
        terms: of elements; some with a past of their own, the others without any.
        cloth: whose elements they are.
    """

    def __init__(self, terms: Sequence[ElementTerm], cloth: Cloth) -> None:
        self._terms = in_order(terms)
        self._energies = tuple(cloth.energies)
        self._cloth = cloth
        self._pattern = _Pattern(
            {term.name: term.stencil.numpy() for term in self._energies}, cloth.n_vertices
        )

    def of_steps(self, steps: Sequence[tuple[StepContext, Array]]) -> list[PastProducts | None]:
        """Of every step; None where nothing hangs on the past."""
        return some_at_once(self._side_by_side, steps)

    def _side_by_side(self, steps: Sequence[tuple[StepContext, Array]]) -> list[PastProducts | None]:
        n = len(steps)
        contexts = [now.detached() for now, _ in steps]
        x = self._of_elements([now.positions for now in contexts]).requires_grad_()
        v = self._of_elements([now.velocities for now in contexts]).requires_grad_()
        at = self._of_elements([torch.from_numpy(positions) for _, positions in steps])
        cloth = self._apart(n)
        # They are not of one time.
        apart = replace(contexts[0], cloth=cloth, positions=x, velocities=v, time=float("nan"))
        with torch.enable_grad():
            elements = _repeated(nominal_elements(self._terms, self._cloth), n)
            for term in self._terms:
                if term.own_past:
                    elements = term.elements(elements, apart)
                else:
                    elements = _each(term, elements, contexts)
        if not all(bool(t.isfinite().all()) for t in (*elements.factors.values(), *elements.rest.values())):
            raise ValueError(
                "element terms of own past: expected factors and rest shapes that are alike at all times, "
                "got what is no number without a time"
            )
        coefficients = self._cloth.energies.coefficients(contexts[0].material.values[0]).detach()
        split_up = _Split(cloth, elements, at, coefficients)
        names: list[str] = []
        after: list[Single] = []
        before: tuple[list[Single | None], list[Single | None]] = ([], [])
        depends = False
        for changed, response in (
            (elements.rest, split_up.by_rest),
            (elements.factors, split_up.by_factor),
        ):
            depending = {name: t for name, t in changed.items() if t.requires_grad}
            # Elements share no vertex, so one number of each at a time.
            for k in range(max((_numbers(t) for t in depending.values()), default=0)):
                kth = {name: _number(t, k) for name, t in depending.items() if k < _numbers(t)}
                total = sum((t.sum() for t in kth.values()), start=torch.zeros(()))
                by_past = torch.autograd.grad(total, (x, v), retain_graph=True, allow_unused=True)
                depends = depends or any(g is not None for g in by_past)
                if not any(g is not None and bool(g.any()) for g in by_past):
                    continue
                own = self._of_steps(response(kth, k), n)
                changes = [None if g is None else self._of_steps(g, n) for g in by_past]
                for name in kth:
                    parts = [None if of is None or not of[name].any() else of[name] for of in changes]
                    if any(part is not None for part in parts):
                        names.append(name)
                        after.append(own[name])
                        for kept, part in zip(before, parts, strict=True):
                            kept.append(part)
        if not depends:
            return [None] * n
        if not names:
            return [PastProducts()] * n
        transposed = self._pattern.filled(names, after, n)
        by_position, by_velocity = (self._pattern.filled(names, own, n) for own in before)
        return [
            PastProducts(None if one is None else one.T, *by_past)
            for one, *by_past in zip(transposed, by_position, by_velocity, strict=True)
        ]

    def _of_elements(self, steps: Sequence[Tensor]) -> Tensor:
        """Of every element's own vertices, energy by energy, of (N, 3) of every step."""
        stacked = torch.stack(list(steps))
        return torch.cat([stacked[:, term.stencil].reshape(-1, 3) for term in self._energies])

    def _of_steps(self, of_elements: Tensor, n: int) -> dict[str, Single]:
        """By energy (n, E, 3 K) of every element's own vertices."""
        sizes = [n * term.stencil.numel() for term in self._energies]
        return {
            term.name: own.detach().numpy().reshape(n, len(term.stencil), -1).astype(np.float32)
            for term, own in zip(self._energies, of_elements.split(sizes), strict=True)
        }

    def _apart(self, n: int) -> Cloth:
        """A cloth of the elements of n steps, none of which share a vertex."""
        terms, first = [], 0
        for term in self._energies:
            E, K = term.stencil.shape
            own = first + torch.arange(n * E * K).reshape(n * E, K)
            terms.append(replace(term, stencil=own, rest=_times(term.rest, n)))
            first += n * E * K
        cloth = self._cloth
        return _SplitCloth(
            cloth.topology, InternalEnergy(terms), cloth.masses.detach(), cloth.pinned, cloth.law
        )


def _times(of_elements: Tensor, n: int) -> Tensor:
    return of_elements.repeat(n, *(1,) * (of_elements.ndim - 1))


def _repeated(elements: Elements, n: int) -> Elements:
    """Of n steps, one after the other."""
    return Elements(
        {name: _times(t, n) for name, t in elements.factors.items()},
        {name: _times(t, n) for name, t in elements.rest.items()},
        None if elements.tensions is None else _times(elements.tensions, n),
    )


def _each(term: ElementTerm, elements: Elements, steps: Sequence[StepContext]) -> Elements:
    """What a term makes of the elements of several steps, in each of which it may ask for anything."""
    n = len(steps)

    def by_step(of: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
        apart = {name: t.unflatten(0, (n, -1)).unbind(0) for name, t in of.items()}
        return [{name: own[k] for name, own in apart.items()} for k in range(n)]

    tensions = (None,) * n if elements.tensions is None else elements.tensions.unflatten(0, (n, -1)).unbind(0)
    parts = zip(by_step(elements.factors), by_step(elements.rest), tensions, strict=True)
    found = [term.elements(Elements(*own), now) for own, now in zip(parts, steps, strict=True)]

    def together(of: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
        return {name: torch.cat([own[name] for own in of]) for name in of[0]}

    factors, rest = together([one.factors for one in found]), together([one.rest for one in found])
    return replace(elements, factors=factors, rest=rest)


@dataclass(frozen=True)
class _Split:
    """Elements that share no vertex, and what their forces hang on.

    Attributes:
        cloth: of them.
        elements: as the terms have changed them.
        at: positions at the end of the step, of their own vertices (M, 3) [m].
        coefficients: of their energies (C,).
    """

    cloth: Cloth
    elements: Elements
    at: Tensor
    coefficients: Tensor

    def by_rest(self, depending: Mapping[str, Tensor], k: int) -> Tensor:
        """Forces (M, 3) of every element's own vertices by the k-th number of its own rest shape."""
        at, elements = self.at, self.elements
        known = torch.zeros_like(at)
        with torch.enable_grad():
            y = at.clone().requires_grad_()
            energy, shapes = y.new_zeros(()), []
            for term, own in self._with_coefficients():
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

    def by_factor(self, depending: Mapping[str, Tensor], _: int) -> Tensor:
        """Forces (M, 3) of every element's own vertices by its own factor, in which they are linear."""
        at, elements = self.at, self.elements
        with torch.enable_grad():
            y = at.clone().requires_grad_()
            energy = y.new_zeros(())
            for term, own in self._with_coefficients():
                if term.name in depending:
                    ones = torch.ones_like(elements.factors[term.name])
                    energy = energy + term.energy(y, own, ones, elements.rest[term.name].detach())
            return -torch.autograd.grad(energy, y)[0]

    def _with_coefficients(self) -> list[tuple[EnergyTerm, Tensor]]:
        terms = list(self.cloth.energies)
        return list(zip(terms, self.coefficients.split([t.n_coefficients for t in terms]), strict=True))


def _numbers(of_elements: Tensor) -> int:
    """How many every element has, of (E,) or (E, R)."""
    return 1 if of_elements.ndim == 1 else of_elements.shape[1]


def _number(of_elements: Tensor, k: int) -> Tensor:
    """The k-th of every element (E,), of (E,) or (E, R)."""
    return of_elements if of_elements.ndim == 1 else of_elements[:, k]


class _Pattern:
    """Where the entries of matrices (n, 3N) are whose rows hang on an element's own vertices alone.

    Args:
        stencils: vertices of every element (E, K), by energy.
        n_vertices: N.
    """

    def __init__(self, stencils: Mapping[str, NDArray[np.int64]], n_vertices: int) -> None:
        self._columns = {
            name: (3 * stencil[:, :, None] + np.arange(3)).reshape(len(stencil), -1).astype(np.int32)
            for name, stencil in stencils.items()
        }
        self._n = 3 * n_vertices

    def filled(
        self, names: Sequence[str], rows: Sequence[Single | None], n: int
    ) -> Sequence[csr_array | None]:
        """Matrices of n steps; None of each without entries.

        Args:
            names: of the energies whose elements have a row each, one after the other.
            rows: their entries (n, E, 3 K); None where they are 0 in all steps.
            n: steps.
        """
        given = [(name, own) for name, own in zip(names, rows, strict=True) if own is not None]
        if not given:
            return [None] * n
        sizes = [
            np.full(len(self._columns[name]), 0 if own is None else own.shape[-1])
            for name, own in zip(names, rows, strict=True)
        ]
        starts = np.cumsum([0, *np.concatenate(sizes)]).astype(np.int32)
        columns = np.concatenate([self._columns[name].reshape(-1) for name, _ in given])
        entries = np.concatenate([own.reshape(n, -1) for _, own in given], axis=1)
        shape = (len(starts) - 1, self._n)
        return [csr_array((values, columns, starts), shape=shape) for values in entries]
