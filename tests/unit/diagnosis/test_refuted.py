"""An answer that foretells worse than nothing, where another one foretells better, is none."""

from __future__ import annotations

import pytest

from toile.diagnosis.record import AMBIGUOUS, Shrink, Verdict
from toile.diagnosis.verdict import overtaken, refuted


def shrink(low: float, high: float, placebo: float | None = 0.03) -> Shrink:
    middle = 0.5 * (low + high)
    return Shrink("distance [mm]", "the last clip", 4.0, 4.0 * (1 - middle), middle, low, high, placebo)


CHANCES = {"gusts": 0.95, "frame_rate": 0.04, "air_drag": 0.01}
NAMED = Verdict("gusts", ("gusts",), "actuation", 0.97, "gusts explains what the base model misses.", "")


def test_what_predicts_worse_than_a_rival_is_not_the_answer() -> None:
    found = refuted(NAMED, CHANCES, {"gusts": shrink(-0.16, -0.01), "frame_rate": shrink(0.09, 0.21)})
    assert found.effect == AMBIGUOUS
    assert found.candidates == ("gusts", "frame_rate")
    assert found.probability == pytest.approx(0.99)  # of all candidates together
    assert "frame_rate predicts it better" in found.reason
    assert found.next_recording


@pytest.mark.parametrize(
    "shrinks",
    [
        {},
        {"gusts": shrink(-0.1, 0.02), "frame_rate": shrink(0.09, 0.21)},
        {"air_drag": shrink(-0.3, -0.2), "frame_rate": shrink(0.09, 0.21)},
        {"gusts": shrink(-0.16, -0.01)},
    ],
)
def test_what_is_not_surely_worse_stays(shrinks: dict[str, Shrink]) -> None:
    assert refuted(NAMED, CHANCES, shrinks) == NAMED


def test_a_rival_within_the_placebo_does_not_predict_better() -> None:
    assert refuted(NAMED, CHANCES, {"gusts": shrink(-0.16, -0.01), "air_drag": shrink(0.01, 0.05)}) == NAMED


def test_only_what_another_one_predicts_better_is_overtaken() -> None:
    worse, better, level = shrink(-0.16, -0.01), shrink(0.09, 0.21), shrink(-0.1, 0.02)
    assert overtaken({"gusts": worse, "frame_rate": better, "air_drag": level}) == ("gusts",)
    assert overtaken({"gusts": worse, "air_drag": level}) == ()
    assert overtaken({}) == ()
