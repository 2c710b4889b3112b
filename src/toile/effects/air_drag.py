"""Air drag: resistance of still air, along the surface, across it, and with the square of the speed."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from toile.effects.base import Parameter, Stage, VertexEffect
from toile.physics.step_terms import StepContext


class AirDrag(VertexEffect):
    """Force per mass -(c_l v + c_n n (n·v) + c_q |v| n (n·v)), as the gradient of a dissipation potential.

    v is the velocity over the step, (x_{n+1} - x_n) / h; the normal n and the speed |v| in the quadratic term
    are those at the step's begin, so the potential is quadratic in x_{n+1}, convex for c >= 0 and stable.
    """

    NAME: ClassVar[str] = "air_drag"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    quadratic: ClassVar[bool] = True
    past_reach: ClassVar[int] = 1
    own_past: ClassVar[bool] = True
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("linear", "1/s", 0.0, 20.0, 1.0, "resistance in every direction"),
        Parameter("normal", "1/s", 0.0, 40.0, 2.0, "resistance across the surface"),
        Parameter("quadratic", "1/m", 0.0, 40.0, 2.0, "resistance across it that grows with the speed"),
    )
    SOURCE: ClassVar[str] = "Baraff and Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998 (air drag)"

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        velocity = (positions - now.positions) / now.time_step
        across = (now.normals * velocity).sum(-1)
        speed = (now.velocities.square().sum(-1) + _TINY).sqrt()
        linear, normal, quadratic = self.values
        power = linear * velocity.square().sum(-1) + (normal + quadratic * speed) * across.square()
        return 0.5 * now.time_step * now.cloth.masses * power


# Keeps the derivative of the speed finite at rest [m²/s²].
_TINY = 1e-12
