"""What evidence of a session is worth is learnt from sessions whose cause is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_weights import (
    USUAL_SHARE,
    MotionEvidence,
    SessionCase,
    SessionWeights,
    chances,
    learnt_weights,
    left_out_chances,
)
from toile.errors import InputError

EFFECTS = ("air_drag", "internal_damping", "nonuniform_density")


def evidence(drops: tuple[float, ...], base: float = 50.0) -> MotionEvidence:
    by_name = {
        # One coefficient of known size: what it gains is a parabola's depth.
        name: EffectEvidence(drop, (1e3,), (float(np.sqrt(2e3 * drop)),), 3.0)
        for name, drop in zip(EFFECTS, drops, strict=True)
    }
    return MotionEvidence(ModelErrors(base, 120.0, USUAL_SHARE), by_name)


def cases(noise: float, gain: float) -> list[SessionCase]:
    """Twelve nulls, and as many sessions of every effect; drops scatter by ``noise``."""
    rng = np.random.default_rng(3)
    found = []
    for cause in (NONE, *EFFECTS):
        for k in range(12):
            drops = tuple(4 + noise * abs(rng.normal()) + gain * (name == cause) for name in EFFECTS)
            found.append(SessionCase(f"{cause}_{k}", cause, evidence(drops, 90 + gain)))
    return found


def test_probabilities_are_of_effects_and_none() -> None:
    p = chances(evidence((40.0, 6.0, 5.0)), SessionWeights())
    assert sum(p.values()) == pytest.approx(1.0)
    assert max(p, key=lambda name: p[name]) == "air_drag"
    assert max(chances(evidence((4.0, 4.0, 4.0)), SessionWeights()).items(), key=lambda i: i[1])[0] == NONE


def test_a_model_that_is_wrong_anyhow_says_less() -> None:
    good, bad = evidence((40.0, 6.0, 5.0), 60.0), evidence((40.0, 6.0, 5.0), 600.0)
    assert bad.left > 4 > 1 > good.left
    assert bad.nats("air_drag") < good.nats("air_drag") / 4


def test_what_every_cloth_has_is_a_cause_only_where_there_is_more_of_it() -> None:
    weights = SessionWeights()
    sure = evidence((3.0, 90.0, 2.0))
    usual, more = (
        replace(sure, usual={"internal_damping": size * weights.usual_size}) for size in (1.0, 4.0)
    )
    assert chances(sure, weights)["internal_damping"] > 0.99
    assert chances(more, weights)["internal_damping"] > 0.9
    assert chances(usual, weights)[NONE] > 0.8
    # Much of it without evidence is no cause either.
    nothing = replace(evidence((3.0, 2.0, 2.0)), usual={"internal_damping": 4 * weights.usual_size})
    assert chances(nothing, weights)[NONE] > 0.6


def test_the_odds_of_damping_grow_with_how_far_it_moves_the_cloth() -> None:
    weights, sure = SessionWeights(), evidence((3.0, 90.0, 2.0))
    sizes = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 500.0)
    p = [chances(replace(sure, usual={"internal_damping": s * weights.usual_size}), weights) for s in sizes]
    of_cause = [one["internal_damping"] for one in p]
    assert of_cause == sorted(of_cause)
    assert of_cause[2] < 0.05
    # The less is known of what is usual, the less an excess says.
    vague = replace(weights, usual_spread=2 * weights.usual_spread)
    doubled = replace(sure, usual={"internal_damping": 3 * weights.usual_size})
    assert chances(doubled, vague)["internal_damping"] < chances(doubled, weights)["internal_damping"]


def test_what_hardly_moves_the_cloth_is_no_cause_however_sure() -> None:
    """Nulls of three clips gained forty nats for what moved the cloth by a fifth of a per cent."""
    weights = SessionWeights()
    sure = evidence((60.0, 3.0, 3.0))
    small, large = (replace(sure, sizes={"air_drag": size * weights.smallest}) for size in (0.4, 2.0))
    assert chances(small, weights)[NONE] > 0.95
    assert chances(large, weights)["air_drag"] > 0.99
    # Size without evidence is no cause.
    nothing = replace(evidence((3.0, 3.0, 3.0)), sizes={"air_drag": 4 * weights.smallest})
    assert chances(nothing, weights)[NONE] > 0.8


def test_what_no_null_shows_is_a_cause_although_it_is_small() -> None:
    weights, at = SessionWeights(), SessionWeights().smallest

    def p(drop: float, size: float, weights: SessionWeights = weights) -> float:
        one = replace(evidence((drop, 2.0, 1.0)), sizes={"air_drag": size * at})
        return chances(one, weights)["air_drag"]

    # As much as nulls have shares itself evenly with none at that size, whatever it is.
    assert p(50.0, 1.0) == pytest.approx(0.5, abs=0.05)
    assert p(90.0, 1.0) == pytest.approx(0.5, abs=0.05)
    assert p(900.0, 1.0) > 0.999
    assert p(900.0, 1.0, replace(weights, surest=1e9)) == pytest.approx(0.5, abs=0.01)
    # What hardly moves the cloth is none as before.
    assert p(90.0, 0.3) < 0.01
    assert p(120.0, 0.1) < 0.01


def test_what_acts_where_none_is_the_answer_is_told() -> None:
    weights = replace(SessionWeights(), law_spread=0.7)
    small = replace(evidence((60.0, 3.0, 3.0)), sizes={"air_drag": weights.smallest})
    parts, odds = small.parts(weights), small.odds(weights)
    assert parts[NONE, "air_drag"] > parts[NONE, NONE] + 1
    assert np.logaddexp.reduce([v for (n, _), v in parts.items() if n == NONE]) == pytest.approx(odds[NONE])
    assert parts["air_drag", "air_drag"] == pytest.approx(odds["air_drag"])


def test_the_same_holds_for_causes_from_outside() -> None:
    weights, at = SessionWeights(), SessionWeights().smallest

    def p(drop: float, size: float) -> float:
        freed = evidence((drop, 1.0, 1.0)).effects["air_drag"]
        one = replace(evidence((1.0, 2.0, 1.0)), outside={"air_drag": freed}, sizes={"air_drag": size * at})
        return chances(one, weights)["air_drag"]

    assert p(60.0, 1.0) == pytest.approx(0.5, abs=0.05)
    assert p(900.0, 1.0) > 0.999
    assert p(90.0, 0.2) < 0.01


def test_causes_from_outside_are_judged_by_what_free_forces_leave_alone() -> None:
    """What a law says of drag counts neither for it nor against it: the law may be wrong."""
    weights = SessionWeights()
    of_law, freed = evidence((90.0, 3.0, 60.0)).effects["air_drag"], evidence((3.0, 2.0, 2.0)).effects
    one = evidence((90.0, 3.0, 2.0))
    assert chances(one, weights)["air_drag"] > 0.99
    assert chances(replace(one, outside={"air_drag": freed["air_drag"]}), weights)["air_drag"] < 0.1
    other = evidence((3.0, 3.0, 60.0))
    found = chances(replace(other, outside={"air_drag": of_law}), weights)
    assert found["air_drag"] > 0.99 > 0.01 > found["nonuniform_density"]


def test_a_motion_that_no_hypothesis_fits_says_less_beside_free_forces() -> None:
    """Gusts were named by 48 nats where the cloth curls and the motion is off by 3 % of the width."""
    base = replace(evidence((3.0, 3.0, 3.0)).base, cost=130.0, expected=120.0)
    outside = {"air_drag": evidence((40.0, 2.0, 2.0)).effects["air_drag"]}
    usual = replace(evidence((3.0, 3.0, 3.0)), base=base, outside=outside)
    strange = replace(usual, base=replace(base, share=2 * base.share))
    less = replace(usual, base=replace(base, share=0.5 * base.share))
    assert chances(usual, SessionWeights())["air_drag"] > 0.99
    assert strange.freed_nats("air_drag") < usual.freed_nats("air_drag") / 3
    assert chances(strange, SessionWeights())["air_drag"] < 0.2
    # Images that are explained better than usual know no more.
    assert less.freed_nats("air_drag") == outside["air_drag"].nats()


def rivals(of_law: tuple[float, float], freed: tuple[float, float] = (60.0, 57.0)) -> MotionEvidence:
    """Drag and damping as if both came from outside, with what law and free forces say of them [nats]."""
    outside = dict(list(evidence((*freed, 2.0)).effects.items())[:2])
    return replace(evidence((*of_law, 2.0)), outside=outside)


def test_the_law_tells_causes_from_outside_apart_where_free_forces_cannot() -> None:
    weights = SessionWeights()
    alike, other = (chances(rivals(law), weights) for law in ((20.0, 20.0), (20.0, 100.0)))
    assert alike["air_drag"] > alike["internal_damping"]
    assert other["internal_damping"] > 0.9
    # Whether anything acts from outside is left to the free forces.
    assert alike[NONE] == pytest.approx(other[NONE], rel=1e-6)
    weak = [chances(rivals(law, (14.0, 12.0)), weights)[NONE] for law in ((20.0, 20.0), (20.0, 100.0))]
    assert weak[0] == pytest.approx(weak[1], rel=1e-6)


def test_a_cause_without_a_history_needs_less_beside_free_forces() -> None:
    """Drag of 19 nats was 0.52; where nothing acts from outside it has 2 at most."""
    even, weights = SessionWeights(), replace(SessionWeights(), outside_unchanging=0.5)
    assert weights.asked_of_outside("air_drag") == 0.5 * weights.asked_of_outside("gusts")
    freed = evidence((15.0, 2.0, 2.0)).effects["air_drag"]
    law = evidence((3.0, 2.0, 2.0)).effects
    drag = replace(evidence((3.0, 2.0, 2.0)), outside={"air_drag": freed})
    assert chances(drag, even)["air_drag"] < 0.4 < 0.6 < chances(drag, weights)["air_drag"]
    # Gusts take up more where nothing blows, so the same is asked of them as before.
    gusts = replace(drag, effects={**law, "gusts": law["air_drag"]}, outside={"gusts": freed})
    assert chances(gusts, even)["gusts"] == pytest.approx(chances(gusts, weights)["gusts"])
    # With several clips it is the same share of what is asked then.
    three = weights.of_clips(3)
    assert three.asked_of_outside("air_drag") == 0.5 * three.outside_threshold


def test_a_fit_that_failed_does_not_rule_a_cause_from_outside_out() -> None:
    """A clock of 200 nats had none under the law: its fit could not move."""
    found = chances(rivals((0.0, 900.0), (90.0, 50.0)), SessionWeights())
    assert found["air_drag"] > found["internal_damping"]


def test_a_density_is_named_only_where_both_modules_have_it() -> None:
    """It scales what forces within the cloth do, so each module alone may take a wrong law for it."""
    weights = SessionWeights()
    much, little = (evidence((2.0, 2.0, nats)).effects["nonuniform_density"] for nats in (90.0, 4.0))
    of_law = evidence((2.0, 2.0, 90.0))
    p = {
        (law, freed): chances(
            replace(
                evidence((2.0, 2.0, law)), outside={"nonuniform_density": much if freed > 50 else little}
            ),
            weights,
        )["nonuniform_density"]
        for law in (90.0, 4.0)
        for freed in (90.0, 4.0)
    }
    assert p[90.0, 90.0] > 0.99
    assert max(p[90.0, 4.0], p[4.0, 90.0], p[4.0, 4.0]) < 0.1
    # An effect within the cloth that explains as much under the law stays its rival.
    both = replace(
        of_law,
        effects={**of_law.effects, "anisotropic_stiffness": much},
        outside={"nonuniform_density": much},
    )
    found = chances(both, weights)
    assert found["anisotropic_stiffness"] == pytest.approx(found["nonuniform_density"])


def test_a_density_stands_against_what_takes_up_a_part_of_its_trace() -> None:
    """Of a density that acts, gusts take up a part where forces within the cloth are free."""

    def of(law: float, drag: float) -> dict[str, float]:
        one = evidence((drag, 2.0, law))
        freed = evidence((50.0, 2.0, 290.0)).effects
        outside = {name: freed[name] for name in ("air_drag", "nonuniform_density")}
        return chances(replace(one, outside=outside), SessionWeights())

    assert of(950.0, 90.0)["nonuniform_density"] > 0.99
    # What the law prefers to it is left alone.
    assert of(90.0, 400.0)["air_drag"] > 0.99


def touching(law: float, freed: float, drag: tuple[float, float]) -> dict[str, float]:
    """Probabilities where contact, and drag, have so much under a law and beside free forces [nats]."""
    of = {nats: evidence((nats, 2.0, 2.0)).effects["air_drag"] for nats in (law, freed, *drag)}
    one = evidence((drag[0], 2.0, 2.0))
    return chances(
        replace(
            one,
            effects={**one.effects, "contact": of[law]},
            outside={"air_drag": of[drag[1]], "contact": of[freed]},
        ),
        SessionWeights(),
    )


def test_contact_may_show_under_a_law_alone() -> None:
    """A push in a place and for a moment may leave the balance of torques nearly as it is."""
    assert touching(90.0, 3.0, (4.0, 3.0))["contact"] > 0.99
    assert touching(4.0, 3.0, (4.0, 3.0))[NONE] > 0.9
    # Where it does show there, what is level with it is told apart by the law.
    both = touching(300.0, 20.0, (30.0, 22.0))
    assert both["contact"] > 0.95
    # And what the balance does know stands against a law that takes it for contact.
    drag = touching(60.0, 20.0, (150.0, 90.0))
    assert drag["air_drag"] > 0.95


def unnamed(law: float, freed: float, drag: float) -> dict[str, float]:
    """Probabilities where a stand-in has so much under a law and beside free forces, drag in both [nats]."""
    of = {nats: evidence((nats, 2.0, 2.0)).effects["air_drag"] for nats in (law, freed, drag)}
    one = evidence((drag, 2.0, 2.0))
    return chances(
        replace(
            one,
            effects={**one.effects, "steady_forces": of[law]},
            outside={"air_drag": of[drag], "steady_forces": of[freed]},
        ),
        SessionWeights(),
    )


def test_what_a_stand_in_explains_better_is_unknown() -> None:
    assert unnamed(200.0, 4.0, 6.0)[UNKNOWN] > 0.9
    # Where forces within the cloth are free, against a cause that shows there.
    assert unnamed(4.0, 300.0, 60.0)[UNKNOWN] > 0.95


def test_a_stand_in_must_explain_more_than_an_effect() -> None:
    """It is flexible, so it takes up most of what any effect does."""
    nearly_level = unnamed(130.0, 112.0, 110.0)
    assert nearly_level["air_drag"] > 0.9
    assert unnamed(20.0, 4.0, 6.0)[NONE] > 0.9


def test_a_pressure_stands_against_gusts_with_what_the_law_says_of_both() -> None:
    """It has fewer coefficients than gusts have, and needs no more than they do."""

    def pushed(pressure: float, gusts: float) -> dict[str, float]:
        of = {
            nats: evidence((nats, 2.0, 2.0)).effects["air_drag"] for nats in (pressure, gusts, 200.0, 400.0)
        }
        law = {"gusts": of[gusts], "pressure": of[pressure]}
        # The balance of torques cannot tell them apart: it counts what gusts have in their direction alone.
        outside = {"gusts": of[200.0], "pressure": of[400.0]}
        return chances(
            MotionEvidence(evidence((1.0, 1.0, 1.0)).base, law, outside=outside), SessionWeights(rivals=4.0)
        )

    assert pushed(120.0, 100.0)[UNKNOWN] > 0.9
    assert pushed(100.0, 120.0)["gusts"] > 0.9
    level = pushed(110.0, 110.0)
    assert level[UNKNOWN] == pytest.approx(level["gusts"])


def test_a_pressure_that_the_balance_of_torques_knows_nothing_of_is_an_error_of_the_law() -> None:
    known = (60.0, 2.0)
    of = {nats: evidence((nats, 2.0, 2.0)).effects["air_drag"] for nats in known}
    outside = {"gusts": of[2.0], "pressure": of[2.0]}
    base = evidence((1.0, 1.0, 1.0)).base
    found = chances(
        MotionEvidence(base, {"gusts": of[60.0], "pressure": of[60.0]}, outside=outside), SessionWeights()
    )
    assert found[NONE] > 0.9


def test_a_stand_in_that_hardly_moves_the_cloth_says_nothing() -> None:
    """Rest lengths that drift by a hair explain what a law is wrong by, and are no rival of effects."""
    one = evidence((30.0, 2.0, 2.0))
    much = evidence((300.0, 2.0, 2.0)).effects["air_drag"]
    plain = chances(one, SessionWeights())
    beside = replace(
        one,
        effects={**one.effects, "rest_length_drift": much},
        outside={"rest_length_drift": much},
        sizes={"rest_length_drift": 0.006},
    )
    found = chances(beside, SessionWeights())
    assert {name: found[name] for name in plain} == pytest.approx(plain)
    assert found[UNKNOWN] == 0.0
    assert chances(replace(beside, sizes={"rest_length_drift": 0.03}), SessionWeights())[UNKNOWN] > 0.99


def test_rest_lengths_that_drift_are_judged_under_the_law_alone() -> None:
    """Beside free forces they take up what threads that are too stiff leave; nothing stood against that."""
    of = {nats: evidence((nats, 2.0, 2.0)).effects["air_drag"] for nats in (5.0, 100.0, 600.0)}
    one = evidence((100.0, 2.0, 2.0))
    sizes = {"rest_length_drift": 0.03}

    def found(law: float, freed: float) -> dict[str, float]:
        effects = {**one.effects, "rest_length_drift": of[law]}
        outside = {"rest_length_drift": of[freed]}
        return chances(replace(one, effects=effects, outside=outside, sizes=sizes), SessionWeights())

    assert found(5.0, 600.0) == pytest.approx(found(5.0, 5.0))
    assert found(5.0, 600.0)["air_drag"] > 0.9
    assert found(600.0, 5.0)[UNKNOWN] > 0.9


def test_a_cloth_that_seems_to_shrink_is_unknown_however_sure_an_effect_is() -> None:
    """Effects have been judged by a motion in which the cloth has moved away instead."""
    weights = SessionWeights()
    logits = {NONE: 0.0, "gusts": 140.0}

    def of(change: float | None) -> float:
        found = replace(evidence((4.0, 4.0, 4.0)), resized=change).with_looks(logits, weights)
        return float(1 / (1 + np.exp(found["gusts"] - found.get(UNKNOWN, -np.inf))))

    assert of(-0.08) > 0.98
    assert of(0.08) == pytest.approx(of(-0.08))
    assert of(weights.resized) == pytest.approx(0.5)
    # As much as tracking errs by, and where the holders were moved.
    assert of(0.005) < 0.01
    assert of(0.0) < 1e-6
    assert of(None) == 0.0


def test_a_print_that_is_hidden_speaks_for_something_unknown() -> None:
    logits, weights = {"gusts": 3.0, NONE: -2.0}, SessionWeights()

    def of(share: float | None, change: float | None = None) -> float:
        found = replace(evidence((4.0, 4.0, 4.0)), covered=share, resized=change).with_looks(logits, weights)
        return float(1 / (1 + np.exp(found["gusts"] - found.get(UNKNOWN, -np.inf))))

    assert of(0.05) > 0.98
    assert of(0.0) < 1e-6
    assert of(None) == 0.0
    # Either is enough, and neither speaks against the other.
    assert of(0.0, -0.08) > 0.98
    assert of(0.05, 0.0) > 0.98


def test_what_the_base_model_explains_is_not_left_for_others() -> None:
    sure = evidence((3.0, 90.0, 2.0))
    # Its errors are those that remain beside the usual effect, so its drop is none of theirs.
    assert replace(sure, usual={"internal_damping": 0.01}).left > sure.left


def test_images_explained_better_than_expected_know_no_more() -> None:
    """Errors below the smallest that are thought of must not sharpen evidence: nulls of a cloth that the
    base model follows closely were named for differences of a hundredth of a millimetre."""
    usual, tiny = evidence((30.0, 6.0, 5.0), 120.0), evidence((30.0, 6.0, 5.0), 35.0)
    assert tiny.left < 0.1
    assert tiny.scale == usual.scale == 1.0
    assert tiny.nats("air_drag") == usual.nats("air_drag")
    rough = evidence((30.0, 6.0, 5.0), 600.0)
    assert rough.nats("air_drag") < 0.5 * usual.nats("air_drag")


def test_evidence_is_kept_to_learn_from(tmp_path: Path) -> None:
    whole = replace(evidence((30.0, 6.0, 5.0)), learned={"air_drag": 0.2}, usual={"internal_damping": 0.01})
    whole = replace(whole, resized=-0.03, covered=0.02)
    whole.write(tmp_path / "motion_evidence.json")
    assert MotionEvidence.load(tmp_path / "motion_evidence.json") == whole
    (tmp_path / "motion_evidence.json").write_text('{"base": {}}')
    with pytest.raises(InputError, match="No evidence"):
        MotionEvidence.load(tmp_path / "motion_evidence.json")


def test_an_infinite_size_is_left_out_and_says_the_same(tmp_path: Path) -> None:
    torn = replace(evidence((30.0, 6.0, 5.0)), sizes={"air_drag": np.inf, "gusts": 0.02})
    torn.write(tmp_path / "motion_evidence.json")
    assert "Infinity" not in (tmp_path / "motion_evidence.json").read_text()
    kept = MotionEvidence.load(tmp_path / "motion_evidence.json")
    assert kept.sizes == {"gusts": 0.02}
    weights = SessionWeights()
    assert kept.logits(weights) == pytest.approx(torn.logits(weights))


def test_what_is_strange_does_not_hang_on_the_errors_that_were_found() -> None:
    one = evidence((40.0, 6.0, 5.0), 600.0)
    # A model wrong by twice as much, explained to the same degree.
    twice = replace(one, base=replace(one.base, share=2 * one.base.share))
    assert twice.left == one.left
    assert twice.over_usual == pytest.approx(4 * one.over_usual)


def test_more_noise_in_the_nulls_asks_for_more_evidence() -> None:
    quiet, noisy = learnt_weights(cases(1.0, 30.0)), learnt_weights(cases(12.0, 30.0))
    needed = [weights.threshold + 2 * weights.temperature for weights in (quiet, noisy)]
    assert needed[1] > needed[0] + 3
    assert noisy.temperature > quiet.temperature


def test_causes_are_named_by_weights_that_have_not_seen_them() -> None:
    known = cases(3.0, 30.0)[::3]
    for case, p in zip(known, left_out_chances(known), strict=True):
        assert max(p, key=lambda name: p[name]) == case.cause


def test_the_learned_decision_parts_what_the_misfit_cannot() -> None:
    one = evidence((40.0, 40.0, 5.0))
    with_odds = replace(one, learned={"air_drag": 0.1, "internal_damping": 0.8, "nonuniform_density": 0.1})
    p = chances(with_odds, SessionWeights())
    assert p["internal_damping"] > 2 * p["air_drag"]
    q = chances(one, SessionWeights())
    assert q["internal_damping"] == pytest.approx(q["air_drag"])


def test_weights_come_back_from_their_file(tmp_path: Path) -> None:
    path = tmp_path / "weights.json"
    weights = SessionWeights(smallest=1.5, threshold=9.0)
    weights.write(path, "a test")
    assert SessionWeights.load(path) == weights
    assert SessionWeights.load().temperature > 0


@pytest.mark.parametrize("text", ["", "[]", '{"weights": {"usual": 1}}', '{"weights": {"usual": "x"}}'])
def test_a_file_without_weights_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "weights.json"
    path.write_text(text)
    with pytest.raises(InputError, match=str(path)):
        SessionWeights.load(path)


def test_the_law_is_wrong_alike_in_every_clip() -> None:
    """Three clips average noise but not the errors of the law; weights for one clip stay as they are."""
    weights = SessionWeights(threshold=20.0, temperature=5.0, outside_temperature=2.0)
    assert weights.of_clips(1) == weights
    three = weights.of_clips(3)
    assert three.temperature == pytest.approx(13.0)
    assert three.threshold == pytest.approx(20.0 * 13 / 5)
    assert three.outside_temperature == pytest.approx(4.0)
    # Evidence that is the law's error in one clip is hardly more in three, where it has tripled;
    one, tripled = (evidence((nats, 3.0, 3.0)) for nats in (25.0, 75.0))
    odds = [
        float(np.log(p["air_drag"] / p[NONE]))
        for p in (chances(one, weights), chances(tripled, three), chances(tripled, weights))
    ]
    assert odds[0] < odds[1] < odds[0] + 1.5
    assert odds[2] > odds[0] + 5
    # without such errors (temperature 1) clips add up.
    exact = SessionWeights(threshold=20.0, temperature=1.0)
    assert exact.of_clips(3).temperature == exact.temperature
    assert exact.of_clips(3).threshold == exact.threshold
    with pytest.raises(ValueError, match="one clip or more"):
        weights.of_clips(0)


def test_not_to_know_how_wrong_the_law_is_takes_certainty_away() -> None:
    sure = SessionWeights()
    doubtful = replace(sure, law_spread=1.0)
    # Far above any threshold nothing changes; a little above it does.
    near, far = (evidence((nats, 3.0, 3.0)) for nats in (40.0, 400.0))
    assert chances(near, sure)["air_drag"] > 0.98 > 0.95 > chances(near, doubtful)["air_drag"] > 0.6
    assert chances(far, doubtful)["air_drag"] > 0.98
    assert sum(chances(near, doubtful).values()) == pytest.approx(1.0)
    # What causes from outside say hangs on no law.
    outside = {"air_drag": far.effects["air_drag"]}
    p, q = (chances(replace(near, outside=outside), w)["air_drag"] for w in (sure, doubtful))
    assert q == pytest.approx(p)


def test_what_is_fixed_is_not_learnt() -> None:
    known = cases(3.0, 30.0)[::3]
    doubtful = SessionWeights(law_spread=0.7)
    learnt = learnt_weights(known, doubtful, fixed=("threshold",))
    assert (learnt.law_spread, learnt.threshold) == (0.7, doubtful.threshold)
    assert learnt.temperature != doubtful.temperature
