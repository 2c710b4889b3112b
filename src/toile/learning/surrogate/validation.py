"""A short rollout of cloths that are always the same."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toile.learning.surrogate.pool import Pool, PoolSettings
from toile.learning.surrogate.resets import relative_residual
from toile.limits import Count, Seed
from toile.physics.surrogate.surrogate import Surrogate


@dataclass(frozen=True)
class ValidationSettings:
    """The rollout after every epoch.

    Attributes:
        size: number of cloths, drawn as those of the pool are.
        steps: time steps from rest.
        n_passes: passes of the network per step.
        seed: of the cloths and their forces.
        sweeps: relaxations of the lines after each pass.
    """

    size: Count
    steps: Count
    n_passes: Count
    seed: Seed
    sweeps: Count = 1


@torch.no_grad()
def validation_rollout(
    surrogate: Surrogate, pool: PoolSettings, settings: ValidationSettings, device: torch.device
) -> Tensor:
    """Move cloths from rest by the network alone.

    Args:
        surrogate: the network.
        pool: distribution of the cloths; without its noise.
        settings: how many, how long.
        device: of the network.

    Returns:
        Mean out-of-balance force / mean external force after every step, (steps, size).
    """
    generator = torch.Generator(device).manual_seed(settings.seed)
    cloths = Pool(replace(pool, size=settings.size, noise_share=0.0), generator)
    everyone = torch.arange(settings.size, device=device)
    curve = []
    for _ in range(settings.steps):
        problem = cloths.problem(everyone)
        positions, residual = surrogate.solve(problem, settings.n_passes, settings.sweeps)
        cloths.advance(everyone, positions)
        curve.append(relative_residual(residual, problem.forces))
    return torch.stack(curve)
