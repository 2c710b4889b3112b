from __future__ import annotations

import pytest
import torch

from toile.generation.motion import PinnedMotion, Shake, Still, Swing


@pytest.mark.parametrize("motion", [Still(), Swing(), Shake()])
def test_starts_at_rest_and_is_smooth(motion: PinnedMotion) -> None:
    step = 1e-4
    times = step * torch.arange(10001, dtype=torch.float64)
    d = motion.displacement(times)
    assert d.shape == (10001, 3)
    assert torch.equal(d[0], torch.zeros(3, dtype=torch.float64))
    velocity = d.diff(dim=0) / step
    assert float(velocity[0].norm()) < 1e-3
    # No jump of the velocity anywhere: the acceleration stays below 30 m/s².
    assert float(velocity.diff(dim=0).norm(dim=-1).max()) / step < 30


def test_swing_reaches_its_amplitude_and_returns() -> None:
    motion = Swing(amplitude=(0.1, 0.0, -0.2), period=2.0)
    d = motion.displacement(torch.tensor([1.0, 2.0], dtype=torch.float64))
    torch.testing.assert_close(d[0], torch.tensor([0.1, 0.0, -0.2], dtype=torch.float64))
    torch.testing.assert_close(d[1], torch.zeros(3, dtype=torch.float64))


def test_shake_is_a_sine_once_faded_in() -> None:
    motion = Shake(amplitude=(0.01, 0.0, 0.0), frequency=2.0, fade_in=0.5)
    t = torch.tensor([1.125], dtype=torch.float64)  # a quarter period after two whole ones
    assert float(motion.displacement(t)[0, 0]) == pytest.approx(0.01)
