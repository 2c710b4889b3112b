"""Small steps with everything in them: bent cloth, scattered rest lengths, pinned corners, uneven forces."""

import pytest
import torch

from toile.physics.surrogate.problem import StepProblem
from toile.physics.surrogate.surrogate import Surrogate


def grid_positions(height, width, batch):
    i, j = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    flat = torch.stack((j, i, torch.zeros_like(i)), -1).double()
    return flat.repeat(batch, 1, 1, 1)


def make_problem(height=9, width=8, batch=3, seed=0, bent=0.5):
    g = torch.Generator().manual_seed(seed)
    x = grid_positions(height, width, batch)
    amplitude = bent * torch.rand(batch, 1, 1, generator=g).double()
    x[..., 2] = amplitude * torch.sin(0.7 * x[..., 0] + 0.4 * x[..., 1])
    x = x + 0.02 * bent * torch.randn(x.shape, generator=g).double()
    masses = torch.ones(height, width)
    masses[[0, -1]] *= 0.5
    masses[:, [0, -1]] *= 0.5
    free = torch.ones(batch, height, width)
    free[:, 0, 0] = 0.0
    free[0, 0, -1] = 0.0
    forces = 0.1 * torch.randn(batch, height, width, 3, generator=g) * masses[..., None]
    velocity = 0.1 * torch.randn(batch, 1, 1, 3, generator=g).double()
    starts = torch.stack((x, torch.where(free[..., None] > 0, x + velocity, x)), 1)
    return StepProblem(
        prediction=x + velocity,
        starts=starts,
        forces=forces,
        stiffness=torch.tensor([[1000.0, 1.0, 0.1], [50.0, 0.1, 1.0], [5000.0, 5.0, 0.01]])[:batch],
        masses=masses,
        free=free,
        rest_lengths_i=1 + 0.02 * torch.randn(batch, height - 1, width, generator=g),
        rest_lengths_j=1 + 0.02 * torch.randn(batch, height, width - 1, generator=g),
    )


@pytest.fixture
def problem():
    return make_problem()


@pytest.fixture
def surrogate():
    """A network that says something: random heads instead of silent ones."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        surrogate = Surrogate((8, 8))
        for head in (*surrogate.network.heads, surrogate.network.vertex_head):
            torch.nn.init.normal_(head.weight, std=0.05)
    return surrogate
