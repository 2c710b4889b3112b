"""Measures of a reconstruction: the truth is perfect, and the translation is not given away."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toile.capture.metrics.reconstruction import MeasuredClip, Reconstruction, combined
from toile.errors import InputError
from toile.rendering.warp.renderer import WarpRenderer


@pytest.fixture(scope="module")
def clip(tiny_clip: Any) -> MeasuredClip:
    folder: Path = tiny_clip.folder
    return MeasuredClip.load(folder, WarpRenderer(2))


@pytest.fixture(scope="module")
def truth(clip: MeasuredClip) -> Reconstruction:
    return Reconstruction(clip.true_garment, clip.truth.body_positions, clip.truth.landmarks)


def test_the_truth_has_no_error(clip: MeasuredClip, truth: Reconstruction) -> None:
    found = clip.measure(truth)
    assert found.mpjpe_mm == pytest.approx(0.0, abs=1e-3)
    assert found.vertex_error_mm == pytest.approx(0.0, abs=1e-3)
    assert found.iou_all > 0.99
    assert found.penetration_max_mm == 0.0
    share = float(clip.visible.double().mean())
    assert 0.3 < share < 0.7


def test_translation_is_not_given_away(clip: MeasuredClip, truth: Reconstruction) -> None:
    """A perfect pose 10 cm too far to the left: measured with the translation found it is 10 cm off."""
    away = truth.shifted(np.tile([0.1, 0.0, 0.0], (clip.truth.n_frames, 1)))
    found = clip.measure(away)
    assert found.mpjpe_mm == pytest.approx(100.0, abs=0.01)
    assert found.vertex_error_mm == pytest.approx(100.0, abs=0.01)
    assert found.vertex_error_visible_mm == pytest.approx(100.0, abs=0.01)
    assert found.iou_single < 0.8
    assert found.mpjpe_true_translation_mm == pytest.approx(0.0, abs=1e-3)
    assert found.vertex_error_true_translation_mm == pytest.approx(0.0, abs=1e-3)
    assert found.iou_single_true_translation > 0.99


def test_shaking_translation_is_force_unless_it_is_the_true_one(
    clip: MeasuredClip, truth: Reconstruction
) -> None:
    shaking = np.zeros((clip.truth.n_frames, 3))
    shaking[1::2, 0] = 0.5
    plain, found = clip.measure(truth), clip.measure(truth.shifted(shaking))
    # 2 · 50 cm · 30² / s² is 90 times the weight.
    assert found.out_of_balance_avg > plain.out_of_balance_avg + 10.0
    assert found.out_of_balance_avg_true_translation == pytest.approx(plain.out_of_balance_avg, rel=1e-6)


def test_visible_and_hidden_vertices_apart(clip: MeasuredClip, truth: Reconstruction) -> None:
    bent = truth.garment.copy()
    bent[clip.visible.numpy()] += np.array([0.0, 0.0, 0.01])
    found = clip.measure(replace(truth, garment=bent))
    assert found.vertex_error_visible_mm == pytest.approx(10.0, abs=0.01)
    assert found.vertex_error_hidden_mm == pytest.approx(0.0, abs=1e-3)


def test_clips_together(clip: MeasuredClip, truth: Reconstruction) -> None:
    one = clip.measure(truth)
    other = replace(one, penetration_max_mm=9.0, mpjpe_mm=4.0, iou_reference=math.nan)
    both = combined([one, other])
    assert both.penetration_max_mm == 9.0
    assert both.mpjpe_mm == pytest.approx((one.mpjpe_mm + 4.0) / 2)
    assert both.iou_reference == one.iou_reference
    assert asdict(combined([one])) == pytest.approx(asdict(one))


def test_another_garment_and_another_view_are_refused(clip: MeasuredClip, truth: Reconstruction) -> None:
    with pytest.raises(InputError, match="does not fit the clip"):
        clip.measure(replace(truth, garment=truth.garment[:, 1:]))
    with pytest.raises(InputError, match="No such view"):
        MeasuredClip(clip.truth, clip.recording, clip.subject, clip.garment, WarpRenderer(2), 7)
