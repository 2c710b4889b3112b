"""Passes of the network over one step, each checked against the potential it is to lower."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from toile.physics.surrogate.descent import Visited, change, descend, lowest_among, wide
from toile.physics.surrogate.network import GatedUNet
from toile.physics.surrogate.problem import StepProblem

STEP = "lowest among its points"
"""What surrounds the network in a step; renamed where it computes something else, so that what was measured
with another one is measured again."""

# Eq. 4 is rescaled per sample by its own change, but not below this share of what a step along the local
# stiffness would gain: a sample that is already solved must not shout.
_LEAST_SHARE = 0.2
# Largest gradient of one sample with respect to its displacements, in units of the rescaled loss.
_LARGEST_GRADIENT = 3.0


@dataclass(frozen=True)
class Pass:
    """One pass of the network, for training.

    The gradient of Eq. 4 with respect to the displacement is known in closed form (minus the out-of-balance
    force), so that the loss needs no derivative of the physics: its gradient with respect to the weights is
    that of ``(gradient * correction).sum()``.

    Attributes:
        correction: the network's displacement (B, H, W, 3), differentiable in the weights.
        gradient: of the rescaled Eq. 4 with respect to it, detached, (B, H, W, 3).
        positions: after the pass, (B, H, W, 3).
        residual: out-of-balance force there, (B, H, W, 3).
        potential_change: of Φ, (B,); negative is good.
        accepted: whether the pass lowered Φ, (B,); where not, positions are those before it.
    """

    correction: Tensor
    gradient: Tensor
    positions: Tensor
    residual: Tensor
    potential_change: Tensor
    accepted: Tensor


class Surrogate(nn.Module):
    """The network and what surrounds it in a step: start, line relaxation, acceptance, the lowest point.

    Args:
        widths: see GatedUNet.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.network = GatedUNet(widths)

    @torch.no_grad()
    def solve(
        self, problem: StepProblem, n_passes: int, sweeps: int = 1, halvings: int = 3
    ) -> tuple[Tensor, Tensor]:
        """Approximate minimiser of Φ and the out-of-balance force there, (B, H, W, 3) each.

        Every pass of the network is followed by ``sweeps`` relaxations of the warp and the weft lines, and
        these by the lowest point among all of the step so far.

        Φ never ends above its value at the best start: a displacement that would raise it is halved up to
        ``halvings`` times and then left out.
        """
        return self.unrolled(problem, n_passes, sweeps, halvings)

    def unrolled(
        self, problem: StepProblem, n_passes: int, sweeps: int, halvings: int = 3
    ) -> tuple[Tensor, Tensor]:
        """The same with a graph: differentiable in all that a DifferentiableStepProblem holds."""
        visited = self.begin(problem, halvings)
        for _ in range(n_passes):
            correction = self.network(problem, *visited.last)
            visited = self.improve(problem, visited, correction, sweeps, halvings)
        return visited.last

    def begin(self, problem: StepProblem, halvings: int = 3) -> Visited:
        """Standing still, the best start, its lines settled, and the lowest point among these."""
        still, best = problem.starts[:, 0], problem.best_start()
        visited = Visited((still, best), (problem.residual(still), problem.residual(best)))
        return lowest_among(problem, self._settle(problem, visited, halvings))

    def improve(
        self, problem: StepProblem, visited: Visited, correction: Tensor, sweeps: int, halvings: int = 3
    ) -> Visited:
        """What a pass does with the network's displacement.

        Args:
            problem: the step.
            visited: points before it.
            correction: of the network, (B, H, W, 3).
            sweeps: relaxations of the lines behind it.
            halvings: of every displacement, see ``solve``.
        """
        visited = visited.then(*descend(problem, *visited.last, correction, halvings))
        for _ in range(sweeps):
            visited = self._settle(problem, visited, halvings)
        return lowest_among(problem, visited)

    def _settle(self, problem: StepProblem, visited: Visited, halvings: int) -> Visited:
        """Warp lines, then weft lines, each for itself: what is stiff along a line needs no learning."""
        x, r = visited.last
        for axis in (0, 1):
            x, r = descend(problem, x, r, problem.line_step(x, r, axis), halvings)
        return visited.then(x, r)

    def passes(self, problem: StepProblem, n_passes: int) -> Iterator[Pass]:
        """Passes for training; the gradient of each is for its own displacement only."""
        with torch.no_grad():
            x, r = self._begin(problem)
        for _ in range(n_passes):
            correction = self.network(problem, x, r)
            with torch.no_grad():
                result = self._judge(problem, x, r, correction)
            yield result
            x, r = result.positions, result.residual

    def _begin(self, problem: StepProblem) -> tuple[Tensor, Tensor]:
        x = problem.best_start()
        r = problem.residual(x)
        settled = x + problem.relaxation(x, r)
        r_settled = problem.residual(settled)
        lower = wide(change(settled - x, r, r_settled) <= 0)
        return torch.where(lower, settled, x), torch.where(lower, r_settled, r)

    def _judge(self, problem: StepProblem, x: Tensor, r: Tensor, correction: Tensor) -> Pass:
        moved = x + correction
        r_moved = problem.residual(moved)
        relaxation = problem.relaxation(moved, r_moved)
        settled = moved + relaxation
        r_settled = problem.residual(settled)
        own = change(correction, r, r_moved)
        total = own + change(relaxation, r_moved, r_settled)
        # Through the relaxation x + T r(x) the gradient is (I - H T) times the one behind it; the Hessian
        # acts by a central difference.
        direction = problem.relaxation(moved, r_settled)
        step = 1e-2 / (direction.flatten(1).norm(dim=1)[:, None, None, None] + 1e-9)
        ahead, behind = (problem.residual(moved + s * step * direction) for s in (1.0, -1.0))
        through = -r_settled - (ahead - behind) / (2 * step)
        good = (total < 0) & _finite(settled)
        gained = torch.where(torch.isfinite(total), total, own)
        gradient = torch.where(wide(_finite(through)), through, -r_moved)
        gradient = gradient / wide(loss_scale(problem, r, gained))
        gradient = limited(gradient, reach(problem, r, correction))
        return Pass(
            correction=correction,
            gradient=gradient,
            positions=torch.where(wide(good), settled, x),
            residual=torch.where(wide(good), r_settled, r),
            potential_change=gained,
            accepted=good,
        )


def loss_scale(problem: StepProblem, residual: Tensor, change: Tensor) -> Tensor:
    """What Eq. 4 is divided by in training, (B,).

    Args:
        problem: the step.
        residual: out-of-balance force before the pass, (B, H, W, 3).
        change: of Φ by the pass, (B,).
    """
    return torch.maximum(change.abs(), _LEAST_SHARE * _local_gain(problem, residual)) + 1e-12


def reach(problem: StepProblem, residual: Tensor, correction: Tensor) -> Tensor:
    """How far a pass goes at least, (B,): its own displacement, and one along the local stiffness."""
    return correction.detach().flatten(1).norm(dim=1) + _local_displacement(problem, residual)


def limited(gradient: Tensor, farthest: Tensor) -> Tensor:
    """Gradient of the rescaled loss, (B, H, W, 3), such that no sample shouts; zero where it is not finite.

    Args:
        gradient: with respect to displacements.
        farthest: size of these, (B,).
    """
    usable = _finite(gradient) & torch.isfinite(farthest)
    gradient = torch.where(wide(usable), gradient, torch.zeros_like(gradient))
    size = gradient.flatten(1).norm(dim=1) * torch.where(usable, farthest, 0.0)
    return gradient * wide(_LARGEST_GRADIENT / size.clamp(min=_LARGEST_GRADIENT)).to(gradient.dtype)


def _finite(tensor: Tensor) -> Tensor:
    return torch.isfinite(tensor).flatten(1).all(1)


def _local_stiffness(problem: StepProblem) -> Tensor:
    """Rough diagonal of the Hessian for motions out of the plane, (B, 1, 1, 1)."""
    return 1.0 + 12.0 * problem.stiffness[:, 2, None, None, None]


def _local_gain(problem: StepProblem, residual: Tensor) -> Tensor:
    """What a step along the local stiffness would gain, (B,)."""
    in_plane = 1.0 + 2.0 * problem.stiffness[:, 0, None, None, None]
    # Without frames at hand: a third of the force taken as out of the plane, the rest as in it.
    share = residual.square() * (1.0 / (3.0 * _local_stiffness(problem)) + 2.0 / (3.0 * in_plane))
    return 0.5 * share.sum((1, 2, 3))


def _local_displacement(problem: StepProblem, residual: Tensor) -> Tensor:
    """Norm of the displacement along the local stiffness, (B,)."""
    return (residual / _local_stiffness(problem)).flatten(1).norm(dim=1)
