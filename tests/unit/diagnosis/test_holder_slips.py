"""Small slips are found in a motion that physics has refined, where nobody moves the holders above all."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from toile.diagnosis.attachment_slip import SlipFit, SlipSettings
from toile.diagnosis.decision import NONE, Calibration
from toile.diagnosis.findings import Finding
from toile.diagnosis.holder_slips import let_go, slip_of, which_slips, with_slips
from toile.diagnosis.joint_fit import JointFit
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_evidence import session_evidence
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import SeenClip
from toile.diagnosis.session_weights import SessionWeights
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.motion_blur import MotionBlur

Array = NDArray[np.float64]
FPS, FRAMES = 50.0, 80
# Two held corners, and one that hangs.
TEMPLATE = np.array([[-0.25, -0.2, 1.2], [0.25, -0.2, 1.3], [0.0, 0.3, 1.2]])
SCENE: Any = SimpleNamespace(
    pinned_vertices=[0, 1], fps=FPS, template=torch.from_numpy(TEMPLATE), cloth_size=(0.5, 0.5)
)
TIMES = np.arange(FRAMES) / FPS
SETTINGS = SessionSettings().slip


def motion(rng: np.random.Generator, slip: float = 0.0, sway: float = 0.0) -> Array:
    """What refining leaves: a millimetre across the rays, three along, of every frame anew.

    Args:
        rng: of the errors.
        slip: distance by which the second corner gives way [m].
        sway: by which two hands move against each other [m].
    """
    found = np.repeat(TEMPLATE[None], FRAMES, 0) + 0.001 * rng.standard_normal((FRAMES, 3, 3)) * [1, 1, 3]
    s = np.clip((TIMES - 0.6) / 0.2, 0, 1)
    found[:, 1] += (s * s * (3 - 2 * s))[:, None] * slip * np.array([-0.8, 0.6, 0.0])
    found[:, 0, 0] += sway * np.sin(2 * np.pi * 0.8 * TIMES)
    return found


def slip_in(positions: Array, *, held_still: bool = True, settings: SlipSettings = SETTINGS) -> SlipFit:
    return slip_of(SCENE, positions, AnchorSlip(), settings, held_still=held_still)


def test_a_centimetre_is_found_where_nobody_moves_the_holders() -> None:
    weights = SessionWeights.load()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        assert slip_in(motion(rng)).log_evidence < 0
        found = slip_in(motion(rng, slip=0.01))
        assert found.log_evidence > weights.slip_threshold + 3 * weights.slip_temperature
        assert 0.02 * found.mean == pytest.approx([-0.008, 0.006, 0.0], abs=0.004)
        assert found.vertex == 1
        assert found.start == pytest.approx(0.6, abs=0.1)
        # A tracker, which jumps, would hardly have said so.
        assert slip_in(motion(rng, slip=0.01), settings=SlipSettings()).log_evidence < 5


def test_hands_that_sway_explain_more() -> None:
    rng = np.random.default_rng(5)
    slipping, swaying = motion(rng, slip=0.015), motion(rng, sway=0.02)
    still, moved = (slip_in(slipping, held_still=held).log_evidence for held in (True, False))
    assert still > moved + 5
    assert slip_in(swaying, held_still=False).log_evidence < 0


def clip(held_still: bool, evidence: float = -3.0) -> Any:
    """A clip in whose tracked motion a slip has so much evidence."""
    of_images = {
        "anchor_slip": Finding(evidence, {"x": 0.0}, {"x": 1.0}),
        "motion_blur": Finding(-1.0, {"fraction": 0.0}, {"fraction": 1.0}),
    }
    return SimpleNamespace(
        problem=SimpleNamespace(scene=SCENE),
        held_still=held_still,
        seen=SimpleNamespace(findings=of_images),
    )


def test_the_refined_path_takes_the_place_of_the_tracked_one() -> None:
    rng = np.random.default_rng(7)
    clips, paths = [clip(True), clip(False, 40.0)], [motion(rng, slip=0.02), motion(rng)]
    first, second = with_slips(clips, paths, [AnchorSlip(), MotionBlur()], SETTINGS)
    assert first["anchor_slip"].log_evidence > 20
    assert first["anchor_slip"].mean["x"] == pytest.approx(-0.016, abs=0.004)
    assert second["anchor_slip"].log_evidence < 0
    assert which_slips([first, second]) == (0, 1)
    assert which_slips([second, first]) == (1, 1)
    assert which_slips([{}]) == (0, 0)
    # All else is as the images have it.
    assert first["motion_blur"] == clips[0].seen.findings["motion_blur"]
    # No candidate, no finding of its own.
    (as_seen,) = with_slips(clips[:1], paths[:1], [MotionBlur()], SETTINGS)
    assert as_seen == clips[0].seen.findings


def test_hands_that_hold_the_cloth_whatever_the_session_says_may_sway() -> None:
    """A recording of another motion is no slip."""
    path = motion(np.random.default_rng(3), slip=0.015)
    path[:, :2] += 0.03 * np.sin(2 * np.pi * TIMES)[:, None, None] * np.array([0.0, 0.6, 0.0])
    (said_still,), (moved,) = (
        with_slips([clip(held)], [path], [AnchorSlip()], SETTINGS) for held in (True, False)
    )
    assert said_still["anchor_slip"].log_evidence == moved["anchor_slip"].log_evidence
    assert slip_in(path).log_evidence > said_still["anchor_slip"].log_evidence + 5


def test_nothing_is_known_of_slips_where_the_cloth_seems_to_change_its_size() -> None:
    path = motion(np.random.default_rng(7), slip=0.02)
    (found,) = with_slips([clip(True)], [path], [AnchorSlip()], SETTINGS, resized=True)
    assert found["anchor_slip"].log_evidence == 0.0


def test_odds_of_a_slip_are_those_of_its_weights() -> None:
    base = JointFit((), np.zeros(3), np.zeros(0), np.zeros((0, 0)), [], [], 10.0, (10.0,), 0.0, False)
    weights = SessionWeights(slip_threshold=8.0, slip_temperature=2.0)
    found = {"anchor_slip": Finding(14.0, {"x": 0.0}, {"x": 1.0})}
    chances = session_evidence(
        base,
        {},
        [AnchorSlip()],
        [found],
        [0],
        ModelErrors(1.0, 1.0, 1e-4),
        Calibration.load(),
        None,
        weights,
    ).chances
    assert np.log(chances["anchor_slip"] / chances[NONE]) == pytest.approx(3.0)


def test_what_slips_is_let_go_and_what_stays_is_not() -> None:
    rng = np.random.default_rng(7)
    still: Any = SeenClip(SimpleNamespace(scene=SCENE), 0, None, None, held_still=True)  # type: ignore[arg-type]
    moved = replace(still, held_still=False)
    # Both corners carried to the side and back, which nobody has said.
    carried = motion(rng)
    carried[:, :2, 0] += 0.1 * np.sin(2 * np.pi * 0.6 * TIMES)[:, None]
    motions = [motion(rng), motion(rng, slip=0.01), motion(rng, slip=0.01), carried]
    threshold = SessionWeights.load().slip_threshold
    found = let_go([still, still, moved, still], motions, SETTINGS, threshold)
    assert [clip.let_go for clip in found] == [False, True, False, True]
    assert [clip.stays for clip in found] == [True, False, False, False]
    # Nothing else is changed, and what was let go before is looked at anew.
    assert [clip.held_still for clip in found] == [True, True, False, True]
    assert not let_go(found[1:2], motions[:1], SETTINGS, threshold)[0].let_go
