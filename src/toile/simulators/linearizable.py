"""Simulators whose steps leave their derivatives behind, as Gauss-Newton needs them."""

from __future__ import annotations

from toile.cloth.cloth import Cloth
from toile.simulators.base import Simulator
from toile.simulators.implicit.assembly import Assembly
from toile.simulators.implicit.integrators import Integrator


class LinearizableSimulator(Simulator):
    """A simulator of implicit steps: each minimises an incremental potential, exactly or nearly.

    With ``linearize=True`` a step's result holds one ``Linearization`` (``implicit/newton.py``) per scene,
    None where the positions are not finite: derivatives by the implicit function theorem at the positions
    that the step has found. LinearizedRollout chains them.

    Attributes:
        cloth: elements, rest shape, masses and held vertices.
        integrator: gives prediction and effective step of every step.
        assembly: internal energy of the cloth; fixes the order of the unknowns in a linearization.
    """

    cloth: Cloth
    integrator: Integrator
    assembly: Assembly
