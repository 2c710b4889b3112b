"""Passes of the network over one step, each checked against the potential it is to lower."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from toile.physics.surrogate.network import GatedUNet
from toile.physics.surrogate.problem import StepProblem

# Eq. 4 is rescaled per sample by its own change, but not below this share of what a step along the local
# stiffness would gain: a sample that is already solved must not shout.
_LEAST_SHARE = 0.2
# A displacement may be stretched up to this factor where Φ is flatter than the network thought.
_LONGEST_STEP = 2.0
# A step that is right to this fraction is taken as it is.
_CLOSE_TO_WHOLE = 0.1
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
    """The network and what surrounds it in a step: choice of the start, line relaxation, acceptance.

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

        Every pass of the network is followed by ``sweeps`` relaxations of the warp and the weft lines.

        Φ never ends above its value at the best start: a displacement that would raise it is halved up to
        ``halvings`` times and then left out.
        """
        return self.unrolled(problem, n_passes, sweeps, halvings)

    def unrolled(
        self, problem: StepProblem, n_passes: int, sweeps: int, halvings: int = 3
    ) -> tuple[Tensor, Tensor]:
        """The same with a graph: differentiable in all that a DifferentiableStepProblem holds."""
        x, r = self.begin(problem, halvings)
        for _ in range(n_passes):
            x, r = self.improve(problem, x, r, self.network(problem, x, r), sweeps, halvings)
        return x, r

    def begin(self, problem: StepProblem, halvings: int = 3) -> tuple[Tensor, Tensor]:
        """Where the first pass starts: the best start, settled; positions and out-of-balance force."""
        x = problem.best_start()
        return self._settle(problem, x, problem.residual(x), halvings)

    def improve(
        self, problem: StepProblem, x: Tensor, r: Tensor, correction: Tensor, sweeps: int, halvings: int = 3
    ) -> tuple[Tensor, Tensor]:
        """What a pass does with the network's displacement: positions and out-of-balance force after it.

        Args:
            problem: the step.
            x: positions before, (B, H, W, 3).
            r: out-of-balance force there.
            correction: of the network, (B, H, W, 3).
            sweeps: relaxations of the lines behind it.
            halvings: of every displacement, see ``solve``.
        """
        x, r = _descend(problem, x, r, correction, halvings)
        for _ in range(sweeps):
            x, r = self._settle(problem, x, r, halvings)
        return x, r

    def _settle(self, problem: StepProblem, x: Tensor, r: Tensor, halvings: int) -> tuple[Tensor, Tensor]:
        """Warp lines, then weft lines, each for itself: what is stiff along a line needs no learning."""
        for axis in (0, 1):
            x, r = _descend(problem, x, r, problem.line_step(x, r, axis), halvings)
        return x, r

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
        lower = _wide(_change(settled - x, r, r_settled) <= 0)
        return torch.where(lower, settled, x), torch.where(lower, r_settled, r)

    def _judge(self, problem: StepProblem, x: Tensor, r: Tensor, correction: Tensor) -> Pass:
        moved = x + correction
        r_moved = problem.residual(moved)
        relaxation = problem.relaxation(moved, r_moved)
        settled = moved + relaxation
        r_settled = problem.residual(settled)
        own = _change(correction, r, r_moved)
        total = own + _change(relaxation, r_moved, r_settled)
        # Through the relaxation x + T r(x) the gradient is (I - H T) times the one behind it; the Hessian
        # acts by a central difference.
        direction = problem.relaxation(moved, r_settled)
        step = 1e-2 / (direction.flatten(1).norm(dim=1)[:, None, None, None] + 1e-9)
        ahead, behind = (problem.residual(moved + s * step * direction) for s in (1.0, -1.0))
        through = -r_settled - (ahead - behind) / (2 * step)
        good = (total < 0) & _finite(settled)
        change = torch.where(torch.isfinite(total), total, own)
        gradient = torch.where(_wide(_finite(through)), through, -r_moved)
        gradient = gradient / _wide(loss_scale(problem, r, change))
        gradient = limited(gradient, reach(problem, r, correction))
        return Pass(
            correction=correction,
            gradient=gradient,
            positions=torch.where(_wide(good), settled, x),
            residual=torch.where(_wide(good), r_settled, r),
            potential_change=change,
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
    gradient = torch.where(_wide(usable), gradient, torch.zeros_like(gradient))
    size = gradient.flatten(1).norm(dim=1) * torch.where(usable, farthest, 0.0)
    return gradient * _wide(_LARGEST_GRADIENT / size.clamp(min=_LARGEST_GRADIENT)).to(gradient.dtype)


def _descend(
    problem: StepProblem, x: Tensor, r: Tensor, displacement: Tensor, halvings: int
) -> tuple[Tensor, Tensor]:
    """Move along the displacement, farther or less far where that is better, and only where Φ falls."""
    ahead = problem.residual(x + displacement)
    along, curvature = (_dot(displacement, f) for f in (r, r - ahead))
    length = _ratio(along, curvature).clamp(0.0, _LONGEST_STEP)
    length = torch.where((length - 1).abs() <= _CLOSE_TO_WHOLE, 1.0, length)
    for _ in range(halvings + 1):
        trial = x + _wide(length) * displacement
        r_trial = ahead if bool((length == 1).all()) else problem.residual(trial)
        lower = _change(trial - x, r, r_trial) <= 0
        if bool(lower.all()):
            break
        length = torch.where(lower, length, 0.5 * length)
    return torch.where(_wide(lower), trial, x), torch.where(_wide(lower), r_trial, r)


def _ratio(along: Tensor, curvature: Tensor) -> Tensor:
    """Their ratio, 1 where both vanish; where there is no curvature, it has no derivative."""
    curved = curvature != 0
    straight = (along / curvature).detach().nan_to_num(nan=1.0)
    return torch.where(curved, along / torch.where(curved, curvature, 1.0), straight)


def _wide(per_sample: Tensor) -> Tensor:
    return per_sample[:, None, None, None]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product of every sample, (B,) float64."""
    return (a.double() * b.double()).sum((1, 2, 3))


def _finite(tensor: Tensor) -> Tensor:
    return torch.isfinite(tensor).flatten(1).all(1)


def _change(displacement: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Change of Φ along a displacement by the trapezoidal rule; no digits are lost between large energies."""
    change = -0.5 * _dot(displacement, before + after)
    return torch.nan_to_num(change, nan=torch.inf, posinf=torch.inf, neginf=torch.inf)


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
