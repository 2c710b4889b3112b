"""Tension of the cloth in the template: what hangs is stretched already.

Rest lengths come from the template, which hangs under its own weight. A model that takes it for unstretched
sags once more, unless its threads are far too stiff: then it swings wrongly, and stiffness that varies,
densities and damping pass for the reason. The tension follows from the balance of forces at rest, whatever
the threads' stiffness is: what is hung on two corners of a net is nearly statically determinate.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from torch import Tensor

from toile.physics.cloth import Cloth
from toile.physics.elements import Elements
from toile.physics.implicit.assembly import Assembly
from toile.physics.step_terms import ElementTerm, StepContext

Array = NDArray[np.float64]

RIDGE = 0.003
"""See template_tension."""


class TemplateTension(ElementTerm):
    """Edges that pull with a tension where they are as long as in the template.

    Goes after whatever else changes the elements: the tension is the load's, not the threads'. Stiffness that
    depends on strain counts it from the unstretched length, so it knows of the tension, see Elements.

    Args:
        tensions: (E,) [N].
    """

    rank: ClassVar[int] = 3
    past_reach: ClassVar[int] = 0
    tensions: Tensor

    def __init__(self, tensions: Array) -> None:
        self.tensions = torch.from_numpy(tensions)

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See ElementTerm."""
        stiffness = now.material["stretching"].detach() * elements.factors["stretching"]
        return elements.with_rest(stretching=elements.rest["stretching"] - self.tensions / stiffness)

    def force(self, positions: Array, cloth: Cloth) -> Array:
        """Force of the tension alone (N, 3) [N]."""
        edges = cloth.energies.named("stretching").stencil.numpy()
        along = positions[edges[:, 1]] - positions[edges[:, 0]]
        along *= (self.tensions.numpy() / np.linalg.norm(along, axis=1))[:, None]
        force = np.zeros_like(positions)
        np.add.at(force, edges[:, 0], along)
        np.add.at(force, edges[:, 1], -along)
        return force


def template_tension(
    cloth: Cloth, template: Array, gravity: Array, horizontal: Array, ridge: float = RIDGE
) -> TemplateTension:
    """Tensions that balance the template's weight as well as they can; none is negative.

    What shearing, bending and a constant wind do to the balance is found with them.

    Args:
        cloth: whose rest lengths are those of the template.
        template: positions at rest (N, 3) [m].
        gravity: (3,) [m/s²].
        horizontal: directions of a wind (2, 3).
        ridge: out-of-balance force that counts as much as a tension of one [1]: rather a small tension than a
            wild one.
    """
    masses = cloth.masses.numpy()
    assembly = Assembly.of(cloth)
    free = np.ones(len(masses), bool)
    free[cloth.pinned.numpy()] = False
    edges = cloth.energies.named("stretching").stencil.numpy()
    along = template[edges[:, 1]] - template[edges[:, 0]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    n = len(edges)
    pulls = np.zeros((len(masses), 3, n))
    for axis in range(3):
        pulls[edges[:, 0], axis, np.arange(n)] += along[:, axis]
        pulls[edges[:, 1], axis, np.arange(n)] -= along[:, axis]
    beyond = cloth.energies.named("stretching").n_coefficients
    others = [-gradient for gradient in assembly.gradients(template)[beyond:]]
    winds = [masses[:, None] * axis for axis in horizontal]
    others += [*winds, *(-wind for wind in winds)]
    beside = np.stack(others, -1)
    # Columns of similar size: the others are penalised for nothing.
    beside /= np.maximum(np.linalg.norm(beside, axis=(0, 1)), 1e-300)
    system = np.concatenate((pulls, beside), -1)[free].reshape(-1, n + beside.shape[-1])
    penalty = np.eye(n, system.shape[1]) * ridge
    weight = -(masses[:, None] * gravity)[free].reshape(-1)
    found, _ = nnls(np.concatenate((system, penalty)), np.concatenate((weight, np.zeros(n))))
    return TemplateTension(np.asarray(found[:n], np.float64))
