"""The training pool: cloth states that the network itself moves on (paper, section 3.1.5 and Figure 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from toile.errors import InputError
from toile.learning.surrogate.distributions import normal, uniform
from toile.learning.surrogate.emphasis import Emphasis
from toile.learning.surrogate.forces import ForceSampler, acceleration_field
from toile.learning.surrogate.materials import MaterialRanges
from toile.learning.surrogate.pinned_corners import (
    PinnedCornerSampler,
    border_lengths,
    corner_indices,
    within_reach,
)
from toile.learning.surrogate.rest_shapes import RestShapeSampler
from toile.learning.surrogate.states import ClothStates
from toile.limits import Count, Fraction, NonNegative
from toile.physics.cloth import cell_shares
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.linearizable import extrapolations
from toile.physics.surrogate.problem import StepProblem

_HISTORY = 4  # past positions that any formula here needs


@dataclass(frozen=True)
class PoolSettings:
    """What the pool is made of; all quantities in network units.

    Attributes:
        size: number of cloths.
        grid: (H, W).
        materials: stiffness.
        rest_shapes: rest lengths and resting poses.
        forces: gravity, wind, turbulence.
        pinned_corners: which corners are pinned, and their motion.
        bdf2_share: share of cloths moved by BDF2; the others by backward Euler.
        noise: standard deviation of random changes of x_n in some of the problems: a network must cope with
            states that its own errors have spoilt.
        noise_share: share of the problems with such noise.
        calm_share: share of the cloths without turbulence, whose pinned corners stand still: they come to
            rest, if the network lets them.
        emphasis: which stiffnesses new cloths have more often; None for all alike.
    """

    size: Count
    grid: tuple[Count, Count]
    materials: MaterialRanges
    rest_shapes: RestShapeSampler
    forces: ForceSampler
    pinned_corners: PinnedCornerSampler
    bdf2_share: Fraction
    noise: NonNegative
    noise_share: Fraction
    calm_share: Fraction = 0.0
    emphasis: Emphasis | None = None

    def __post_init__(self) -> None:
        if self.size < 1 or len(self.grid) != 2 or min(self.grid) < 3:
            raise InputError(
                "The training pool is unusable",
                where="pool",
                expected="at least one cloth on a grid of at least 3×3 vertices",
                got=f"size {self.size}, grid {self.grid}",
            )


class Pool:
    """Cloth states, the problems of their next steps, and their random numbers.

    In network units the effective step βh is 1, whatever the integrator: BDF2 has h = 1.5 and differs in the
    prediction only. A cloth's first step by BDF2 is one of backward Euler with βh = 1 as well, as if that one
    step were shorter: the start of a motion is one random state among many.

    It is no ``nn.Module``: with several processes each has a pool of its own, which nothing must synchronise.

    Args:
        settings: see there.
        generator: of all random numbers; the pool lives on its device and advances it.
        share: see below.

    Attributes:
        share: of the stiffness ranges that new cloths have, from the soft end.
        failures: running failure of every part of the material box; None without emphasis.
    """

    def __init__(self, settings: PoolSettings, generator: torch.Generator, share: float = 1.0) -> None:
        self.settings = settings
        self.generator = generator
        self._masses = cell_shares(*settings.grid).to(generator.device, torch.float32)
        self._predictions = prediction_weights().to(generator.device)
        self.share = share
        self.failures: Tensor | None = None
        if settings.emphasis is not None:
            self.failures = settings.emphasis.start().to(generator.device)
        self.states = self._new(settings.size)

    def draw(self, n: int) -> Tensor:
        """Indices (n,) of n different cloths."""
        order = torch.randperm(self.settings.size, generator=self.generator, device=self.generator.device)
        return order[:n]

    def problem(self, indices: Tensor, since: Sequence[Tensor] = ()) -> StepProblem:
        """The next step of some cloths, with four candidate starts: standing still, free fall, and the linear
        and quadratic continuation of the motion.

        Args:
            indices: (B,) int64.
            since: positions (B, H, W, 3) that the last steps have led to, newest first; the problem depends
                on them with a derivative. Their values are those of the pool.
        """
        s = self.states.take(indices)
        free = s.free
        # In float64 from here on: a stiff spring multiplies every digit lost.
        x = self._with_noise(s.history, free).double()
        if since:
            changes = [positions - positions.detach() for positions in since[:_HISTORY]]
            changes += [torch.zeros_like(changes[0])] * (_HISTORY - len(changes))
            x = x + torch.stack(changes, 1)
        weights = self._predictions[s.bdf2.long(), s.age.clamp(max=_HISTORY - 1)]
        prediction = (weights[:, :, None, None, None] * x).sum(1)
        accelerations = acceleration_field(s.steady, s.turbulence, self.settings.grid)
        continued = extrapolations(x[:, 0], x[:, 1:])
        starts = torch.stack((x[:, 0], prediction + accelerations, *continued), 1)
        rows, columns = corner_indices(self.settings.grid)
        bounded = torch.zeros_like(prediction)
        bounded[:, rows, columns] = self._boundary(s).double()
        starts = torch.where(free[:, None, :, :, None] > 0, starts, bounded[:, None])
        return StepProblem(
            prediction=prediction,
            starts=starts,
            forces=accelerations * self._masses[..., None],
            stiffness=s.stiffness,
            masses=self._masses,
            free=free,
            rest_lengths_i=s.rest_lengths_i,
            rest_lengths_j=s.rest_lengths_j,
        )

    def advance(self, indices: Tensor, positions: Tensor) -> None:
        """Store predicted positions as new states, recentred, and let forces and pinned corners go on.

        Args:
            indices: (B,) int64, no index twice.
            positions: (B, H, W, 3).
        """
        s = self.states.take(indices)
        positions = positions.to(s.history.dtype)
        history = torch.cat((positions[:, None], s.history[:, : _HISTORY - 1]), 1)
        changed = {
            "history": history - positions.mean((1, 2))[:, None, None, None],
            "age": s.age + 1,
            "turbulence": self.settings.forces.next_turbulence(
                s.turbulence, s.turbulence_strength, self.generator
            ),
            "corner_velocities": self.settings.pinned_corners.next_velocities(
                s.corner_velocities, s.corner_speed, self.generator
            ),
        }
        self.states.put(indices, ClothStates(**{**s.tensors(), **changed}))

    def reset(self, indices: Tensor) -> None:
        """Replace some cloths by new ones at rest; indices (m,) int64, no index twice."""
        if len(indices):
            self.states.put(indices, self._new(len(indices)))

    def note_failures(self, indices: Tensor, failures: Tensor) -> None:
        """Let new cloths have those stiffnesses more often with which a step has failed.

        Args:
            indices: (B,) int64.
            failures: of their steps, from 0 to 1, (B,).
        """
        if self.settings.emphasis is not None and self.failures is not None:
            materials, stiffness = self.settings.materials, self.states.stiffness[indices]
            self.failures = self.settings.emphasis.noted(self.failures, materials, stiffness, failures)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes: the states, the failures and the generator, on the CPU."""
        states = {name: tensor.detach().cpu().clone() for name, tensor in self.states.tensors().items()}
        failures = {} if self.failures is None else {"failures": self.failures.cpu().clone()}
        return {"states": states, "generator": self.generator.get_state().cpu(), **failures}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of state_dict.

        Raises:
            InputError: the state is that of another size or grid.
        """
        new, own = state["states"], self.states.tensors()
        names = {field.name for field in fields(ClothStates)}
        if new.keys() != names or any(new[name].shape != own[name].shape for name in names):
            raise InputError(
                "The stored training pool does not fit",
                where="checkpoint",
                expected=f"{self.settings.size} cloths on a grid of {self.settings.grid}",
                got=f"positions of shape {tuple(new['history'].shape) if 'history' in new else 'none'}",
            )
        self.states = ClothStates(**{name: new[name].to(self.generator.device, copy=True) for name in names})
        self.generator.set_state(state["generator"])
        if self.failures is not None:
            self.failures = state["failures"].to(self.generator.device, copy=True)

    def _new(self, n: int) -> ClothStates:
        """N cloths at rest."""
        settings, generator = self.settings, self.generator
        shapes = settings.rest_shapes.sample(n, settings.grid, generator)
        if settings.emphasis is None or self.failures is None:
            stiffness = settings.materials.sample(n, generator, self.share)
        else:
            stiffness = settings.emphasis.sample(n, settings.materials, self.failures, self.share, generator)
        forces = settings.forces.sample(n, generator)
        corner_speed = settings.pinned_corners.sample_speed(forces.gravity, generator)
        if settings.calm_share > 0:
            moved = (uniform(n, generator) >= settings.calm_share).to(corner_speed)
            forces = forces.without_turbulence(moved)
            corner_speed = corner_speed * moved
        return ClothStates(
            history=shapes.positions[:, None].repeat(1, _HISTORY, 1, 1, 1),
            age=torch.zeros(n, dtype=torch.int64, device=generator.device),
            bdf2=uniform(n, generator) < settings.bdf2_share,
            stiffness=stiffness,
            rest_lengths_i=shapes.rest_lengths_i,
            rest_lengths_j=shapes.rest_lengths_j,
            steady=forces.steady,
            turbulence=forces.turbulence,
            turbulence_strength=forces.turbulence_strength,
            pinned=settings.pinned_corners.sample_pinned(n, generator),
            corner_velocities=settings.pinned_corners.sample_velocities(corner_speed, generator),
            corner_speed=corner_speed,
        )

    def _with_noise(self, history: Tensor, free: Tensor) -> Tensor:
        """The history (B, 4, H, W, 3) with noise in the free vertices of some x_n."""
        if not (self.settings.noise > 0 and self.settings.noise_share > 0):
            return history
        noisy = uniform(len(history), self.generator) < self.settings.noise_share
        amount = self.settings.noise * noisy[:, None, None] * free
        noise = normal(tuple(history[:, 0].shape), self.generator) * amount[..., None]
        return torch.cat((history[:, :1] + noise[:, None], history[:, 1:]), 1)

    def _boundary(self, states: ClothStates) -> Tensor:
        """Positions (B, 4, 3) of the corners at the end of the step, if they are pinned."""
        rows, columns = corner_indices(self.settings.grid)
        moved = states.history[:, 0, rows, columns] + states.corner_velocities
        return within_reach(
            moved, states.pinned, border_lengths(states.rest_lengths_i, states.rest_lengths_j)
        )


def prediction_weights() -> Tensor:
    """Weights of x_n, x_{n-1}, ... in the prediction, by integrator, age and past position, (2, 4, 4).

    Row 0 is backward Euler, row 1 BDF2 with its starting formulas; the last age stands for all later ones.
    """

    def padded(prediction: tuple[float, ...]) -> list[float]:
        return [*prediction, *[0.0] * (_HISTORY - len(prediction))]

    methods = (BackwardEuler(), BDF2())
    rows = [[padded(m.formula(age).prediction) for age in range(_HISTORY)] for m in methods]
    return torch.tensor(rows, dtype=torch.float64)
