"""The effect that docs/extending.md makes, taken from there and used."""

import re
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from toile.diagnosis.effect_sensitivities import Instant, force_sensitivities
from toile.diagnosis.sensitivities import StepForces
from toile.effects.base import Effect, Surroundings
from toile.effects.setting import setting
from toile.errors import InputError
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

DOCS = Path(__file__).parents[2] / "docs" / "extending.md"
FRAMES, FPS, SUBSTEPS, SIDE = 6, 25.0, 4, 0.4
GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def documented() -> type[Effect]:
    found = re.search(
        r"<!-- example: effects/buoyancy.py -->\n```python\n(.*?)```", DOCS.read_text(), re.DOTALL
    )
    assert found is not None
    module = types.ModuleType("buoyancy")
    exec(found[1], module.__dict__)
    return module.Buoyancy


def fall(*effects: Effect) -> torch.Tensor:
    """Heights fallen (F, N) [m] by a flat cloth that nothing holds."""
    around = Surroundings(grid_cloth((4, 4), (SIDE, SIDE), 0.2, ()), (SIDE, SIDE), GRAVITY, FPS, FRAMES)
    given = setting(effects, around, torch.zeros(FRAMES, 0, 3, dtype=torch.float64))
    line = torch.linspace(0, SIDE, 4, dtype=torch.float64)
    i, j = torch.meshgrid(line, line, indexing="ij")
    start = torch.stack((i, torch.zeros_like(i), 1 + j), -1).reshape(1, -1, 3)
    step = float(given.frame_interval) / SUBSTEPS
    simulator = ImplicitSimulator(given.cloth, step, BDF2(), NewtonSettings(tolerance=1e-11), given.terms)
    material = grid_material(*(torch.tensor([k], dtype=torch.float64) for k in (60.0, 3e-4, 2e-5)))
    state = State.start(start, torch.zeros_like(start), step, simulator.n_past)
    motion = rollout(simulator, state, material, given.forces[None], given.boundary[None], SUBSTEPS)
    return motion.positions[0, :, :, 1]


def test_the_cloth_falls_by_so_much_less(documented: type[Effect]) -> None:
    plain = fall()
    assert plain[-1].min() > 0.1
    torch.testing.assert_close(fall(documented({"share": 0.3})), 0.7 * plain, rtol=1e-9, atol=1e-10)


def test_nothing_changes_at_zero(documented: type[Effect]) -> None:
    assert torch.equal(fall(documented()), fall())
    with pytest.raises(InputError, match="out of bounds"):
        documented({"share": 0.6})


def test_diagnosis_knows_its_trace(documented: type[Effect]) -> None:
    effect = documented()
    around = Surroundings(grid_cloth((4, 4), (SIDE, SIDE), 0.2, ()), (SIDE, SIDE), GRAVITY, FPS, FRAMES)
    masses = around.cloth.masses.numpy()
    still = np.zeros((len(masses), 3))
    step = StepForces(0, still, still, still, np.zeros((3, *still.shape)), still)
    now = Instant(step, 0.04, 0.01, np.array([60.0, 3e-4, 2e-5]), GRAVITY.numpy(), np.zeros((0, 3)))
    force = force_sensitivities(effect, now, around)
    assert force.shape == (1, *still.shape)
    np.testing.assert_allclose(force[0], -0.05 * masses[:, None] * GRAVITY.numpy(), atol=1e-12)
