"""What a turn of the training descends along, as interchangeable objects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from toile.learning.surrogate.pool import Pool
from toile.learning.surrogate.resets import relative_residual
from toile.learning.surrogate.schedules import UnrolledSteps
from toile.limits import Count
from toile.physics.surrogate.differentiable import DifferentiableStepProblem
from toile.physics.surrogate.surrogate import Surrogate, limited, loss_scale, reach


@dataclass(frozen=True)
class Turn:
    """What a turn of the cycle has led to.

    Attributes:
        loss: a number whose gradient is that of the rescaled Eq. 4; its value means nothing.
        positions: after the last step, (B, H, W, 3).
        residual: out-of-balance force there, (B, H, W, 3).
        forces: external forces of that step, (B, H, W, 3).
        measures: plain numbers.
    """

    loss: Tensor
    positions: Tensor
    residual: Tensor
    forces: Tensor
    measures: dict[str, float]


class Objective(ABC):
    """How time steps of some cloths become a loss. The pool has gone on by these steps afterwards."""

    @abstractmethod
    def turn(
        self, surrogate: Surrogate, pool: Pool, batch: Tensor, n_passes: int, progress: Progress
    ) -> Turn:
        """Move cloths on and judge how that was done.

        Args:
            surrogate: the network; the loss is differentiable in its weights.
            pool: the cloths.
            batch: indices (B,) of some.
            n_passes: of the network per step.
            progress: of the run.
        """


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes:
        step: 0, 1, ..., n_steps - 1.
        n_steps: of the whole run.
    """

    step: int
    n_steps: int


@final
class PassesApart(Objective):
    """One time step. Each pass has a loss of its own, behind a relaxation along the tangents of the lines.

    Cheap: the gradient of Eq. 4 is known in closed form, and the gradients of the passes do not depend on
    each other.
    """

    def turn(
        self, surrogate: Surrogate, pool: Pool, batch: Tensor, n_passes: int, progress: Progress
    ) -> Turn:
        """See Objective."""
        problem = pool.problem(batch)
        losses: list[Tensor] = []
        measures: dict[str, float] = {}
        last = None
        for number, last in enumerate(surrogate.passes(problem, n_passes), 1):
            losses.append((last.gradient * last.correction).sum() / (len(batch) * n_passes))
            measures |= _pass_measures(
                number, last.residual, problem.forces, last.potential_change, last.accepted
            )
        assert last is not None
        pool.advance(batch, last.positions)
        return Turn(torch.stack(losses).sum(), last.positions, last.residual, problem.forces, measures)


@final
class BehindTheSweeps(Objective):
    """Each pass has its loss behind the line sweeps with which the network is used, as many as there.

    The gradient goes through the sweeps and the lowest point after them, step lengths included. Through the
    passes before, and through the time steps before, it goes once several steps are unrolled. It is the
    gradient of what the positions do to Eq. 4, not of what earlier positions do to later problems: it
    vanishes where every step is exact.

    Args:
        sweeps: relaxations of the warp and weft lines behind each pass.
        unrolled: time steps of a turn over the run.
    """

    def __init__(self, sweeps: Count, unrolled: UnrolledSteps) -> None:
        self.sweeps = sweeps
        self.unrolled = unrolled

    def turn(
        self, surrogate: Surrogate, pool: Pool, batch: Tensor, n_passes: int, progress: Progress
    ) -> Turn:
        """See Objective."""
        n_steps = self.unrolled.at(progress.step, progress.n_steps)
        losses: list[Tensor] = []
        since: list[Tensor] = []
        measures: dict[str, float] = {}
        for _ in range(n_steps):
            known = pool.problem(batch, since)
            problem = DifferentiableStepProblem.of(known)
            visited = surrogate.begin(problem)
            for number in range(1, n_passes + 1):
                if n_steps == 1:
                    # Nothing but the weights has a gradient: the kernels do for the network's inputs.
                    visited = visited.detached()
                before, r_before = visited.last
                correction = surrogate.network(known if n_steps == 1 else problem, before, r_before)
                farthest = reach(problem, r_before.detach(), correction)
                _limit(correction, farthest)
                visited = surrogate.improve(problem, visited, correction, self.sweeps)
                x, r = visited.last
                if n_steps > 1:
                    _limit(x, farthest)
                with torch.no_grad():
                    change = problem.potential(x) - problem.potential(before)
                    gradient = limited(
                        -r / loss_scale(problem, r_before, change)[:, None, None, None], farthest
                    )
                losses.append((gradient * x).sum() / (len(batch) * n_passes * n_steps))
                measures |= _pass_measures(number, r.detach(), problem.forces, change, change < 0)
            pool.advance(batch, x.detach())
            since.insert(0, x)
        return Turn(torch.stack(losses).sum(), x.detach(), r.detach(), problem.forces, measures)


def _limit(displaced: Tensor, farthest: Tensor) -> None:
    """Let no sample's gradient that comes back to a tensor be too large, or not finite."""
    if displaced.requires_grad:
        displaced.register_hook(lambda gradient: limited(gradient, farthest))


@torch.no_grad()
def _pass_measures(
    number: int, residual: Tensor, forces: Tensor, change: Tensor, accepted: Tensor
) -> dict[str, float]:
    """Plain numbers of one pass."""
    relative = relative_residual(residual, forces).nan_to_num(nan=1e6).clamp(max=1e6)
    values = torch.stack(
        (
            change.nan_to_num(nan=0.0).clamp(-1e6, 1e6).median(),
            accepted.double().mean(),
            *relative.double().quantile(relative.new_tensor([0.1, 0.5, 0.9]).double()),
        )
    )
    names = ("potential change", "accepted", "residual 0.1", "residual 0.5", "residual 0.9")
    return {f"pass {number}/{name}": v for name, v in zip(names, values.tolist(), strict=True)}
