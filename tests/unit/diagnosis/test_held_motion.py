"""What holds the cloth is held where it stays, and let go where it does not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import toile.diagnosis.held_motion as held
from toile.diagnosis.held_motion import HeldMotion, held_motion
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import RefinedMotion, SeenClip
from toile.workers import ALONE

SETTINGS = SessionSettings()
TRACKED, REFINED, LOOSENED, ANEW = (RefinedMotion([np.full((4, 9, 3), k)], None) for k in range(4))


class _Pipeline:
    """Runs every stage, and keeps what it was."""

    def __init__(self) -> None:
        self.ran: list[tuple[str, dict[str, str]]] = []

    def run(self, stage: Any, *inputs: Any) -> Any:
        assert stage.name.endswith(" motion")
        self.ran.append((stage.file, dict(stage.made_from)))
        return stage.compute(*inputs)


def found(
    monkeypatch: pytest.MonkeyPatch, settings: SessionSettings, *, held_still: bool, slips: bool
) -> tuple[HeldMotion, _Pipeline, list[list[bool]]]:
    """What is found of one clip, the stages, and which clips were held in every refining."""
    clip = SeenClip(None, 0, SimpleNamespace(positions=None), None, held_still=held_still)  # type: ignore[arg-type]
    stay: list[list[bool]] = []

    def refined(clips: Any, settings: Any, stiffness: Any, workers: Any, begin: Any = None) -> RefinedMotion:
        stay.append([one.stays for one in clips])
        assert begin in (None, LOOSENED)
        return REFINED if begin is None else ANEW

    def loosened(clips: Any, motion: Any, settings: Any, stiffness: Any, workers: Any) -> RefinedMotion:
        assert motion is REFINED
        return LOOSENED

    def let_go(clips: Any, positions: Any, settings: Any, threshold: float) -> list[SeenClip]:
        assert positions is LOOSENED.positions
        return [replace(one, let_go=slips) for one in clips]

    monkeypatch.setattr(held, "refined_motion", refined)
    monkeypatch.setattr(held, "loosened", loosened)
    monkeypatch.setattr(held, "let_go", let_go)
    pipeline: Any = _Pipeline()
    made_from = {"clip": "1"}
    outcome = held_motion(pipeline, [clip], settings, (850.0, 0.5, 0.005), made_from, ALONE)
    assert made_from == {"clip": "1"}
    return outcome, pipeline, stay


def test_what_stays_is_held_and_what_is_judged_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    outcome, pipeline, stay = found(monkeypatch, SETTINGS, held_still=True, slips=False)
    assert outcome.motion is REFINED
    assert outcome.holders is LOOSENED
    assert stay == [[True]]
    assert [file for file, _ in pipeline.ran] == ["refined.npz", "loosened.npz"]
    assert outcome.made_from == {"clip": "1"}


def test_what_slips_is_refined_anew_with_nothing_held(monkeypatch: pytest.MonkeyPatch) -> None:
    outcome, pipeline, stay = found(monkeypatch, SETTINGS, held_still=True, slips=True)
    assert outcome.motion is ANEW
    assert outcome.holders is LOOSENED
    assert stay == [[True], [False]]
    assert [file for file, _ in pipeline.ran] == ["refined.npz", "loosened.npz", "let_go.npz"]
    # Fits around the other motion are others.
    assert outcome.made_from["clip"] == "1"
    assert set(outcome.made_from) > {"clip"}
    assert pipeline.ran[-1][1] == outcome.made_from


@pytest.mark.parametrize(
    ("settings", "held_still"),
    [
        (SETTINGS, False),
        (replace(SETTINGS, held=SETTINGS.boundary), True),
        (replace(SETTINGS, refining=replace(SETTINGS.refining, loose=0)), True),
        (replace(SETTINGS, refining=replace(SETTINGS.refining, rounds=0, firm=0, finer=0)), True),
    ],
)
def test_nothing_is_judged_where_nothing_is_held(
    monkeypatch: pytest.MonkeyPatch, settings: SessionSettings, held_still: bool
) -> None:
    outcome, pipeline, _ = found(monkeypatch, settings, held_still=held_still, slips=True)
    assert outcome.motion is outcome.holders is REFINED
    assert [file for file, _ in pipeline.ran] == ["refined.npz"]
    assert not outcome.clips[0].let_go
