"""The page of a diagnosis: what it says, what it leaves out, and what a browser makes of it."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from toile.diagnosis.record import (
    AMBIGUOUS,
    NONE,
    UNKNOWN,
    Alias,
    CalibrationUse,
    Covered,
    Estimate,
    GapReport,
    SessionAnswer,
    Shrink,
    StandIn,
    Verdict,
    Where,
)
from toile.errors import InputError
from toile.reports.diagnosis_arrays import DiagnosisArrays, gap_field
from toile.reports.diagnosis_dashboard import answer_text, ranking_table
from toile.reports.diagnosis_wording import (
    amount,
    answer,
    beats_placebo,
    certainty,
    change,
    change_between,
    doubt,
    frame_ranges,
    percent,
    shrinkage,
    told_apart,
    what_acts_beside,
    when_moved,
)
from toile.reports.page.diagnosis_charts import alias_matrix, alias_order, held_out, over_time
from toile.reports.page.diagnosis_page import DiagnosisPage, write_diagnosis_page
from toile.scenes.scene import Scene

MakeReport = Callable[..., GapReport]
MakeArrays = Callable[..., DiagnosisArrays]
ADVICE = "a second clip with the pinned corners <shaken>"
AMBIGUITY = Verdict(
    AMBIGUOUS, ("air_drag", "internal_damping"), "mechanics", 0.96, "Cannot tell them apart.", ADVICE
)
SHRINK = Shrink("distance [mm]", "frames 30 to 39", 8.0, 3.2, 0.6, 0.5, 0.7, 0.05)


@pytest.fixture
def report(made_up_diagnosis: MakeReport) -> GapReport:
    return made_up_diagnosis()


def answered(report: GapReport, verdict: Verdict) -> GapReport:
    return dataclasses.replace(report, verdict=verdict)


def body(report: GapReport, arrays: DiagnosisArrays | None = None, scene: Scene | None = None) -> str:
    """The page without the inlined plotly.js and the data of its figures."""
    text = DiagnosisPage(report, arrays or DiagnosisArrays(), scene, "<clip>").render()
    text = re.sub(r"<head>.*?</head>", "", text, flags=re.DOTALL)
    return re.sub(r"<script.*?</script>|<style>.*?</style>", "", text, flags=re.DOTALL)


def header(report: GapReport) -> str:
    text = body(report)
    return text[: text.index("</header>")]


def words(html: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html)).replace("&lt;", "<").replace("&gt;", ">")


def titles(text: str) -> list[str]:
    return re.findall(r"<h2>(.*?)</h2>", text)


def test_opens_with_effect_probability_stage_and_shrink(report: GapReport) -> None:
    text = words(header(report))
    assert "The gap is air drag." in text
    assert "Probability 93 %" in text
    assert "mechanics stage" in text
    assert "from 8 to 3.2 mm: 60 % less (52 % to 68 %); the best placebo reaches 5 %." in text
    assert "Record next" not in text


def test_shows_where_an_effect_acts_that_does_not_act_everywhere(report: GapReport) -> None:
    assert "Where it acts" not in titles(body(report))
    text = body(report, DiagnosisArrays(acts_on=np.eye(4)))
    assert "Where it acts" in titles(text)
    assert "How strongly air drag acts on the cloth" in words(text)
    slip = answered(report, dataclasses.replace(report.verdict, effect="anchor_slip"))
    assert "How near the cloth is to the holder that slips" in words(
        body(slip, DiagnosisArrays(acts_on=np.eye(4)))
    )


def test_names_both_effects_of_a_pair(report: GapReport) -> None:
    pair = answered(report, dataclasses.replace(report.verdict, also="motion_blur"))
    assert answer(pair) == "The gap is air drag and motion blur."
    assert len(re.findall(r'<li class="here">', body(pair))) == 2


def test_what_modes_come_to_stands_before_them(report: GapReport) -> None:
    """An amplitude of a mode says nothing to who holds the cloth in his hands."""
    modes = {f"mode_{k}0": Estimate(-0.7, -0.9, -0.5, "1") for k in range(1, 8)}
    heaviest = {"heaviest places": Estimate(90.0, 60.0, 130.0, "%")}
    drag = dataclasses.replace(report.effects[0], parameters=modes, amounts=heaviest)
    found = dataclasses.replace(report, effects=(drag, *report.effects[1:]))
    assert "+90 % heaviest places, +60 to +130" in words(header(found))
    assert "mode" not in words(header(found))
    ranking = words(body(found))
    assert ranking.index("heaviest places +90 % +60 to +130") < ranking.index("mode 10")


def test_of_many_coefficients_the_surest_are_shown(report: GapReport) -> None:
    """Gusts have dozens, and the first of them may be the least of what blows."""
    drag = report.effects[0]
    weak = {f"mode {k}": Estimate(0.1, 0.02, 0.18, "m/s²") for k in range(8)}
    many = {**weak, "mode 8": Estimate(-2.0, -2.2, -1.8, "m/s²")}
    gusty = dataclasses.replace(report, effects=(dataclasses.replace(drag, parameters=many),))
    text = words(body(gusty))
    assert text.index("mode 8") < text.index("mode 0") < text.index("4 more") < text.index("mode 7")


def test_ambiguity_names_the_candidates_and_what_to_record(report: GapReport) -> None:
    text = words(header(answered(report, AMBIGUITY)))
    assert "Air drag or internal damping: this clip cannot tell." in text
    assert "Record next A second clip with the pinned corners <shaken>." in text
    assert "air drag 93 %, internal damping 3 %" in text
    everything = dataclasses.replace(AMBIGUITY, candidates=tuple(e.name for e in report.effects))
    assert answer(answered(report, everything)).endswith(
        f"or one of {len(report.effects) - 3} others: this clip cannot tell."
    )
    perhaps = dataclasses.replace(AMBIGUITY, candidates=("air_drag", NONE))
    assert answer(answered(report, perhaps)) == "Air drag or nothing at all: this clip cannot tell."
    two = SessionAnswer(("a", "b"), (5, 5), {}, (), {}, 1.0)
    said = answer(dataclasses.replace(answered(report, perhaps), session=two))
    assert said == "Air drag or nothing at all: these clips cannot tell."
    # Most evidence, and predicts worse: one candidate that is no answer.
    alone = answered(report, dataclasses.replace(AMBIGUITY, candidates=("air_drag",), stage="mechanics"))
    assert answer(alone) == "Perhaps air drag: this clip cannot settle it."
    assert certainty(alone).endswith("It acts in the mechanics stage.")
    assert "Together" not in certainty(alone)
    assert "What these clips can tell apart" in body(dataclasses.replace(alone, session=two))
    # What is no effect has its share as well: the numbers add up to what they hold together.
    assert "air drag 93 %, nothing missing 3 %" in certainty(answered(report, perhaps))


def test_frames_of_several_clips_are_counted_from_their_own_first_one() -> None:
    one = over_time([1.0, 2.0, 0.5], (), cursor=False)
    assert one is not None
    assert list(one.data[0].customdata) == ["frame 0", "frame 1", "frame 2"]
    figure = over_time([1.0] * 12 + [2.0] * 11, (), cursor=False, clips={"still": 12, "<shake>": 11})
    assert figure is not None
    said = list(figure.data[0].customdata)
    assert (said[11], said[12]) == ("still, frame 11", "&lt;shake&gt;, frame 0")
    assert list(figure.layout.xaxis.tickvals) == [0, 10, 12, 22]
    assert list(figure.layout.xaxis.ticktext) == ["0", "10", "0", "10"]
    assert [note.text for note in figure.layout.annotations] == ["still", "&lt;shake&gt;"]
    # A line before the second clip alone, beside that of the median.
    assert [line.x0 for line in figure.layout.shapes if line.x0 == line.x1] == [11.5]
    with pytest.raises(ValueError, match="23 frames in all, scores of 20"):
        over_time([1.0] * 20, (), cursor=False, clips={"still": 12, "shake": 11})


def test_what_may_be_touched_is_said_with_its_place(report: GapReport) -> None:
    wall = {"point": (0.1, -0.2, 0.854), "normal": (0.0, 0.0, -1.0)}
    session = SessionAnswer(("a", "b"), (5, 5), {}, (), {}, 1.0, obstacles={"b": wall})
    verdict = Verdict("contact", ("contact",), "mechanics", 0.95, "Because.", "")
    text = words(header(dataclasses.replace(answered(report, verdict), session=session)))
    assert "In b the cloth may touch something flat at (0.10, -0.20, 0.85) m" in text
    assert "that faces (0.00, 0.00, -1.00)" in text
    ball = dataclasses.replace(session, obstacles={"a": {"centre": (0.1, 0.2, 1.0), "radius": (0.14,)}})
    text = words(header(dataclasses.replace(answered(report, verdict), session=ball)))
    assert "In a the cloth may touch something round, 0.14 m in radius, about (0.10, 0.20, 1.00) m" in text
    without = dataclasses.replace(session, obstacles={})
    assert "touch" not in words(header(dataclasses.replace(answered(report, verdict), session=without)))


def test_what_is_unknown_is_said_to_look_like_something(report: GapReport) -> None:
    looks = {
        "rest_length_drift": StandIn(0.91, 0.064, {"axis 0 [%]": -5.8, "axis 1 [%]": 0.3}),
        "steady_forces": StandIn(0.02, 0.03, {"root mean square [m/s²]": 0.4}),
    }
    session = SessionAnswer(("a",), (5,), {}, (), {}, 1.0, stand_ins=looks)
    verdict = Verdict(UNKNOWN, (UNKNOWN,), UNKNOWN, 0.93, "Because.", "")
    text = words(header(dataclasses.replace(answered(report, verdict), session=session)))
    assert "may look like sides that become longer or shorter while they are filmed (91 %)" in text
    assert "axis 0 -5.8 %, axis 1 +0.3 %; it moves the cloth by 6.4 % of its width." in text
    # What is hardly likely is not said.
    assert "does not change" not in text
    torn = dataclasses.replace(looks["rest_length_drift"], moves=None)
    session = dataclasses.replace(session, stand_ins={"rest_length_drift": torn})
    text = words(header(dataclasses.replace(answered(report, verdict), session=session)))
    assert "axis 1 +0.3 %; a simulated cloth is torn apart by it." in text


def test_a_cloth_that_seems_to_become_smaller(report: GapReport) -> None:
    session = SessionAnswer(("a",), (5,), {}, (), {}, 1.0, resized={"clip_0": -0.0684})
    verdict = Verdict(UNKNOWN, (UNKNOWN,), UNKNOWN, 0.93, "Because.", "")
    text = words(header(dataclasses.replace(answered(report, verdict), session=session)))
    assert "In clip_0 the sides of the cloth seem to become 6.8 % shorter while what holds it" in text


def test_something_before_the_cloth(report: GapReport) -> None:
    covered = {"clip_0": Covered(0.0568, 12, 48)}
    session = SessionAnswer(("a",), (80,), {}, (), {}, 1.0, covered=covered)
    verdict = Verdict(UNKNOWN, (UNKNOWN,), UNKNOWN, 0.93, "Because.", "")
    text = words(header(dataclasses.replace(answered(report, verdict), session=session)))
    assert "In clip_0 up to 6 % of the print is gone between frames 12 and 48" in text


def test_what_would_not_show_is_said_where_nothing_does(report: GapReport) -> None:
    session = SessionAnswer(("a",), (5,), {}, (), {}, 1.0, unseen=("gravity_tilt",))
    for name, said in ((NONE, True), (UNKNOWN, False)):
        verdict = Verdict(name, (name,), name, 0.93, "Because.", "")
        text = words(header(dataclasses.replace(answered(report, verdict), session=session)))
        assert ("would not show tilted gravity, however strong" in text) is said


def test_what_would_not_show_has_no_part_in_that_nothing_acts(report: GapReport) -> None:
    """Answers that are one have their probability together, and each has its own in the table."""
    own = {NONE: 0.5, "gravity_tilt": 0.4, UNKNOWN: 0.1}
    classes = ((NONE, "gravity_tilt"),)
    session = SessionAnswer(("a",), (5,), own, classes, {}, 1.0, unseen=("gravity_tilt",))
    verdict = Verdict(NONE, (NONE, "gravity_tilt"), NONE, 0.9, "Because.", "")
    found = dataclasses.replace(answered(report, verdict), session=session)
    said = certainty(found)
    assert "90 %" in said
    assert "nothing is missing, or tilted gravity, which this clip would not show" in said
    assert "Not excluded" not in said
    table = words(body(found))
    assert "nothing missing the answer 50 %" in table
    assert "outside the catalogue 10 %" in table
    alike = dataclasses.replace(
        found,
        verdict=Verdict("gusts", ("gusts", "air_drag", NONE), "actuation", 0.95, "Because.", ""),
        session=dataclasses.replace(
            session,
            probabilities={"gusts": 0.5, "air_drag": 0.45, NONE: 0.05},
            equivalence_classes=(("air_drag", "gusts"),),
        ),
    )
    assert "it is one of gusts and air drag, which this clip cannot tell apart." in certainty(alike)
    assert certainty(alike).endswith("Not excluded: nothing at all.")


def test_an_answer_whose_trace_is_alike_another_is_said_to_be_told_by_fits(report: GapReport) -> None:
    """Not listed as what the clips cannot tell, beside a name with 99 %."""
    group = ("gusts", "air_drag", "gravity_tilt")
    session = SessionAnswer(("a",), (5,), {"gravity_tilt": 0.99, "gusts": 0.01}, (group,), {}, 1.0)
    alone = Verdict("gravity_tilt", ("gravity_tilt",), "actuation", 0.99, "Because.", "")
    found = dataclasses.replace(answered(report, alone), session=session)
    assert told_apart(found, group) == "to first order; what was fitted speaks for tilted gravity"
    assert told_apart(found, ("gusts", "air_drag")) == ""
    assert "speaks for tilted gravity" in words(body(found))
    # Where another of them is left, or they are the answer together, nothing tells them.
    left = dataclasses.replace(alone, candidates=("gravity_tilt", "gusts"))
    together = dataclasses.replace(alone, probability=1.0)
    for verdict in (left, together):
        assert told_apart(dataclasses.replace(found, verdict=verdict), group) == ""


def test_no_gap_and_unknown_causes(report: GapReport) -> None:
    quiet = tuple(dataclasses.replace(e, probability=0.001) for e in report.effects)
    for name, title in ((NONE, "nothing missing"), (UNKNOWN, "outside the catalogue")):
        verdict = Verdict(name, (name,), name, 0.95, "Because.", "")
        other = dataclasses.replace(answered(report, verdict), effects=quiet)
        assert "95 %" in words(header(other))
        # Caveats are in the reason.
        assert "Because." in words(header(other))
        ranking = re.search(r'<tr class="best"><th>(.*?)</th>.*?</tr>', body(other))
        assert ranking is not None
        assert title in ranking[1]
        # Nothing that the catalogue holds is presented as an answer.
        assert 'class="here"' not in body(other)


def test_nothing_seen_is_not_said_to_be_nothing_there(report: GapReport) -> None:
    sure = answered(report, Verdict(NONE, (NONE,), NONE, 0.95, "", ""))
    unsure = answered(report, Verdict(NONE, (NONE, UNKNOWN, "gusts"), NONE, 0.53, "", ""))
    assert "explains this clip" in answer(sure)
    assert "explains" not in answer(unsure)
    assert answer(unsure) == "No missing effect shows in this clip."
    assert "outside the catalogue and gusts" in words(header(unsure))


def test_holds_every_part(report: GapReport, made_up_gap: MakeArrays, tiny_scene: Scene) -> None:
    assert tiny_scene.ground_truth is not None
    assert tiny_scene.ground_truth.vertices is not None
    arrays = made_up_gap(tiny_scene.ground_truth.vertices.numpy(), 3)
    text = body(report, arrays, tiny_scene)
    assert titles(text) == [
        "Where it lies",
        "How far it shrinks",
        "Which effect",
        "Where on the cloth",
        "How far the base model strays",
        "When",
        "In which regime",
        "What this clip can tell apart",
        "How it was made",
    ]
    said = words(text)
    for stage in ("numerics", "actuation", "mechanics", "camera", "appearance", "observation"):
        assert stage in said
    # Numerics has no share in the report, which is not the same as none.
    assert re.search(r'<li class="absent"><span><b>numerics</b>', text)
    assert "71 %" in said
    assert "0.800 1/s" in said
    assert "air drag and internal damping" in said
    assert "not within its bounds" in said
    assert "gusts (the largest drop of the training loss)" in said
    assert "0 to 29" in said
    assert "air_drag explains <it>." in said
    assert "scene: <tiny>" in said


def test_is_self_contained_and_escapes(report: GapReport, made_up_gap: MakeArrays, tiny_scene: Scene) -> None:
    nasty = "<script>alert(1)</script>"
    effects = tuple(
        dataclasses.replace(
            e,
            name=f"{e.name}{nasty}",
            stage=nasty,
            shrink=None if e.shrink is None else dataclasses.replace(e.shrink, held_out=nasty, metric=nasty),
            parameters={name + nasty: dataclasses.replace(p, unit=nasty) for name, p in e.parameters.items()},
        )
        for e in report.effects
    )
    alias = dataclasses.replace(
        report.alias,
        names=tuple(n + nasty for n in report.alias.names),
        detection_limits={n + nasty: v for n, v in report.alias.detection_limits.items()},
    )
    bad = GapReport(
        Verdict(f"air_drag{nasty}", (nasty,), nasty, 0.9, nasty, nasty, nasty),
        Where({nasty: 1.0}, (1.0,), None, {nasty: 1.0}),
        effects,
        alias,
        dataclasses.replace(report.protocol, version=nasty, naive=nasty),
    )
    text = DiagnosisPage(bad, DiagnosisArrays(config=nasty), None, nasty).render()
    assert "alert(1)" in text
    assert nasty not in text
    assert text.count("plotly.js v") == 1
    plain = re.sub(r"<head>.*?</head>", "", text, flags=re.DOTALL)
    assert not re.search(r'(?:src|href)="(?!data:|#)', plain)


def test_leaves_out_what_there_is_no_data_for(report: GapReport, tmp_path: Path) -> None:
    bare = GapReport(
        Verdict(NONE, (NONE,), NONE, 0.9, "", ""), Where({}, (), None), (), Alias(), report.protocol
    )
    assert titles(body(bare)) == ["How it was made"]
    no_shrink = dataclasses.replace(
        report, effects=tuple(dataclasses.replace(e, shrink=None) for e in report.effects)
    )
    text = body(no_shrink)
    assert "How far it shrinks" not in titles(text)
    assert "fit has seen" not in words(text)
    assert "What this clip can tell apart" not in titles(body(dataclasses.replace(report, alias=Alias())))
    page = write_diagnosis_page(tmp_path / "index.html", bare)
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")


def test_a_motion_on_another_grid_gives_the_map_alone(
    report: GapReport, made_up_gap: MakeArrays, tiny_scene: Scene
) -> None:
    arrays = made_up_gap(np.zeros((4, 7, 7, 3)), 3)
    text = body(report, arrays, tiny_scene)
    assert 'id="viewer"' not in text
    assert 'id="map-gap"' in text


def test_no_mark_of_the_shrinkage_lies_on_the_edge(report: GapReport) -> None:
    """One that predicts worse was cut in half, with its number."""
    worse = dataclasses.replace(SHRINK, with_effect=9.6, estimate=-0.2, low=-0.3, high=-0.1)
    figure = held_out([dataclasses.replace(e, shrink=worse) for e in report.effects], ())
    assert figure is not None
    first, last = figure.layout.xaxis.range
    farthest = max(x for trace in figure.data for x in trace.x)
    assert first == 0
    assert farthest == pytest.approx(1.3 * SHRINK.base)
    assert last > 1.05 * farthest


def test_no_shrinkage_is_claimed_within_the_placebo() -> None:
    assert beats_placebo(SHRINK)
    weak = dataclasses.replace(SHRINK, low=0.02)
    assert not beats_placebo(weak)
    assert "no shrinkage is claimed" in shrinkage(weak)
    assert "placebo" not in shrinkage(dataclasses.replace(SHRINK, best_placebo=None))
    worse = dataclasses.replace(SHRINK, with_effect=9.6, estimate=-0.2, low=-0.3, high=-0.1)
    assert "grows from 8 to 9.6 mm: 20 % more (10 % to 30 %)" in shrinkage(worse)
    # An interval that holds no change is said the way that the value is.
    perhaps = dataclasses.replace(SHRINK, with_effect=8.4, estimate=-0.05, low=-0.1, high=0.03)
    assert "5 % more (-3 % to 10 %)" in shrinkage(perhaps).replace("\N{MINUS SIGN}", "-")
    # A bad placebo does not make nothing into something.
    assert not beats_placebo(dataclasses.replace(SHRINK, low=-0.01, best_placebo=-0.5))


def test_a_clip_that_fits_have_seen_is_not_called_unseen() -> None:
    seen, unseen = (
        shrinkage(dataclasses.replace(SHRINK, held_out=held))
        for held in ("pieces of 12 frames", "the last clip")
    )
    assert "no fit has seen" not in seen
    gusts = shrinkage(dataclasses.replace(SHRINK, held_out="the last clip"), "gusts")
    assert "which no fit has seen but that of its own gusts," in gusts
    assert "of its own" not in shrinkage(dataclasses.replace(SHRINK, held_out="the last clip"), "air_drag")
    assert "no fit has seen" in unseen


def test_says_when_the_most_probable_effect_moves_the_cloth(report: GapReport) -> None:
    session = SessionAnswer(("a",), (5,), {}, (), {}, 1.0, moved_by="gusts")
    moved = dataclasses.replace(session, moved=(0.0, 0.001, 0.006, 0.02, 0.004))
    text = words(body(dataclasses.replace(report, session=moved)))
    assert "gusts" in text
    assert "more than 0.5 % of its width in frames 2 to 3, most in frame 3 (2.0 %)" in text
    still = dataclasses.replace(report, session=dataclasses.replace(moved, moved=(0.0,)))
    assert "nowhere moves the cloth" in when_moved(still)
    assert when_moved(dataclasses.replace(report, session=session)) == when_moved(report) == ""


def test_a_second_effect_is_named_or_said_to_be_none(report: GapReport) -> None:
    two = Verdict("gusts", ("gusts", "air_drag"), "actuation", 0.95, "Both.", "", also="air_drag")
    report = dataclasses.replace(report, verdict=two)
    session = SessionAnswer(("a",), (5,), {}, (), {}, 1.0, moved_by="gusts")
    beside = dataclasses.replace(session, beside={"air_drag": 0.96, "none": 0.04})
    both = dataclasses.replace(report, session=beside)
    assert "Beside gusts: air drag 96 %, nothing else 4 %" in words(body(both))
    assert "Both are the answer" in what_acts_beside(both)
    assert "Not excluded" not in certainty(both)
    weak = dataclasses.replace(session, beside={"air_drag": 0.6, "none": 0.4})
    alone = dataclasses.replace(report, verdict=dataclasses.replace(two, also=None), session=weak)
    assert "Not enough to name a second effect" in what_acts_beside(alone)
    rival = dataclasses.replace(beside, moved_by="air_drag", first="gusts", second="air_drag")
    assert "Beside gusts: air drag 96 %" in what_acts_beside(dataclasses.replace(report, session=rival))
    of_image = dataclasses.replace(two, also="shading")
    third = dataclasses.replace(report, verdict=of_image, session=rival)
    assert "4 %. Enough to name a second effect." in what_acts_beside(third)
    shrink = Shrink("position [mm]", "the last clip", 1.0, 1.06, -0.06, -0.1, -0.02)
    refuted = dataclasses.replace(beside, second_shrink=shrink)
    said = what_acts_beside(dataclasses.replace(alone, session=refuted))
    assert said.endswith("With both, the last clip is predicted 6 % worse, so it is not named.")
    harmless = dataclasses.replace(refuted, second_shrink=dataclasses.replace(shrink, high=0.01))
    assert "worse" not in what_acts_beside(dataclasses.replace(both, session=harmless))
    none = dataclasses.replace(session, beside={"none": 0.98, "air_drag": 0.02})
    assert "no other effect shows" in what_acts_beside(dataclasses.replace(report, session=none))
    assert what_acts_beside(dataclasses.replace(report, session=session)) == what_acts_beside(report) == ""


def test_words_for_numbers() -> None:
    assert [percent(p) for p in (0.0, 0.001, 0.5, 0.999, 1.0)] == ["0 %", "< 1 %", "50 %", "> 99 %", "100 %"]
    assert frame_ranges((0, 1, 2, 5)) == "0 to 2, 5"
    assert frame_ranges(()) == "none"


def test_words_for_changes() -> None:
    shares = (0.6, 0.004, -0.004, -0.2, 0.0001, -0.0001, 0.0)
    assert [change(s) for s in shares] == ["−60 %", "−0.4 %", "+0.4 %", "+20 %", *["no change"] * 3]
    assert change_between(0.52, 0.68) == "−68 % to −52 %"
    assert change_between(-0.004, 0.003) == "−0.3 % to +0.4 %"
    assert change_between(-0.0001, 0.0001) == ""
    assert amount(-0.0001) == "0 %"
    nothing = dataclasses.replace(SHRINK, with_effect=8.0, estimate=1e-5, low=-1e-5, high=2e-5)
    assert "stays at 8 mm. That is not clearly more" in shrinkage(nothing)
    little = dataclasses.replace(SHRINK, with_effect=8.03, estimate=-0.004, low=-0.0041, high=-0.0039)
    assert "grows from 8 to 8.03 mm: 0.4 % more. That" in shrinkage(little)


def test_small_changes_and_pinned_numbers_read_well(
    report: GapReport, made_up_gap: MakeArrays, tiny_scene: Scene
) -> None:
    pinned = Estimate(0.0, 0.0, 0.0, "1/s")
    tiny = dataclasses.replace(SHRINK, estimate=0.001, low=-0.002, high=0.004)
    effects = tuple(
        dataclasses.replace(e, parameters={"linear": pinned}, shrink=tiny) if e.shrink else e
        for e in report.effects
    )
    assert tiny_scene.ground_truth is not None
    assert tiny_scene.ground_truth.vertices is not None
    arrays = made_up_gap(tiny_scene.ground_truth.vertices.numpy(), 3)
    nothing = Verdict(NONE, (NONE, "gusts"), NONE, 0.53, "", "")
    text = body(dataclasses.replace(answered(report, nothing), effects=effects), arrays, tiny_scene)
    said = words(text)
    assert "−0.1 % −0.4 % to +0.2 %" in said
    assert "−<" not in said
    assert "− <" not in said
    assert "+<" not in said
    assert not re.search(r"\b0 to 0\b(?!\.)", said)
    assert "at its bound" in said
    # A distance in millimetres is no gap that an answer could deny.
    assert "No missing effect shows" in said
    assert "mean distance of the base model" in said
    assert "gap" not in words(text[: text.index("</header>")])


def test_what_was_refitted_is_shown_however_improbable(report: GapReport) -> None:
    effects = tuple(
        dataclasses.replace(e, shrink=SHRINK) if e.name == "gravity_tilt" else e for e in report.effects
    )
    text = body(dataclasses.replace(report, effects=effects))
    assert "gravity tilt" in text[text.index("Which effect") : text.index("others below 1 %")]
    sure = answered(report, dataclasses.replace(report.verdict, probability=0.999))
    assert '<strong class="value">&gt; 99 %</strong>' in header(sure)


def test_certainty_says_what_the_stage_is(report: GapReport) -> None:
    mixed = answered(report, dataclasses.replace(AMBIGUITY, stage=UNKNOWN))
    assert "stage" not in certainty(mixed)
    assert "mechanics stage" in certainty(answered(report, AMBIGUITY))


def test_an_effect_that_predicts_worse_is_not_said_to_be_within_a_placebo() -> None:
    assert doubt(SHRINK) == ""
    assert doubt(dataclasses.replace(SHRINK, low=0.01)) == "within placebo"
    worse = dataclasses.replace(SHRINK, estimate=-0.23, low=-0.3, high=-0.16, best_placebo=0.02)
    assert doubt(worse) == "predicts worse"


def test_held_out_chart_places_base_effect_and_placebo(report: GapReport) -> None:
    chart = held_out(report.effects, ("air_drag",))
    assert chart is not None
    first = {t.name: t.x[0] for t in reversed(chart.data) if t.mode == "markers" and t.y[0] == 0}
    assert first["base model"] == 8.0
    assert first["with the effect (and 90 % interval)"] == pytest.approx(3.2)
    assert first["best placebo"] == pytest.approx(7.6)
    assert held_out([dataclasses.replace(e, shrink=None) for e in report.effects], ()) is None


def test_alias_matrix_puts_the_same_traces_side_by_side(report: GapReport) -> None:
    alias = Alias(
        ("a", "b", "c", "d"), ((1, 0.1, 0.95, 0), (0.1, 1, 0, 0.9), (0.95, 0, 1, 0), (0, 0.9, 0, 1))
    )
    order = [alias.names[i] for i in alias_order(alias)]
    assert abs(order.index("a") - order.index("c")) == 1
    assert abs(order.index("b") - order.index("d")) == 1
    chart = alias_matrix(alias)
    assert chart is not None
    shown = np.array(chart.data[0].z, dtype=float)
    # Every pair once, and no name with itself.
    assert np.isfinite(shown).sum() == 6
    assert sorted(shown[np.isfinite(shown)]) == [0, 0, 0, 0.1, 0.9, 0.95]
    assert alias_matrix(Alias()) is None


def test_gap_field_interpolates_and_knows_what_was_held_out() -> None:
    i, j = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 3), indexing="ij")
    gap = np.stack([1e-3 * (1 + i + 2 * j), np.zeros((4, 3))])
    field = gap_field(DiagnosisArrays(frames_vertices=gap), (7, 9), (1,))
    assert field is not None
    fine_i, fine_j = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 9), indexing="ij")
    np.testing.assert_allclose(field.values[0], 1 + fine_i + 2 * fine_j, atol=1e-12)
    assert np.isnan(field.values[1]).all()
    assert gap_field(DiagnosisArrays(), (7, 9)) is None


def test_arrays_are_read_as_far_as_they_exist(report: GapReport, tmp_path: Path) -> None:
    assert (
        DiagnosisArrays.read(tmp_path, dataclasses.replace(report, where=Where({}, (), None))).positions
        is None
    )
    rng = np.random.default_rng(0)
    gap, positions = rng.random((4, 4, 3)), rng.random((4, 30, 3))
    np.save(tmp_path / "gap_vertices.npy", gap[0])
    np.save(tmp_path / "acts.npy", gap[1])
    report = dataclasses.replace(report, where=dataclasses.replace(report.where, acts_on="acts.npy"))
    np.save(tmp_path / "gap_frames_vertices.npy", gap)
    np.savez(tmp_path / "tracked.npz", positions=positions, used=3)
    np.savez(
        tmp_path / "screening.npz",
        names=np.array(["air_drag", "gusts"]),
        log_evidence=np.array([4.0, 1.0]),
        unknown=np.array(2.0),
        discrepancy=np.array([0.4, 0.1]),
        base=np.arange(5.0),
        costs=np.array([3.0, 2.0]),
    )
    (tmp_path / "config.yaml").write_text("seed: 0\n")
    found = DiagnosisArrays.read(tmp_path, report)
    assert found.vertices is not None
    np.testing.assert_array_equal(found.vertices, gap[0])
    assert found.screening is not None
    assert found.screening.log_evidence == {"air_drag": 4.0, "gusts": 1.0}
    assert found.config == "seed: 0\n"
    (tmp_path / "tracked.npz").write_text("nonsense")
    with pytest.raises(InputError, match=r"tracked\.npz"):
        DiagnosisArrays.read(tmp_path, report)


_SPEC = importlib.util.spec_from_file_location(
    "chromium", Path(__file__).parents[3] / "docs" / "images" / "chromium.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
chromium = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(chromium)
# A talk's screen; a window over the whole page takes the browser minutes.
WIDTH, HEIGHT = 1200, 1400
# Notes every complaint of the page from its first script on.
WATCH = """<script>
window.trouble = [];
addEventListener("error", (e) => trouble.push("error: " + e.message));
addEventListener("unhandledrejection", (e) => trouble.push("rejected: " + e.reason));
addEventListener("securitypolicyviolation", (e) => trouble.push("blocked: " + e.blockedURI));
console.error = (...words) => trouble.push("console: " + words.join(" "));
</script>"""
# Once everything is drawn, says what the page is like; with a viewer, after it has moved by a frame.
PROBE = """<script>
const waiting = setInterval(() => {
  if (!document.documentElement.dataset.ready) return;
  clearInterval(waiting);
  const find = (id) => document.getElementById(id);
  const cursor = () => ["over-time", "map-gap"].map((id) => find(id)?.layout.shapes?.[0].x0);
  const before = cursor();
  if (find("viewer"))
    document.body.dispatchEvent(new KeyboardEvent("keydown", { key: "Home", bubbles: true }));
  // Figures out of sight wait, but for print.
  dispatchEvent(new Event("beforeprint"));
  setTimeout(() => {
    const wide = [...document.querySelectorAll("main *")].filter((e) => !e.closest("svg, .plot, .scroll"))
      .filter((e) => e.scrollWidth > e.clientWidth + 1 && e.clientWidth > 0)
      .filter((e) => getComputedStyle(e).overflow === "visible" && getComputedStyle(e).display !== "inline");
    const found = {
      trouble,
      requests: performance.getEntriesByType("resource").map((r) => r.name)
        .filter((name) => !/^(data|blob):/.test(name)),
      overflow: document.documentElement.scrollWidth - innerWidth,
      wide: wide.map((e) => e.tagName + "." + e.className + " " + e.textContent.slice(0, 40)),
      undrawn: [...document.querySelectorAll("[data-figure]")].filter((p) => !p.querySelector("svg")).length,
      boxes: Object.fromEntries([...document.querySelectorAll(".plot, .ladder")]
        .map((p) => [p.id || p.className, p.getBoundingClientRect()])
        .map(([name, b]) => [name, [b.left, b.top, b.right, b.bottom].map(Math.round)])),
      cursors: [before, cursor()],
      clock: find("clock")?.textContent,
    };
    const note = document.createElement("pre");
    note.id = "probe";
    note.hidden = true;
    note.textContent = JSON.stringify(found);
    document.body.append(note);
    if (parent !== window) parent.postMessage(note.textContent, "*");
  }, 500);
}, 20);
</script>"""


def look(page: Path, width: int = WIDTH) -> tuple[dict[str, Any], np.ndarray]:
    """What the page says about itself, and its picture (h, w, 3)."""
    watched, picture = page.with_name("watched.html"), page.with_name("page.png")
    text = page.read_text(encoding="utf-8").replace("<title>", WATCH + "<title>", 1)
    watched.write_text(text.replace("</body>", PROBE + "</body>"), encoding="utf-8")
    dom = chromium.show(watched.as_uri(), picture, width=width, height=HEIGHT)
    found = re.search(r'<pre id="probe"[^>]*>(.*?)</pre>', dom, flags=re.DOTALL)
    assert found, "the page was never ready"
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    return json.loads(found[1].replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")), pixels


def check_page(probe: dict[str, Any]) -> None:
    assert probe["trouble"] == []
    assert probe["requests"] == []
    assert probe["overflow"] == 0
    assert probe["wide"] == []
    assert probe["undrawn"] == 0


in_browser = pytest.mark.skipif(chromium.executable() is None, reason="no Chromium found")


@in_browser
def test_in_a_browser(
    made_up_diagnosis: MakeReport, made_up_gap: MakeArrays, tiny_scene: Scene, tmp_path: Path
) -> None:
    assert tiny_scene.ground_truth is not None
    assert tiny_scene.ground_truth.vertices is not None
    arrays = made_up_gap(tiny_scene.ground_truth.vertices.numpy(), 3)
    report = made_up_diagnosis(tiny_scene.n_frames, 3)
    probe, picture = look(write_diagnosis_page(tmp_path / "index.html", report, arrays, tiny_scene))
    check_page(probe)
    assert probe["clock"].startswith("frame 0 of 3")
    # Map and bars follow the frame.
    assert probe["cursors"] == [[2, 2], [0, 0]]
    for name in ("held-out", "ladder"):
        left, top, right, bottom = probe["boxes"][name]
        part = picture[max(top, 0) : bottom, max(left, 0) : right]
        assert part.size, name
        assert part.std() > 6, name


@in_browser
def test_on_a_phone(
    made_up_diagnosis: MakeReport, made_up_gap: MakeArrays, tiny_scene: Scene, tmp_path: Path
) -> None:
    assert tiny_scene.ground_truth is not None
    assert tiny_scene.ground_truth.vertices is not None
    arrays = made_up_gap(tiny_scene.ground_truth.vertices.numpy(), 3)
    report = made_up_diagnosis(tiny_scene.n_frames, 3)
    page = write_diagnosis_page(tmp_path / "index.html", report, arrays, tiny_scene)
    probe, picture = look(page, width=chromium.PHONE)
    check_page(probe)
    assert picture.shape[1] == chromium.PHONE
    assert probe["cursors"] == [[2, 2], [0, 0]]


@in_browser
def test_without_a_motion_in_a_browser(report: GapReport, tmp_path: Path) -> None:
    arrays = DiagnosisArrays(np.linspace(0, 4e-3, 400).reshape(20, 20))
    probe, picture = look(
        write_diagnosis_page(tmp_path / "index.html", answered(report, AMBIGUITY), arrays, None, "a" * 200)
    )
    check_page(probe)
    assert "clock" not in probe
    assert picture.std() > 8


DIFFERENCES = ("diagnosis.sides: [14], calibrated with [20]", "<a>", "b", "c", "d")


def calibrated(report: GapReport, *differences: str) -> GapReport:
    use = CalibrationUse(not differences, "", "0a1b", "2c3d", differences)
    return dataclasses.replace(report, calibration=use)


def test_an_uncalibrated_answer_says_so_wherever_it_says_a_probability(report: GapReport) -> None:
    found = calibrated(report, *DIFFERENCES)
    text = words(header(found))
    assert "Uncalibrated: no scenes with known effects were diagnosed with these settings" in text
    assert "diagnosis.sides: [14], calibrated with [20]; <a>; b; and 2 more" in text
    assert "Probability 93 % (uncalibrated)" in text
    assert "probability of this answer, uncalibrated" in text
    # Under the answer, and in the table; the rest is listed where it is said how it was made.
    assert text.index("The gap is air drag.") < text.index("Uncalibrated:")
    everything = words(body(found))
    assert "probability, uncalibrated" in everything
    assert "b; c; d" in everything
    assert "Uncalibrated:" in answer_text(found)
    assert "probability, uncalibrated" in ranking_table(found)
    ambiguous = words(header(answered(found, AMBIGUITY)))
    assert "hold 96 % (uncalibrated) of the probability" in ambiguous
    assert "air drag, uncalibrated" in ambiguous


def test_a_calibrated_answer_and_one_of_before_say_nothing_of_it(report: GapReport) -> None:
    for found in (calibrated(report), report):
        assert "ncalibrated" not in words(body(found))
        assert "ncalibrated" not in answer_text(found) + ranking_table(found)
    assert "made with the same settings (0a1b)" in words(body(calibrated(report)))


def test_warnings_of_the_scene_stand_above_the_answer(report: GapReport) -> None:
    assert 'class="warning"' not in header(report)
    text = header(dataclasses.replace(report, warnings=("The focal length is <guessed>.",)))
    assert text.index("The focal length is &lt;guessed&gt;.") < text.index('class="lead"')


@pytest.mark.parametrize(
    ("clips", "says", "not_said"),
    [
        ((), "frames that nothing was fitted to", "have seen"),
        (("release",), "by fits that have seen them", "nothing was fitted to"),
        (("release", "shake"), "by fits to the other clips", "have seen"),
    ],
)
def test_the_page_says_what_a_prediction_has_seen(
    report: GapReport, clips: tuple[str, ...], says: str, not_said: str
) -> None:
    session = SessionAnswer(clips, (12,) * len(clips), {}, (), {}, 1.0) if clips else None
    page = body(dataclasses.replace(report, session=session))
    assert says in page
    assert not_said not in page
