"""What an internal energy of a cloth brings, and their sum."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.errors import InputError
from toile.physics.elements import Elements
from toile.physics.parameter_vector import Parameter, ParameterVector


@dataclass(frozen=True)
class TermKernels:
    """Warp kernels of one energy over its elements, each launched with one thread per element.

    Both begin with the arguments (positions (N,) vec3d, stencil (E, K) int32, rest (E, R) float64,
    factors (E,) float64, first int32), ``first`` being the first coefficient's place among all.

    Attributes:
        energies: goes on with (out (C,) float64) and adds the unit energies.
        derivatives: goes on with (coefficients (C,) float64, order int32, slots (E, K(K+1)/2) int32,
            gradients (C, N) vec3d, blocks (n,) mat33d) and adds unit gradients and, as ``order`` says (see
            block_kernels), the Hessian weighted with the coefficients.
    """

    energies: Any
    derivatives: Any


@dataclass(frozen=True, eq=False)
class EnergyTerm(ABC):
    """An internal energy E = Σ_c k_c e_c(x): a sum over elements, linear in its coefficients.

    Attributes:
        stencil: (E, K) int64, the vertices of every element.
        rest: rest shape of every element, (E,) or (E, R) float64; see each energy.
    """

    stencil: Tensor
    rest: Tensor

    name: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    """What the energy depends on, as one gives it."""
    n_coefficients: ClassVar[int]
    """Coefficients that it is linear in: what the solver works with."""

    def __post_init__(self) -> None:
        if self.stencil.ndim != 2 or len(self.rest) != len(self.stencil):
            raise ValueError(
                f"{self.name}: expected a stencil (E, K) and a rest shape of as many elements, "
                f"got {tuple(self.stencil.shape)} and {tuple(self.rest.shape)}"
            )

    def coefficients(self, values: Tensor) -> Tensor:
        """Coefficients (..., C) for values (..., P) of the parameters; differentiable."""
        return values

    @abstractmethod
    def energy(self, positions: Tensor, coefficients: Tensor, factors: Tensor, rest: Tensor) -> Tensor:
        """The energy in plain torch, the oracle of the kernels.

        Args:
            positions: (..., N, 3) [m].
            coefficients: (..., C), broadcastable to the leading axes of the positions.
            factors: on every element, (E,).
            rest: like the attribute.

        Returns:
            Energy (...) [J].
        """

    def measure(self, positions: Tensor) -> Tensor:
        """What the rest shape is a value of, at positions (N, 3) [m]: lengths or angles (E,).

        Raises:
            InputError: the energy has no such measure; effects of warp and weft ask for it.
        """
        raise InputError(
            f"{self.name} is no energy of lengths or angles, so this effect can't act on it",
            where="effect",
            expected="a cloth with warp and weft",
            got=f"the energy {self.name}",
        )

    def strain(self, positions: Tensor, rest: Tensor | None = None) -> Tensor:
        """Dimensionless departure from rest (E,): relative change of length, or change of angle [rad].

        Args:
            positions: (N, 3) [m].
            rest: shape of every element in the step in question; None: that of the cloth.
        """
        return self.measure(positions) - (self.rest if rest is None else rest)

    def forces_by_rest(
        self, positions: Tensor, coefficients: Tensor, factors: Tensor, k: int
    ) -> Tensor | None:
        """Derivative of the forces on an element's own vertices by the k-th number of its rest shape.

        Only where it does not depend on the rest shape and is known without differentiating; None elsewhere.

        Args:
            positions: of every element's own vertices (E, K, 3) [m].
            coefficients: (C,).
            factors: on every element (E,).
            k: of the R numbers.

        Returns:
            (E, K, 3), or None.
        """
        return None

    @abstractmethod
    def kernels(self) -> TermKernels:
        """Its Warp kernels; Warp is imported here."""

    def energy_of(self, positions: Tensor, values: Tensor) -> Tensor:
        """Energy (...) [J] for values (..., P) of the parameters, undisturbed elements."""
        return self.energy(
            positions,
            self.coefficients(values),
            torch.ones(len(self.stencil), dtype=self.rest.dtype),
            self.rest,
        )


class InternalEnergy(Sequence[EnergyTerm]):
    """The energies of a cloth, in the order of their coefficients.

    Args:
        terms: no two have the same name.
        defaults: of parameters that a material need not give, by name.
        factors: on the stiffness of all elements (E,), by term; 1 for terms without.
    """

    def __init__(
        self,
        terms: Sequence[EnergyTerm],
        defaults: Mapping[str, float] | None = None,
        factors: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.terms = tuple(terms)
        self._defaults = dict(defaults or {})
        self._factors = dict(factors or {})
        names = [term.name for term in self.terms]
        if len(set(names)) < len(names):
            raise ValueError(f"terms: expected every energy once, got {', '.join(names)}")
        sizes = {term.name: len(term.stencil) for term in self.terms}
        for name, given in self._factors.items():
            if name not in sizes or tuple(given.shape) != (sizes[name],):
                raise ValueError(f"factors of {name}: expected as many as elements, {sizes}")

    def with_factors(self, factors: Mapping[str, Tensor]) -> InternalEnergy:
        """The same with factors on the stiffness of all elements (E,), by term."""
        return InternalEnergy(self.terms, self._defaults, factors)

    @cached_property
    def parameters(self) -> ParameterVector:
        """Parameters of all terms, one after the other."""
        everything = ParameterVector(tuple(p for term in self.terms for p in term.parameters))
        return everything.with_defaults(self._defaults)

    @property
    def n_coefficients(self) -> int:
        """Coefficients of all terms."""
        return sum(term.n_coefficients for term in self.terms)

    def first_coefficients(self) -> list[int]:
        """Place of every term's first coefficient."""
        return np.cumsum([0, *(term.n_coefficients for term in self.terms)])[:-1].tolist()

    def coefficients(self, values: Tensor) -> Tensor:
        """Coefficients (..., C) for values (..., P) of the parameters; differentiable."""
        parts = values.split([len(term.parameters) for term in self.terms], -1)
        return torch.cat([t.coefficients(part) for t, part in zip(self.terms, parts, strict=True)], -1)

    def elements(self) -> Elements:
        """Undisturbed elements: factors are those of the grid, 1 where it is even."""
        of = self._factors
        return Elements(
            {t.name: of.get(t.name, torch.ones(len(t.stencil), dtype=torch.float64)) for t in self.terms},
            {t.name: t.rest for t in self.terms},
        )

    def energy(self, positions: Tensor, coefficients: Tensor, elements: Elements | None = None) -> Tensor:
        """Sum of the terms, (...) [J].

        Args:
            positions: (..., N, 3) [m].
            coefficients: (..., C).
            elements: undisturbed ones if None.
        """
        return sum(self.each(positions, coefficients, elements).values(), start=positions.new_zeros(()))

    def each(
        self, positions: Tensor, coefficients: Tensor, elements: Elements | None = None
    ) -> dict[str, Tensor]:
        """Energy of each term by its name, (...) [J]; arguments as for ``energy``."""
        e = self.elements() if elements is None else elements
        parts = coefficients.split([term.n_coefficients for term in self.terms], -1)
        return {
            t.name: t.energy(positions, part, e.factors[t.name], e.rest[t.name])
            for t, part in zip(self.terms, parts, strict=True)
        }

    def named(self, name: str) -> EnergyTerm:
        """The term of that name.

        Raises:
            KeyError: the cloth has no such energy.
        """
        for term in self.terms:
            if term.name == name:
                return term
        raise KeyError(f"the cloth has no energy {name!r}; it has {', '.join(t.name for t in self.terms)}")

    def pairs(self) -> NDArray[np.int64]:
        """Vertices that any element couples, (n, 2), repeated as often as there are elements."""
        found = []
        for term in self.terms:
            index = term.stencil.numpy()
            k = index.shape[1]
            found += [index[:, [a, b]] for a in range(k) for b in range(a + 1, k)]
        return np.concatenate(found)

    def __len__(self) -> int:
        return len(self.terms)

    def __iter__(self) -> Iterator[EnergyTerm]:
        return iter(self.terms)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]
        return self.terms[index]
