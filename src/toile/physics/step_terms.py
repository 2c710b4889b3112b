"""What may act on a cloth within one step beside inertia, internal energy and the external force.

A term is written as torch functions of the new positions and of what is known when the step begins. Whatever
would make a term couple vertices beyond the band of the Hessian (normals of neighbours, strains, velocities)
is taken from the past: consistent as the step shrinks, unconditionally stable where the new positions enter.
Derivatives with respect to the past and to the numbers inside a term come from torch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.geometry.mesh import vertex_normals
from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.material import Material

Array = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True)
class StepContext:
    """What is known when a step begins; one scene.

    Attributes:
        cloth: see Cloth; N vertices.
        material: of this scene, a batch of one.
        positions: x_n (N, 3) [m].
        velocities: v_n (N, 3) [m/s].
        time: of the end of the step since frame 0 [s].
        time_step: h [s]; a tensor () where derivatives with respect to it are taken.
        boundary: where the step ends for pinned vertices (n_pinned, 3) [m].
    """

    cloth: Cloth
    material: Material
    positions: Tensor
    velocities: Tensor
    time: float
    time_step: float | Tensor
    boundary: Tensor

    def once(self, key: object, compute: Callable[[], T]) -> T:
        """What ``compute`` gives, computed once per step: the solver asks for energies many times.

        Args:
            key: whose it is; usually the term itself, with a name.
            compute: of this context and the term's numbers alone, not of the new positions.
        """
        if key not in self._kept:
            self._kept[key] = compute()
        found: T = self._kept[key]
        return found

    @cached_property
    def _kept(self) -> dict[object, Any]:
        return {}

    @cached_property
    def normals(self) -> Tensor:
        """Unit normals (N, 3) of the cloth at x_n, to the side where its faces turn counter-clockwise."""
        return vertex_normals(self.positions, self.cloth.topology.faces)

    def with_normals(self, normals: Tensor) -> StepContext:
        """The same with other normals (N, 3): derivatives by them are taken apart."""
        other = replace(self)
        other.__dict__["normals"] = normals
        return other

    def detached(self) -> StepContext:
        """The same without gradients."""
        return StepContext(
            cloth=replace(self.cloth, masses=self.cloth.masses.detach()),
            material=self.material.detached(),
            positions=self.positions.detach(),
            velocities=self.velocities.detach(),
            time=self.time,
            # Not by as_tensor alone: that rounds a float to single precision.
            time_step=float(torch.as_tensor(self.time_step, dtype=torch.float64).detach()),
            boundary=self.boundary.detach(),
        )


class StencilForces(NamedTuple):
    """Forces that hang on nothing but where stencils are when a step begins, and on one normal of each.

    Attributes:
        stencil: vertices of each (E, K).
        middle: which of its vertices has the normal.
        forces: on its vertices (..., E, K, 3) [N] for their positions (..., E, K, 3) [m] and normals
            (..., E, 3).
    """

    stencil: Tensor
    middle: int
    forces: Callable[[Tensor, Tensor], Tensor]


class PotentialDerivatives(NamedTuple):
    """A potential of vertices and its derivatives by their new positions.

    Attributes:
        energy: (N,) [J].
        gradient: (N, 3) [N].
        blocks: second derivatives (N, 3, 3) [N/m].
    """

    energy: Array
    gradient: Array
    blocks: Array


class VertexTerm(ABC):
    """A potential of every free vertex for itself.

    Attributes:
        past_reach: on a grid, how many vertices away along each side what happened before a step changes the
            force; an upper bound.
        own_past: whether all that neighbours do to it is to turn the vertex's normal (StepContext.normals).
        quadratic: whether the potential is a polynomial of at most second degree in the new positions.
        values: numbers inside the term (n,) that derivatives are taken by.
    """

    past_reach: ClassVar[int] = 2
    own_past: ClassVar[bool] = False
    quadratic: ClassVar[bool] = False
    values: Tensor = torch.zeros(0, dtype=torch.float64)

    @abstractmethod
    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """Potential (N,) [J] whose negative gradient acts as a force.

        Args:
            positions: x_{n+1} (N, 3) [m]; entry i of the result depends on positions[i] only.
            now: see StepContext.
        """

    def derivatives(self, positions: Array, now: StepContext) -> PotentialDerivatives | None:
        """The potential and its derivatives in closed form; None of a term that leaves them to torch.

        A solver asks for them at every iteration, where torch takes as long as all else.

        Args:
            positions: x_{n+1} (N, 3) [m].
            now: without gradients.
        """
        return None

    def stencil_forces(self, cloth: Cloth) -> StencilForces | None:
        """The forces of a term that does not ask for anything else; None of any other."""
        return None


class ElementTerm(ABC):
    """A change of stiffness factors or rest shape; terms apply one after the other.

    Attributes:
        rank: terms of a higher one go after those of a lower one, whichever was given first: what is stiffer
            where it is strained after what changes the rest shape (0), what remembers a shape after both, a
            load's tension last.
        past_reach: see VertexTerm.
        own_past: whether what happened before a step changes every element through its own vertices alone, at
            all times alike.
        values: numbers inside the term (n,) that derivatives are taken by.
        tensions: that the term gives to edges which are as long as in the cloth's rest shape (E,) [N]; all
            terms know of them, see Elements.
    """

    rank: ClassVar[int] = 0
    past_reach: ClassVar[int] = 2
    own_past: ClassVar[bool] = False
    values: Tensor = torch.zeros(0, dtype=torch.float64)
    tensions: Tensor | None = None

    @abstractmethod
    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """Elements of this step; where a term changes nothing it returns its argument."""


StepTerm = VertexTerm | ElementTerm
