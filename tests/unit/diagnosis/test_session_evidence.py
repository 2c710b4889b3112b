"""Which hypotheses of a session are worth a fit, and what images of several clips say together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.findings import Finding
from toile.diagnosis.joint_fit import JointFit
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_evidence import SessionEvidence, _of_images, promising
from toile.diagnosis.session_weights import MotionEvidence, SessionWeights
from toile.effects.catalogue import CATALOGUE, STAND_INS

ONCE = 0.01 / 2**0.5
ERRORS = ModelErrors(cost=10.0, expected=10.0, share=0.001)
EFFECTS = [CATALOGUE[name]() for name in ("air_drag", "gusts", "nonuniform_stiffness", "rest_curvature")] + [
    STAND_INS["steady_forces"]()
]
BASE = JointFit((), np.zeros(0), np.zeros(0), np.zeros((0, 0)), [], [], 1000.0, (1000.0,), 0.0, True)


def fits(impossible: str, **drops: float) -> dict[str, JointFit]:
    """Around the base model, each with one well known coefficient."""
    linear = replace(BASE, coefficients=np.ones(1), covariance=1e-4 * np.eye(1))
    return {
        name: replace(linear, misfit=BASE.misfit - drop, possible=name != impossible)
        for name, drop in drops.items()
    }


def chosen(impossible: str = "", **drops: float) -> set[str]:
    """Names of what is fitted, two at most."""
    return {effect.NAME for effect in promising(BASE, fits(impossible, **drops), EFFECTS, ERRORS, 2)}


def test_those_that_promise_most_are_fitted_and_stand_ins_near_them() -> None:
    drops = {"air_drag": 90.0, "gusts": 60.0, "nonuniform_stiffness": 40.0, "rest_curvature": 20.0}
    assert chosen(**drops, steady_forces=80.0) == {"air_drag", "gusts", "steady_forces"}
    assert chosen(**drops, steady_forces=30.0) == {"air_drag", "gusts"}


@pytest.mark.parametrize(("promise", "fitted"), [(500.0, True), (70.0, True), (40.0, False)])
def test_what_no_cloth_could_be_like_around_the_base_model_is_asked_of_a_fit(
    promise: float, fitted: bool
) -> None:
    """It takes no other effect's place, and sends no stand-in away: it may come to nothing."""
    drops = {"air_drag": 90.0, "gusts": 60.0, "nonuniform_stiffness": 40.0, "rest_curvature": promise}
    others = {"air_drag", "gusts", "steady_forces"}
    found = chosen("rest_curvature", **drops, steady_forces=80.0)
    assert found == (others | {"rest_curvature"} if fitted else others)


def test_what_promises_nothing_is_not_fitted() -> None:
    assert chosen("rest_curvature", air_drag=0.1, gusts=0.0, rest_curvature=0.5, steady_forces=0.2) == set()


@pytest.mark.parametrize(("drop", "impossible"), [(-10.0, ""), (-10.0, "rest_curvature"), (70.0, "")])
def test_what_the_learned_decision_holds_most_probable_is_fitted_whatever_it_promises(
    drop: float, impossible: str
) -> None:
    """Once, and beside the two that promise most."""
    linear = fits(impossible, air_drag=90.0, gusts=60.0, rest_curvature=drop, steady_forces=0.0)
    learned = {"none": 0.6, "air_drag": 0.1, "rest_curvature": 0.3}
    asked = [effect.NAME for effect in promising(BASE, linear, EFFECTS, ERRORS, 2, learned=learned)]
    assert sorted(asked) == ["air_drag", *(["gusts"] if drop < 60 else []), "rest_curvature"]


def test_what_the_base_model_has_is_not_fitted_again_whatever_is_learned() -> None:
    linear = fits("", air_drag=90.0, gusts=60.0, rest_curvature=-10.0)
    learned = {"air_drag": 0.9, "gusts": 0.02, "rest_curvature": 0.01}
    found = promising(BASE, linear, EFFECTS, ERRORS, 1, fitted=("air_drag",), learned=learned)
    assert [effect.NAME for effect in found] == ["gusts"]


@pytest.mark.parametrize(
    ("said", "together"),
    [
        # (log evidence, mean, deviation, device) of every clip.
        ([(40.0, 0.06, 0.01, 0), (30.0, 0.06, 0.01, 0)], (70.0, 0.06, ONCE)),
        ([(36.0, 0.06, 0.01, 0), (32.0, 0.04, 0.01, 0)], (35.0 + 30.0, 0.05, ONCE)),
        # They cannot both be right, and what lies between does nothing.
        ([(40.0, 0.06, 0.01, 0), (39.0, -0.06, 0.01, 0)], (40.0, 0.06, 0.01)),
        ([(40.0, 0.06, 0.01, 0), (-4.0, 0.0, 0.01, 0)], (36.0, 0.06, 0.01)),
        # Of two devices each has an error of its own.
        ([(40.0, 0.06, 0.01, 0), (39.0, -0.06, 0.01, 1)], (40.0, 0.06, 0.01)),
        ([(20.0, 0.06, 0.01, 0), (15.0, -0.06, 0.01, 1), (10.0, -0.06, 0.01, 1)], (25.0, -0.06, ONCE)),
    ],
)
def test_clips_of_a_device_agree_on_its_error(
    said: list[tuple[float, float, float, int]], together: tuple[float, float, float]
) -> None:
    clips = [{"focal_error": Finding(nats, {"relative": m}, {"relative": s})} for nats, m, s, _ in said]
    found = _of_images(CATALOGUE["focal_error"](), "focal_error", clips, [device for *_, device in said])
    numbers = (found.log_evidence, found.mean["relative"], found.deviation["relative"])
    assert numbers == pytest.approx(together)


def known(nats: float) -> EffectEvidence:
    """One coefficient, as large as it may be."""
    return EffectEvidence(nats, (1.0,), (0.0,), 1.0)


def test_what_predicts_worse_speaks_for_none_no_more() -> None:
    """A sealed anisotropy was none: the law explained as much by a density that nothing else knew of."""
    weights = SessionWeights.load().of_clips(3)
    motion = MotionEvidence(
        replace(ERRORS, cost=2000.0, expected=2000.0),
        {"anisotropic_stiffness": known(288.0), "nonuniform_density": known(300.0)},
        sizes={"anisotropic_stiffness": 0.029, "nonuniform_density": 0.023},
        outside={"nonuniform_density": known(19.0)},
    )
    shown = {"exposure_drift": -5.0}
    none = {NONE: 0.92, "anisotropic_stiffness": 0.05, "nonuniform_density": 0.03, UNKNOWN: 0.0}
    evidence = SessionEvidence({}, {}, {}, none, motion.over_usual, motion.scale, motion, shown)
    same = evidence.without((), weights)
    assert max(same.chances, key=lambda name: same.chances[name]) == NONE
    found = evidence.without(("nonuniform_density",), weights)
    assert found.chances["anisotropic_stiffness"] > 0.9
    assert found.chances["nonuniform_density"] == 0.0
    assert sum(found.chances.values()) == pytest.approx(1.0)
    # What images show keeps its odds against none.
    assert found.logits["exposure_drift"] - found.logits[NONE] == pytest.approx(-5.0)
    assert found.motion is motion
    # What the density explains is no more explained.
    assert found.left == motion.without(("nonuniform_density",)).over_usual > same.left
    # Odds of the motion without it are the logits, by the same constant.
    odds = motion.without(found.silent).odds(weights)
    assert odds["anisotropic_stiffness"] == found.logits["anisotropic_stiffness"]
    assert odds["anisotropic_stiffness"] != pytest.approx(motion.odds(weights)["anisotropic_stiffness"])
