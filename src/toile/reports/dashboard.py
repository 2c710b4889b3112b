"""What TensorBoard shows of a finished run: its numbers as text, and its place among other runs (HPARAMS)."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

Choice = str | float | bool

FINAL_METRICS = {
    "final/chamfer_x1e4_m2": "chamfer",
    "final/vertex_error_percent_of_width": "vertex_error_percent",
    "final/silhouette_iou": "silhouette_iou",
}
"""Tags of the numbers by which runs are compared, and the metric each comes from."""
ASKED_FOR = "asked for"
"""Choice that holds all settings given on the command line, so that none that varies is hidden."""
FIRST_CHOICES = ("scene", ASKED_FOR, "ablation", "simulator", "seed")
"""What sweeps usually go over; the others are a tick away."""
FINAL_SECONDS = "final/seconds_of_the_fit"


def write_dashboard(
    folder: Path, choices: Mapping[str, Choice], config: str, numbers: Mapping[str, Any]
) -> None:
    """Add the final numbers to a folder of TensorBoard events.

    Args:
        folder: of the run's events; whoever wrote them must have finished.
        choices: what distinguishes the run from others; every run must name the same ones.
        config: resolved configuration (YAML text).
        numbers: what metrics.json holds.
    """
    fit = numbers.get("fit", {})
    step = int(fit.get("cycles", 0))
    metrics = {tag: _mean(numbers, key) for tag, key in FINAL_METRICS.items()}
    metrics[FINAL_SECONDS] = float(fit.get("seconds of the fit", math.nan))
    with SummaryWriter(str(folder), filename_suffix=".final") as writer:
        for tag, value in metrics.items():
            if math.isfinite(value):
                writer.add_scalar(tag, value, step)
        writer.add_text("final metrics", metrics_table(numbers), step)
        writer.add_text("machine", table(("", ""), list(numbers.get("machine", {}).items())), step)
        writer.add_text("configuration", f"```yaml\n{config.strip()}\n```", step)
        # SummaryWriter.add_hparams would make a folder of its own, and with it a second run.
        experiment, start, end = hparams(dict(choices), metrics)
        _put_first(experiment, FIRST_CHOICES)
        for summary in (experiment, start, end):
            writer.file_writer.add_summary(summary)


def metrics_table(numbers: Mapping[str, Any]) -> str:
    """The final metrics in Markdown, each with how it was measured; then what was not, and why."""
    metrics = numbers.get("metrics", {}).values()
    rows = [(m["title"], _text(m["mean"]), m["unit"], m["protocol"]) for m in metrics]
    rows += [(key, "–", "", f"not measured: {why}") for key, why in numbers.get("skipped", {}).items()]
    fit = {k: v for k, v in numbers.get("fit", {}).items() if isinstance(v, int | float)}
    rows += [(name, _text(value), "", "") for name, value in fit.items()]
    return table(("metric", "mean", "unit", "protocol"), rows)


def table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    """A table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(c).replace("|", "&#124;") for c in line) + " |" for line in lines)


def _put_first(experiment: Any, names: Collection[str]) -> None:
    """TensorBoard shows five choices from the start: those marked as different, in alphabetical order."""
    plugin = experiment.value[0].metadata.plugin_data
    content = HParamsPluginData.FromString(plugin.content)
    for choice in content.experiment.hparam_infos:
        choice.differs = choice.name in names
    plugin.content = content.SerializeToString()


def _mean(numbers: Mapping[str, Any], key: str) -> float:
    mean = numbers.get("metrics", {}).get(key, {}).get("mean")
    return math.nan if mean is None else float(mean)


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
