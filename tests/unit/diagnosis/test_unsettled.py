"""Where the base model's fit has not arrived no effect is named that was fitted beside it."""

from __future__ import annotations

import pytest

from toile.diagnosis.record import AMBIGUOUS, Verdict
from toile.diagnosis.verdict import unsettled

FOUND = {"air_drag": 0.95, "none": 0.03, "exposure": 0.02}
DRAG = Verdict("air_drag", ("air_drag",), "mechanics", 0.95, "air_drag explains what is missed.", "")


def test_an_effect_that_was_fitted_is_not_named() -> None:
    verdict = unsettled(DRAG, FOUND, {"air_drag", "gusts"})
    assert verdict.effect == AMBIGUOUS
    assert verdict.candidates == ("air_drag", "none")
    assert verdict.stage == "mechanics"
    assert verdict.probability == pytest.approx(0.98)
    assert "the base model has not arrived" in verdict.reason
    assert verdict.next_recording


@pytest.mark.parametrize("effect", ["none", "unknown", "ambiguous", "exposure"])
def test_what_does_not_rest_on_such_fits_stays(effect: str) -> None:
    verdict = Verdict(effect, (effect,), "appearance", 0.9, "as it is", "")
    assert unsettled(verdict, FOUND, {"air_drag", "gusts"}) == verdict
