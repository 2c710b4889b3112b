"""``toile evaluate run=<run folder>``: every metric that the scene's ground truth allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from toile.cli.configuration import instantiate
from toile.cli.run_scene import run_scene
from toile.cli.terminal import print_evaluation, print_path
from toile.evaluation.evaluate import EvaluationResult, evaluate
from toile.reports.run_folder import (
    RunFolder,
    open_run_folder,
    read_metrics,
    read_trajectory,
    write_metrics,
)

KEY = "out_of_balance"


def run(cfg: DictConfig) -> None:
    """Evaluate trajectory.npz, print the table, write metrics.json."""
    folder = open_run_folder(Path(cfg.run))
    result = evaluated(cfg, folder)
    print_evaluation(result)
    print_path(store(result, folder))


def evaluated(cfg: DictConfig, folder: RunFolder) -> EvaluationResult:
    """The metrics of a run, with what its fit alone could measure."""
    trajectory = torch.from_numpy(read_trajectory(folder).positions)
    result = evaluate(
        trajectory,
        run_scene(cfg, folder),
        instantiate(cfg.get("renderer")),
        seed=cfg.seed,
        n_frames=cfg.n_frames,
    )
    return with_out_of_balance(result, _before(folder))


def store(result: EvaluationResult, folder: RunFolder) -> Path:
    """Write metrics.json; what a fit has noted beside its metrics stays."""
    return write_metrics(folder, {**_before(folder), **result.to_dict()})


def _before(folder: RunFolder) -> dict[str, Any]:
    return read_metrics(folder) if folder.metrics.is_file() else {}


def with_out_of_balance(result: EvaluationResult, before: Mapping[str, Any]) -> EvaluationResult:
    """The result with the out-of-balance force that a fit has measured, for which this command lacks forces.

    Args:
        result: without it.
        before: metrics of the run as they are.
    """
    # In metrics alone in runs of older versions.
    parts = [part for part in (before.get("fit"), before.get("metrics")) if isinstance(part, dict)]
    stored = next((part[KEY] for part in parts if part.get(KEY) is not None), None)
    if KEY in result.metrics or stored is None:
        return result
    known = EvaluationResult.from_dict({**result.to_dict(), "metrics": {KEY: stored}}).metrics[KEY]
    n, measured = result.n_frames, len(known.per_frame)
    if measured < n:
        return result
    if measured > n:
        protocol = f"{known.protocol}; first {n} of {measured} frames only"
        known = replace(known, per_frame=known.per_frame[:n], protocol=protocol)
    skipped = {name: reason for name, reason in result.skipped.items() if name != KEY}
    return replace(result, metrics={**result.metrics, KEY: known}, skipped=skipped)
