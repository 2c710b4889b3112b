"""Final numbers of a run in TensorBoard, read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import metadata
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from toile.reports.dashboard import FINAL_METRICS, FINAL_SECONDS, write_dashboard

NUMBERS: dict[str, Any] = {
    "metrics": {
        "chamfer": {"title": "Chamfer", "unit": "×10⁻⁴ m²", "protocol": "a | b", "mean": 0.5},
        "silhouette_iou": {"title": "IoU", "unit": "", "protocol": "over all frames", "mean": None},
    },
    "skipped": {"vertex_error": "the scene has no true vertices"},
    "fit": {"cycles": 12, "seconds of the fit": 3.5, "last losses": {"loss": 1.0}},
    "machine": {"processor": "a processor", "threads": 1},
}
CHOICES = {
    "scene": "R1",
    "ablation": "none",
    "asked for": "parameters.shearing=5",
    "seed": 3,
    "start: shearing": 20.0,
}


@pytest.fixture
def events(tmp_path: Path) -> EventAccumulator:
    write_dashboard(tmp_path, CHOICES, "seed: 3\nscene:\n  name: R1\n", NUMBERS)
    found = EventAccumulator(str(tmp_path))
    found.Reload()
    return found


def test_final_metrics_are_scalars_where_they_were_measured(events: EventAccumulator) -> None:
    assert {tag: events.Scalars(tag)[0].value for tag in events.Tags()["scalars"]} == {
        "final/chamfer_x1e4_m2": 0.5,
        FINAL_SECONDS: 3.5,
    }
    assert events.Scalars(FINAL_SECONDS)[0].step == 12


def test_runs_are_compared_by_the_same_choices_and_metrics(events: EventAccumulator, tmp_path: Path) -> None:
    # In the run's own folder: another one would be another run.
    assert [p.name.startswith("events.out.tfevents.") for p in tmp_path.iterdir()] == [True]

    def plugin_data(tag: str) -> HParamsPluginData:
        return HParamsPluginData.FromString(events.SummaryMetadata(tag).plugin_data.content)

    given = plugin_data(metadata.SESSION_START_INFO_TAG).session_start_info.hparams
    assert given["scene"].string_value == "R1"
    assert given["seed"].number_value == 3
    assert given["start: shearing"].number_value == 20
    experiment = plugin_data(metadata.EXPERIMENT_TAG).experiment
    assert {info.name for info in experiment.hparam_infos} == set(CHOICES)
    assert {info.name for info in experiment.hparam_infos if info.differs} == {
        "scene",
        "ablation",
        "asked for",
        "seed",
    }
    # Also those that this run has no value for, because TensorBoard reads the list of any one run.
    assert {info.name.tag for info in experiment.metric_infos} == {*FINAL_METRICS, FINAL_SECONDS}


def text(events: EventAccumulator, tag: str) -> str:
    return str(events.Tensors(f"{tag}/text_summary")[0].tensor_proto.string_val[0].decode())


def test_text(events: EventAccumulator) -> None:
    lines = text(events, "final metrics").splitlines()
    assert lines[0] == "| metric | mean | unit | protocol |"
    assert lines[2] == "| Chamfer | 0.5 | ×10⁻⁴ m² | a &#124; b |"
    assert "| IoU | – |  | over all frames |" in lines
    assert "| vertex_error | – |  | not measured: the scene has no true vertices |" in lines
    assert "| seconds of the fit | 3.5 |  |  |" in lines
    assert "| processor | a processor |" in text(events, "machine")
    assert text(events, "configuration") == "```yaml\nseed: 3\nscene:\n  name: R1\n```"
