"""Moves that lower the potential of a step: along a displacement, and among all points of the step so far."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from toile.physics.surrogate.problem import StepProblem

# A displacement may be stretched up to this factor where Φ is flatter than was thought.
_LONGEST_STEP = 2.0
# A step that is right to this fraction is taken as it is.
_CLOSE_TO_WHOLE = 0.1
# Points closer than this [edges, norm of all vertices] say nothing in single precision.
_CLOSEST = 1e-7
# A direction of which the newer ones leave less than this share of its curvature says nothing new.
_LEAST_CURVATURE = 1e-6


@dataclass(frozen=True)
class Visited:
    """The points of one step, the first of which stands still, and the out-of-balance forces there.

    Attributes:
        points: (B, H, W, 3) each; the last is where the step is.
        forces: (B, H, W, 3) each.
    """

    points: tuple[Tensor, ...]
    forces: tuple[Tensor, ...]

    @property
    def last(self) -> tuple[Tensor, Tensor]:
        """Where the step is, and the force there."""
        return self.points[-1], self.forces[-1]

    def then(self, point: Tensor, force: Tensor) -> Visited:
        """With one more point."""
        return Visited((*self.points, point), (*self.forces, force))

    def detached(self) -> Visited:
        """The same without a graph."""
        return Visited(*(tuple(t.detach() for t in kind) for kind in (self.points, self.forces)))


def descend(
    problem: StepProblem, x: Tensor, r: Tensor, displacement: Tensor, halvings: int
) -> tuple[Tensor, Tensor]:
    """Move along the displacement, farther or less far where that is better, and only where Φ falls.

    Args:
        problem: the step.
        x: positions before, (B, H, W, 3).
        r: out-of-balance force there.
        displacement: (B, H, W, 3).
        halvings: of the displacement at most; where Φ still rises, it is left out.
    """
    ahead = problem.residual(x + displacement)
    along, curvature = (dot(displacement, f) for f in (r, r - ahead))
    length = _ratio(along, curvature).clamp(0.0, _LONGEST_STEP)
    length = torch.where((length - 1).abs() <= _CLOSE_TO_WHOLE, 1.0, length)
    for _ in range(halvings + 1):
        trial = x + wide(length) * displacement
        r_trial = ahead if bool((length == 1).all()) else problem.residual(trial)
        lower = change(trial - x, r, r_trial) <= 0
        if bool(lower.all()):
            break
        length = torch.where(lower, length, 0.5 * length)
    return torch.where(wide(lower), trial, x), torch.where(wide(lower), r_trial, r)


def lowest_among(problem: StepProblem, visited: Visited) -> Visited:
    """Move to where Φ is lowest among all combinations of the points so far, and only where it falls.

    Between points, the differences of forces are those of displacements times the Hessian, so that the
    quadratic model in their span is known without another force (as in Anderson acceleration, and as in
    conjugate gradients preconditioned by whatever moved the points). As standing still is one of them, Φ no
    longer falls along the whole displacement of the step. Where Φ is convex along it, a step of backward
    Euler then loses at least the energy ½ ‖v' - v‖²_M under steady forces: cloth comes to rest, whatever the
    weights are.

    Args:
        problem: the step.
        visited: at least two points.
    """
    x, r = visited.last
    # Pinned vertices are the same in all points.
    displacements = torch.stack([(p - x).flatten(1) for p in visited.points[:-1]], 1)
    changes = torch.stack([(r - f).flatten(1) for f in visited.forces[:-1]], 1).double()
    curvature = displacements @ changes.transpose(1, 2)
    slope = displacements @ r.flatten(1)[..., None].double()
    size = torch.linalg.vector_norm(displacements.detach(), dim=2)
    own = curvature.diagonal(dim1=1, dim2=2)
    usable = torch.isfinite(size) & (size > _CLOSEST) & torch.isfinite(own) & torch.isfinite(slope[..., 0])
    if not bool(usable.all()):
        # Not finite times zero is not zero.
        displacements = torch.where(usable[..., None], displacements, 0.0)
        curvature = torch.where(usable[..., None] & usable[:, None, :], curvature, 0.0)
        slope = torch.where(usable[..., None], slope, 0.0)
    scale = torch.where(usable, 1.0 / size, 0.0)[..., None]
    curvature = scale * (0.5 * (curvature + curvature.transpose(1, 2))) * scale.transpose(1, 2)
    along = scale * _lowest(curvature, scale * slope)
    step = (along.transpose(1, 2) @ displacements).view_as(x)
    trial = x + step
    force = problem.residual(trial)
    lower = wide(change(step, r, force) <= 0)
    return visited.then(torch.where(lower, trial, x), torch.where(lower, force, r))


def _lowest(curvature: Tensor, slope: Tensor) -> Tensor:
    """Coefficients (B, m, 1) of the lowest point of the model, by the directions along which it curves up.

    The inverse is a constant; the derivative comes from the defect of the solution, which is zero. Which
    directions are left out is a choice and has no derivative.
    """
    with torch.no_grad():
        kept = _curving_up(curvature)
        pairs = kept[:, :, None] & kept[:, None, :]
        inverse = torch.linalg.inv(torch.where(pairs, curvature, torch.eye(kept.shape[1]).to(curvature)))
        inverse = torch.where(pairs, inverse, 0.0)
        found = inverse @ slope
    defect = slope - curvature @ found
    return found + inverse @ (defect - defect.detach())


def _curving_up(curvature: Tensor) -> Tensor:
    """Which directions are kept, (B, m): from the newest on, those that bend up beside the newer ones."""
    rest = curvature.clone()
    own = curvature.diagonal(dim1=1, dim2=2)
    kept = torch.zeros_like(own, dtype=torch.bool)
    for j in reversed(range(own.shape[1])):
        pivot = rest[:, j, j]
        kept[:, j] = (pivot > _LEAST_CURVATURE * own[:, j]) & (pivot > 0)
        row = torch.where(kept[:, j, None], rest[:, j] / pivot[:, None], 0.0)
        rest = rest - row[:, :, None] * rest[:, j, None, :]
    return kept


def _ratio(along: Tensor, curvature: Tensor) -> Tensor:
    """Their ratio, 1 where both vanish; where there is no curvature, it has no derivative."""
    curved = curvature != 0
    straight = (along / curvature).detach().nan_to_num(nan=1.0)
    return torch.where(curved, along / torch.where(curved, curvature, 1.0), straight)


def wide(per_sample: Tensor) -> Tensor:
    """One number per sample (B,) as (B, 1, 1, 1)."""
    return per_sample[:, None, None, None]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product of every sample, (B,) float64."""
    return (a.double() * b.double()).sum((1, 2, 3))


def change(displacement: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Change of Φ along a displacement by the trapezoidal rule; no digits are lost between large energies.

    Args:
        displacement: (B, H, W, 3).
        before: out-of-balance force where it begins.
        after: where it ends.

    Returns:
        (B,) float64, infinite where it is not finite.
    """
    found = -0.5 * dot(displacement, before + after)
    return torch.nan_to_num(found, nan=torch.inf, posinf=torch.inf, neginf=torch.inf)
