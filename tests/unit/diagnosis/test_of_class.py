"""What a session cannot tell apart is one answer."""

from __future__ import annotations

import pytest

from toile.diagnosis.decision import Calibration
from toile.diagnosis.record import AMBIGUOUS, Verdict
from toile.diagnosis.verdict import VerdictSettings, of_class, verdict_of

SETTINGS = VerdictSettings(named=0.9)
OPEN = Verdict(
    AMBIGUOUS, ("none", "gravity_tilt"), "unknown", 0.93, "This clip cannot tell them apart.", "hang"
)
TILT = ("none", "gravity_tilt")


def test_what_the_base_model_has_is_none() -> None:
    found = of_class(OPEN, {"gravity_tilt": 0.5, "none": 0.43, "gusts": 0.07}, [TILT], SETTINGS)
    assert found.effect == "none"
    assert found.stage == "none"
    assert found.probability == pytest.approx(0.93)
    assert "none or gravity_tilt" in found.reason


def test_the_most_probable_of_causes_that_are_one_is_named() -> None:
    chances = {"gusts": 0.5, "air_drag": 0.45, "none": 0.05}
    found = of_class(OPEN, chances, [("air_drag", "gusts")], SETTINGS)
    assert (found.effect, found.stage) == ("gusts", "actuation")
    assert found.probability == pytest.approx(0.95)


@pytest.mark.parametrize(
    ("chances", "classes"),
    [
        ({"none": 0.3, "gravity_tilt": 0.15, "gusts": 0.55}, [TILT]),
        ({"none": 0.5, "gravity_tilt": 0.1, "gusts": 0.4}, [TILT]),
        ({"gusts": 0.5, "air_drag": 0.35, "none": 0.15}, [("air_drag", "gusts")]),
        ({"none": 0.5, "gravity_tilt": 0.5}, []),
    ],
)
def test_what_is_not_clear_stays_ambiguous(chances: dict[str, float], classes: list[tuple[str, ...]]) -> None:
    assert of_class(OPEN, chances, classes, SETTINGS) == OPEN


def test_a_clear_answer_stays() -> None:
    clear = Verdict("gusts", ("gusts",), "actuation", 0.95, "gusts explains what is missing.", "")
    assert of_class(clear, {"gusts": 0.95, "none": 0.05}, [TILT], SETTINGS) == clear


def test_candidates_that_hold_everything_have_no_more_than_that() -> None:
    """Rounding made 1.0000000000000002 of these, which no diagnosis.json may hold."""
    chances = {"focal_error": 0.7974751978165223, "anchor_slip": 0.20252480218347782}
    assert sum(chances.values()) > 1
    verdict = verdict_of(chances, {}, Calibration.load(), {}, settings=VerdictSettings(named=0.9))
    assert (verdict.effect, verdict.probability) == (AMBIGUOUS, 1.0)


@pytest.mark.parametrize(
    ("first", "other", "named"),
    [
        ("mask_bias", "focal_error", None),
        ("mask_bias", "shading", "shading"),
        ("air_drag", "focal_error", "focal_error"),
    ],
)
def test_what_is_read_from_the_same_outline_is_no_second_cause(
    first: str, other: str, named: str | None
) -> None:
    """Masks that had grown were named with a focal length of 4 % beside them, which they leave alike."""
    chances = {first: 0.96, other: 0.03, "none": 0.01}
    verdict = verdict_of(chances, {first: 900.0, other: 700.0}, Calibration.load(), {})
    assert (verdict.effect, verdict.also) == (first, named)
