"""How the forces of step terms hang on the motion before the step: damping, drag, strains of the past."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.element_past import ElementPast
from toile.diagnosis.past_products import PastProducts
from toile.diagnosis.vertex_past import FacingPast, StencilPast, TurningNormals, VertexPast
from toile.physics.cloth import Cloth
from toile.physics.implicit.terms import split
from toile.physics.step_terms import StepContext, StepTerm

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class PastForces:
    """Derivatives of the terms' forces by the positions and velocities at the begin of a step.

    Args:
        terms: see StepTerm.
        cloth: on a grid.

    Attributes:
        remember: whether there are any; known after the first step. Another stiffness has none.
        normals: how they turn.
        by_vertices: terms that are asked in every step for itself.
    """

    def __init__(self, terms: Sequence[StepTerm], cloth: Cloth) -> None:
        of_vertices, of_elements = split(terms)
        self._elements: ElementPast | None = None
        others: list[StepTerm] = []
        if all(term.own_past or not term.past_reach for term in of_elements):
            if any(term.own_past for term in of_elements):
                self._elements = ElementPast(of_elements, cloth)
        else:
            others += of_elements
        on_stencils = [term for term in of_vertices if term.stencil_forces(cloth) is not None]
        of_vertices = [term for term in of_vertices if term not in on_stencils]
        facing = [term for term in of_vertices if term.own_past or not term.past_reach]
        others += [term for term in of_vertices if term not in facing]
        self._stencils = [StencilPast(term, cloth) for term in on_stencils]
        self.by_vertices: list[FacingPast | VertexPast] = []
        if facing:
            self.by_vertices.append(FacingPast(facing, cloth))
        if others:
            self.by_vertices.append(VertexPast(others, cloth))
        self.normals = TurningNormals(cloth) if facing or on_stencils else None
        self.size = 3 * cloth.n_vertices
        self.remember = True

    def of_steps(self, steps: Sequence[tuple[StepContext, Array]]) -> list[PastOfStep]:
        """What hangs on the past in steps of one material and length.

        Args:
            steps: with the positions (N, 3) [m] at their ends.
        """
        found: list[list[PastProducts]] = [[] for _ in steps]
        by_elements = [None] * len(steps) if self._elements is None else self._elements.of_steps(steps)
        contexts = [now for now, _ in steps]
        for kinds in (by_elements, *(one.of_steps(contexts) for one in self._stencils)):
            for of_step, products in zip(found, kinds, strict=True):
                if products is not None:
                    of_step.append(products)
        return [
            PastOfStep(self, now, positions, tuple(own))
            for (now, positions), own in zip(steps, found, strict=True)
        ]


@dataclass(frozen=True)
class PastOfStep:
    """Derivatives of the terms' forces in one step.

    Attributes:
        forces: whose they are.
        now: the step.
        positions: at its end (N, 3) [m].
        known: of terms that many steps have been asked for at once.
    """

    forces: PastForces
    now: StepContext
    positions: Array
    known: tuple[PastProducts, ...]

    def change(self, moved: Single, speed: Single) -> Single:
        """Change of the forces (3N, R) [N] for changes of positions and velocities before (3N, R).

        Args:
            moved: [m].
            speed: [m/s].
        """
        found = [one.products(self.now, self.positions) for one in self.forces.by_vertices]
        self.forces.remember = bool(self.known) or not all(products.nothing for products in found)
        total: Single = np.zeros((self.forces.size, 1), np.float32)
        turned: Single | None = None
        for products in (*self.known, *found):
            if products.by_normals is not None and turned is None:
                assert self.forces.normals is not None
                turned = self.forces.normals.change(self.now.positions.detach().numpy(), moved)
            if not products.nothing:
                total = total + products.change(moved, speed, turned)
        return total
