"""A stand-in that tears the cloth apart in the simulation has no size, which loses no answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from toile.diagnosis.decision import UNKNOWN
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.outside_causes import OutsideCauses
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport, SessionAnswer
from toile.diagnosis.session_diagnosis import _stand_ins
from toile.diagnosis.session_evidence import SessionEvidence
from toile.diagnosis.session_weights import MotionEvidence, SessionWeights
from toile.effects.base import Amount

MakeReport = Callable[..., GapReport]
NAME = "rest_length_drift"

ENERGIES = SimpleNamespace(parameters=SimpleNamespace(names=("bending",)))
SIMULATOR = SimpleNamespace(cloth=SimpleNamespace(energies=ENERGIES))
CLIP = SimpleNamespace(around=None, known_times=None, shooting=SimpleNamespace(simulator=SIMULATOR))
MODEL: Any = SimpleNamespace(fitting=SimpleNamespace(clips=[CLIP], start=np.array([2e-4])))


class Drift:
    """As a stand-in is: with two numbers, described by them."""

    NAME = NAME
    scales = torch.ones(2, dtype=torch.float64)

    def with_values(self, values: torch.Tensor) -> Any:
        return SimpleNamespace(
            amounts=lambda around, material, times: (Amount("first", float(values[0]), "m"),)
        )


def evidence_of(motion: MotionEvidence, logits: dict[str, float]) -> SessionEvidence:
    """What a session's clips say where nothing but the motion speaks."""
    return SessionEvidence({}, {}, logits, {}, left=0.0, scale=1.0, motion=motion, of_images={})


def test_looks_of_the_cloth_say_nothing_of_what_moves_it() -> None:
    """Where nothing speaks for a stand-in, a cover does not make it likely."""
    weights = SessionWeights()
    drift = EffectEvidence.of(0.0, np.array([0.3, 0.1]), 0.01 * np.eye(2), 3.0)
    motion = MotionEvidence(ModelErrors(100.0, 120.0, 0.001), {NAME: drift}, sizes={NAME: 0.04})
    fits: Any = {NAME: SimpleNamespace(own=np.array([0.3, 0.1]), values=np.zeros(1))}
    chances = []
    for covered in (None, 0.02, 0.5):
        logits = replace(motion, covered=covered).with_looks(motion.logits(weights), weights)
        evidence = evidence_of(motion, logits)
        found = _stand_ins([cast(Any, Drift())], MODEL, fits, OutsideCauses({}), evidence, weights)
        chances.append(found[NAME].probability)
    assert 0.0 < chances[2] < chances[1] < chances[0] < 0.01
    assert chances[0] == pytest.approx(np.exp(motion.logits(weights)[UNKNOWN]), rel=0.01)


def test_what_an_effect_no_more_says_leaves_a_stand_in_its_share() -> None:
    """Log odds have another constant then: by the old one its probability was nearly nothing."""
    weights = SessionWeights.load().of_clips(3)
    drift = EffectEvidence.of(200.0, np.array([0.3, 0.1]), 0.01 * np.eye(2), 3.0)
    density = EffectEvidence.of(190.0, np.array([0.3]), 0.01 * np.eye(1), 3.0)
    motion = MotionEvidence(
        ModelErrors(100.0, 120.0, 0.001),
        {NAME: drift, "nonuniform_density": density},
        sizes={NAME: 0.04, "nonuniform_density": 0.04},
    )
    fits: Any = {NAME: SimpleNamespace(own=np.array([0.3, 0.1]), values=np.zeros(1))}
    evidence = evidence_of(motion, motion.logits(weights)).without(("nonuniform_density",), weights)
    found = _stand_ins([cast(Any, Drift())], MODEL, fits, OutsideCauses({}), evidence, weights)
    # Nothing else that is unknown says anything: what is unknown is the drift.
    assert found[NAME].probability == pytest.approx(evidence.chances[UNKNOWN], abs=1e-3)
    assert found[NAME].probability > 0.5


@pytest.mark.parametrize(("size", "moves"), [(0.04, 0.04), (np.inf, None)])
def test_an_infinite_size_is_not_known(
    size: float, moves: float | None, tmp_path: Path, made_up_diagnosis: Callable[..., GapReport]
) -> None:
    own = np.array([0.3, 0.1])
    drift = EffectEvidence.of(200.0, own, 0.01 * np.eye(2), 3.0)
    motion = MotionEvidence(ModelErrors(100.0, 120.0, 0.001), {NAME: drift}, sizes={NAME: size})
    evidence = evidence_of(motion, motion.logits(SessionWeights()))
    fits: Any = {NAME: SimpleNamespace(own=own, values=np.zeros(1))}
    found = _stand_ins([cast(Any, Drift())], MODEL, fits, OutsideCauses({}), evidence, SessionWeights())
    assert found[NAME].moves == moves
    assert found[NAME].found == {"first [m]": pytest.approx(0.3)}
    session = SessionAnswer(("a",), (5,), {}, (), {}, 1.0, stand_ins=found)
    path = replace(made_up_diagnosis(), session=session).write(tmp_path / DIAGNOSIS_FILE)
    read = GapReport.read(path).session
    assert read is not None
    assert read.stand_ins[NAME].moves == moves
