"""Smoothing over frames: constants stay, whole turns do not matter, noise shrinks by what the weights say."""

from __future__ import annotations

import math

import pytest
import torch

from toile.capture.body.limits import rotation_of_angles
from toile.capture.prediction import Prediction
from toile.capture.test_time.smoothing import (
    SmoothingSettings,
    smoothed,
    smoothed_angles,
    smoothed_values,
)
from toile.errors import InputError
from toile.geometry.camera import Camera


def test_line_stays_a_line_and_the_ends_use_what_is_there() -> None:
    line = torch.arange(9, dtype=torch.float64)[:, None] * torch.tensor([1.0, -2.0], dtype=torch.float64)
    found = smoothed_values(line, SmoothingSettings())
    torch.testing.assert_close(found[2:-2], line[2:-2])
    # Of the first frame only the later half of the filter is there.
    w = SmoothingSettings().weights()[2:]
    assert float(found[0, 0]) == pytest.approx(float((w * torch.arange(3)).sum() / w.sum()))


def test_fewer_frames_than_the_filter() -> None:
    values = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    found = smoothed_values(values, SmoothingSettings(frames=7))
    assert bool(torch.isfinite(found).all())
    assert 1.0 < float(found[0]) < float(found[1]) < 3.0
    torch.testing.assert_close(smoothed_values(values[:1], SmoothingSettings()), values[:1])


def test_noise_shrinks_as_the_weights_say() -> None:
    noise = torch.randn(20_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = float(SmoothingSettings().weights().square().sum().sqrt())
    assert float(smoothed_values(noise, SmoothingSettings()).std()) == pytest.approx(expected, rel=0.03)


def test_whole_turns_do_not_matter() -> None:
    """A person that turns on past half a turn: angles jump from π to -π between two frames."""
    turn = torch.linspace(2.7, 3.6, 10, dtype=torch.float64)
    angles = torch.stack((torch.zeros(10), torch.zeros(10), turn), -1)
    wrapped = angles.clone()
    wrapped[:, 2] = torch.where(turn > math.pi, turn - 2 * math.pi, turn)
    assert bool((wrapped[1:, 2] - wrapped[:-1, 2] < -6).any())
    found = rotation_of_angles(smoothed_angles(wrapped, SmoothingSettings()))
    torch.testing.assert_close(found[2:-2], rotation_of_angles(angles)[2:-2], atol=1e-9, rtol=0)
    torch.testing.assert_close(
        rotation_of_angles(smoothed_angles(angles + 2 * math.pi, SmoothingSettings())), found
    )


def test_prediction_without_deformation_and_a_filter_of_one_frame() -> None:
    generator = torch.Generator().manual_seed(1)
    camera = Camera(100.0, 100.0, 64.0, 64.0, 128, 128)
    angles = 0.3 * torch.randn(6, 4, 3, generator=generator, dtype=torch.float64)
    place = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    prediction = Prediction(angles, angles[:, 0], None, None, place, camera, 30.0)
    assert smoothed(prediction, SmoothingSettings(frames=1)) is prediction
    found = smoothed(prediction)
    assert found.A is None
    assert float(found.translation.diff(dim=0).norm()) < 0.7 * float(place.diff(dim=0).norm())


def test_even_filter_is_refused() -> None:
    with pytest.raises(InputError, match="odd"):
        SmoothingSettings(frames=4)
