"""A diagnosis in TensorBoard, read back."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from toile.diagnosis.record import NONE, Alias, GapReport, Verdict, Where
from toile.reports.diagnosis_arrays import DiagnosisArrays
from toile.reports.diagnosis_dashboard import answer_text, ranking_table, write_diagnosis_dashboard


def events(folder: Path) -> EventAccumulator:
    found = EventAccumulator(str(folder))
    found.Reload()
    return found


def text(found: EventAccumulator, tag: str) -> str:
    return str(found.Tensors(f"{tag}/text_summary")[0].tensor_proto.string_val[0].decode())


@pytest.fixture
def report(made_up_diagnosis: Callable[..., GapReport]) -> GapReport:
    return made_up_diagnosis(8, 6)


def test_everything_is_there(
    report: GapReport, made_up_gap: Callable[..., DiagnosisArrays], tmp_path: Path
) -> None:
    arrays = made_up_gap(np.zeros((8, 4, 4, 3)), 6)
    write_diagnosis_dashboard(tmp_path, report, arrays)
    found = events(tmp_path)

    def scalars(tag: str) -> list[float]:
        return [event.value for event in found.Scalars(tag)]

    assert scalars("verdict/probability") == pytest.approx([0.93])
    assert scalars("probability/air_drag") == pytest.approx([0.93])
    assert scalars("shrink/air_drag") == pytest.approx([0.6])
    assert scalars("stage/mechanics") == pytest.approx([0.71])
    assert scalars("log evidence/gusts") == [-2.0]
    assert scalars("base fit/cost") == [900.0, 410.0, 395.0]
    assert scalars("distance/over its median") == pytest.approx(report.where.frames[:6])
    assert arrays.frames_vertices is not None
    assert scalars("distance/mean [mm]") == pytest.approx(1e3 * arrays.frames_vertices[:6].mean((1, 2)))
    assert set(found.Tags()["images"]) == {"alias matrix", "distance on the cloth"}
    assert "The gap is air drag." in text(found, "answer")
    assert text(found, "ranking").splitlines()[2].startswith("| air drag | mechanics | 93 % | linear 0.8 [")
    assert "| contact | " in text(found, "detection limits")
    assert "scene: <tiny>" in text(found, "configuration")


def test_a_bare_report(report: GapReport, tmp_path: Path) -> None:
    bare = GapReport(
        Verdict(NONE, (NONE,), NONE, 0.9, "", ""), Where({}, (), None), (), Alias(), report.protocol
    )
    write_diagnosis_dashboard(tmp_path, bare)
    found = events(tmp_path)
    assert found.Tags()["scalars"] == ["verdict/probability"]
    assert found.Tags()["images"] == []
    assert "No effect is missing" in text(found, "answer")


def test_markdown_shows_names_as_they_are(report: GapReport) -> None:
    strange = dataclasses.replace(report.verdict, reason="a_b is *not* <c>", next_recording="a|b")
    shown = answer_text(dataclasses.replace(report, verdict=strange))
    assert "a\\_b is \\*not\\* &lt;c>" in shown
    assert ranking_table(report).count("\n") == 1 + len(report.effects)
