"""Where a session's gap lies, by the probabilities of its answer."""

from __future__ import annotations

import pytest

from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.gap_maps import stage_chances


def test_a_stage_is_as_probable_as_its_effects_together() -> None:
    chances = {
        "anchor_slip": 0.6,
        "air_drag": 0.1,
        "gusts": 0.05,
        "frame_rate": 0.04,
        NONE: 0.2,
        UNKNOWN: 0.01,
    }
    stages = stage_chances(chances)
    assert stages["actuation"] == pytest.approx(0.65)
    assert stages["mechanics"] == pytest.approx(0.14)
    assert sum(stages.values()) == pytest.approx(0.79)
    assert "numerics" not in stages


def test_a_null_lies_nowhere() -> None:
    assert sum(stage_chances({NONE: 0.97, "rest_curvature": 0.02, UNKNOWN: 0.01}).values()) == pytest.approx(
        0.02
    )
