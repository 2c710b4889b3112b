"""What ``toile fit`` leaves for TensorBoard's comparison of runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import metadata
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from toile.scenes.native import write_native
from toile.scenes.scene import Scene

Toile = Callable[..., Any]
SHORT = ("optimization.cycles=2", "report.video=false", "report.page=false", "callbacks.pictures.frames=1")


def choices(events: EventAccumulator) -> dict[str, str | float]:
    content = events.SummaryMetadata(metadata.SESSION_START_INFO_TAG).plugin_data.content
    values = HParamsPluginData.FromString(content).session_start_info.hparams
    return {name: v.string_value or v.number_value for name, v in values.items()}


def test_a_sweep_can_be_compared(swaying_scene: Scene, toile: Toile, tmp_path: Path) -> None:
    write_native(swaying_scene, tmp_path / "data" / "made" / "swaying")
    outcome = toile(
        "fit", "-m", "scene=swaying", "experiment=paper", "seed=0,1", *SHORT, "hydra.sweep.dir=sweep"
    )
    assert outcome.status == 0, outcome.err
    runs = sorted(path.parent for path in tmp_path.glob("sweep/*/tensorboard"))
    assert len(runs) == 2
    found = []
    for run in runs:
        events = EventAccumulator(str(run / "tensorboard"))
        events.Reload()
        found.append(choices(events))
        metrics = json.loads((run / "metrics.json").read_text())["metrics"]
        final = events.Scalars("final/chamfer_x1e4_m2")[0].value
        assert abs(final - metrics["chamfer"]["mean"]) < 1e-6
        assert {"final metrics/text_summary", "configuration/text_summary"} <= set(events.Tags()["tensors"])
        assert (run / "chamfer.csv").is_file()
    assert [c.pop("seed") for c in found] == ["0", "1"]
    # Whatever was asked for is a column, but for what has one and what leaves the result alone.
    assert found[0]["asked for"] == "experiment=paper, optimization.cycles=2"
    assert found[0] == found[1]
    assert found[0]["scene"] == "swaying"
    assert found[0]["optimization"] == "adam"
    assert found[0]["cloth/rest_lengths"] == "uniform"
    assert found[0]["start: stretching"] == 3000


def test_without_a_logger(swaying_scene: Scene, toile: Toile, tmp_path: Path) -> None:
    write_native(swaying_scene, tmp_path / "data" / "made" / "swaying")
    arguments = ("scene=swaying", "experiment=paper", *SHORT, "logger=none", "hydra.run.dir=run")
    assert toile("fit", *arguments).status == 0
    assert (tmp_path / "run" / "metrics.json").is_file()
    assert not (tmp_path / "run" / "tensorboard").exists()
