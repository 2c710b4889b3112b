"""Contact with a rigid obstacle, with friction."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.effects.base import Parameter, Scope, Stage, Surroundings, VertexEffect
from toile.effects.gusts import USUAL_MODES, half_waves
from toile.effects.obstacles import Nowhere, Obstacle, Plane, Sphere
from toile.limits import NonNegative, Positive, Unit
from toile.physics.step_terms import PotentialDerivatives, StepContext

Array = NDArray[np.float64]


class Contact(VertexEffect):
    """Penalty ½ k m (δ - d)² of vertices closer than δ to the obstacle, and Coulomb friction along it.

    d is the signed distance of the new position, m the vertex's mass: the force per mass at a given depth
    does not depend on the grid. Friction is μ N along the surface, with the normal force N = k m (δ - d) and
    the normal of the step's begin, against the displacement u over the step: the potential μ N f(|u|) has
    f = |u| beyond the displacement ε h and is smooth below it, where real cloth sticks.

    Args:
        obstacle: what is touched; None where nobody knows it, and then nothing is.
        values: see Effect.
        thickness: δ [m].
        sticking_speed: ε [m/s].
    """

    NAME: ClassVar[str] = "contact"
    STAGE: ClassVar[Stage] = Stage.MECHANICS
    SCOPE: ClassVar[Scope] = Scope.CLIP
    past_reach: ClassVar[int] = 0
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("stiffness", "1/s²", 0.0, 1e7, 2e4, "k: force per depth and mass; g / k deep under weight"),
        Parameter("friction", "1", 0.0, 3.0, 0.4, "μ: tangential over normal force while it slides"),
    )
    SOURCE: ClassVar[str] = (
        "Li, Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang and Kaufman, Incremental Potential "
        "Contact, ACM Transactions on Graphics 39(4), 2020 (lagged smoothed friction); a penalty instead of "
        "their barrier: Terzopoulos, Platt, Barr and Fleischer, Elastically Deformable Models, SIGGRAPH 1987"
    )

    def __init__(
        self,
        obstacle: Obstacle | None = None,
        values: Mapping[str, float] | None = None,
        thickness: Annotated[NonNegative, Unit("m")] = 0.0,
        sticking_speed: Annotated[Positive, Unit("m/s")] = 0.01,
    ) -> None:
        super().__init__(values)
        self._obstacle = Nowhere() if obstacle is None else obstacle
        self._thickness = thickness
        self._sticking_speed = sticking_speed

    def place(self) -> dict[str, NDArray[np.float64]]:
        """See Effect."""
        thickness = np.array([self._thickness])
        match self._obstacle:
            case Plane(point=point, normal=normal):
                return {"point": point.numpy(), "normal": normal.numpy(), "thickness": thickness}
            case Sphere(centre=centre, radius=radius):
                return {"centre": centre.numpy(), "radius": np.array([radius]), "thickness": thickness}
        return {}

    def placed(self, place: Mapping[str, NDArray[np.float64]]) -> Self:
        """See Effect."""
        if not place:
            return self
        other = copy.copy(self)
        match place:
            case {"point": point, "normal": normal}:
                other._obstacle = Plane(point.tolist(), normal.tolist())
            case {"centre": centre, "radius": radius}:
                other._obstacle = Sphere(centre.tolist(), float(radius[0]))
        other._thickness = float(place["thickness"][0])
        return other

    def pushing(self, duration: float) -> VertexEffect:
        """What it may push where nobody knows what the cloth does against that, see ContactPush.

        Args:
            duration: of the longest clip [s].
        """
        return ContactPush(self, duration)

    def acts_on(self, around: Surroundings, motion: Tensor) -> Tensor:
        """See Effect: how deep the margin of the obstacle is entered, the mean over all frames [m]."""
        return torch.stack([self.depth(x, x) for x in motion]).mean(0)

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        stiffness, friction, normals = now.once(self, lambda: self._lagged(now))
        depth = self.depth(positions, now.positions)
        moved = positions - now.positions
        along = moved - (moved * normals).sum(-1, keepdim=True) * normals
        slide = _smooth_length(along, self._sticking_speed * now.time_step)
        return 0.5 * stiffness * depth.square() + friction * slide

    def derivatives(self, positions: Array, now: StepContext) -> PotentialDerivatives | None:
        """See VertexTerm; None for an obstacle whose distance has no second derivatives in closed form."""
        curvature = self._obstacle.curvature(positions)
        if curvature is None:
            return None
        lagged = now.once(self, lambda: self._lagged(now))
        stiffness, friction, before = (part.detach().numpy() for part in lagged)
        x = torch.from_numpy(positions)
        depth, normals = self.depth(x, now.positions).numpy(), self.normals(x).numpy()
        push = stiffness * depth
        pressed = np.where(depth > 0, stiffness, 0.0)[:, None, None] * _outer(normals)
        moved = positions - now.positions.numpy()
        along = moved - (moved * before).sum(-1, keepdims=True) * before
        length, slope, bend = _smooth_length_slopes(along, float(self._sticking_speed * now.time_step))
        slide = slope[:, None, None] * (np.eye(3) - _outer(before)) + bend[:, None, None] * _outer(along)
        return PotentialDerivatives(
            0.5 * push * depth + friction * length,
            (friction * slope)[:, None] * along - push[:, None] * normals,
            pressed - push[:, None, None] * curvature + friction[:, None, None] * slide,
        )

    def depth(self, positions: Tensor, earlier: Tensor) -> Tensor:
        """How far every vertex is within the margin of the obstacle (N,) [m].

        Args:
            positions: of the vertices (N, 3) [m].
            earlier: see Obstacle.distance.
        """
        return (self._thickness - self._obstacle.distance(positions, earlier)).clamp(min=0.0)

    def normals(self, positions: Tensor) -> Tensor:
        """See Obstacle."""
        return self._obstacle.normals(positions)

    def _lagged(self, now: StepContext) -> tuple[Tensor, Tensor, Tensor]:
        """Stiffness k m (N,) [N/m], friction while sliding (N,) [N] and normals (N, 3), lagged."""
        stiffness, friction = self.values
        stiffness = stiffness * now.cloth.masses
        depth = self.depth(now.positions, now.positions)
        return stiffness, friction * stiffness * depth, self._obstacle.normals(now.positions)


def _pushes(n_modes: int) -> tuple[Parameter, ...]:
    stiffness = Contact.PARAMETERS[0]
    low, high, scale = -stiffness.high, stiffness.high, stiffness.scale
    return tuple(
        Parameter(f"push_{k}", stiffness.unit, low, high, scale, f"amplitude of {k} half waves, per depth")
        for k in range(n_modes + 1)
    )


class ContactPush(VertexEffect):
    """Push of an obstacle that is more or less hard in time: ½ m (δ - d)² Σ a_k cos(π k t / T).

    How hard an obstacle pushes is what the cloth asks of it. Where the forces within the cloth are free
    (diagnosis/outside_causes.py) nothing says what that is: the motion stays where it is seen, outside of the
    obstacle or a little within, and how deep that is says where it pushes, not how hard. So it has a history
    in time, as fast as that of gusts and of a pressure, and no friction.

    Args:
        contact: with the obstacle and its margin.
        duration: T, of the longest clip [s].
    """

    NAME: ClassVar[str] = Contact.NAME
    STAGE: ClassVar[Stage] = Contact.STAGE
    SCOPE: ClassVar[Scope] = Contact.SCOPE
    past_reach: ClassVar[int] = 0
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _pushes(USUAL_MODES)
    SOURCE: ClassVar[str] = (
        "a normal force that is whatever keeps the bodies apart: Signorini, Questioni di elasticità non "
        "linearizzata, Rendiconti di Matematica 18, 1959"
    )

    def __init__(self, contact: Contact, duration: float) -> None:
        self._contact, self._duration = contact, duration
        self._parameters = _pushes(half_waves(duration))
        super().__init__()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return self._parameters

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        depth = self._contact.depth(positions, now.positions)
        return 0.5 * (self._waves(now) @ self.values) * now.cloth.masses * depth.square()

    def force_derivatives(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexEffect."""
        depth = self._contact.depth(positions, now.positions)
        push = (now.cloth.masses * depth)[:, None] * self._contact.normals(positions)
        return self._waves(now)[:, None, None] * push

    def _waves(self, now: StepContext) -> Tensor:
        """Of every parameter at the end of a step (n_parameters,)."""
        k = torch.arange(len(self._parameters), dtype=torch.float64)
        return torch.cos(torch.pi * k * now.time / self._duration)


def _smooth_length(vectors: Tensor, limit: float | Tensor) -> Tensor:
    """Length (N,) of vectors (N, 3), made twice differentiable below ``limit`` as in the source."""
    squared = vectors.square().sum(-1)
    below = squared < limit * limit
    length = torch.where(squared > _TINY * limit * limit, squared, _TINY * limit * limit).sqrt()
    return torch.where(below, squared * (1 / limit - length / (3 * limit * limit)) + limit / 3, length)


def _smooth_length_slopes(vectors: Array, limit: float) -> tuple[Array, Array, Array]:
    """The same length l of vectors v (N, 3), and s and b (N,): grad l = s v, its derivative s I + b v vᵀ."""
    squared = (vectors**2).sum(-1)
    root = np.sqrt(np.maximum(squared, _TINY * limit * limit))
    below = squared < limit * limit
    length = np.where(below, squared * (1 / limit - root / (3 * limit * limit)) + limit / 3, root)
    slope = np.where(below, 2 / limit - root / (limit * limit), 1 / root)
    return length, slope, np.where(below, -1 / (limit * limit * root), -1 / root**3)


def _outer(vectors: Array) -> Array:
    """Outer products v vᵀ (N, 3, 3) of vectors (N, 3)."""
    return vectors[:, :, None] * vectors[:, None, :]


# The root's derivatives stay finite; its factor vanishes there.
_TINY = 1e-16
