"""``toile evaluate run=<run folder>``: every metric that the scene's ground truth allows."""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig

from toile.cli.configuration import instantiate
from toile.cli.run_scene import run_scene
from toile.cli.terminal import print_evaluation, print_path
from toile.evaluation.evaluate import evaluate
from toile.reports.run_folder import open_run_folder, read_metrics, read_trajectory, write_metrics


def run(cfg: DictConfig) -> None:
    """Evaluate trajectory.npz, print the table, write metrics.json."""
    folder = open_run_folder(Path(cfg.run))
    trajectory = torch.from_numpy(read_trajectory(folder).positions)
    result = evaluate(
        trajectory,
        run_scene(cfg, folder),
        instantiate(cfg.get("renderer")),
        seed=cfg.seed,
        n_frames=cfg.n_frames,
    )
    print_evaluation(result)
    # What a fit has noted beside its metrics stays.
    before = read_metrics(folder) if folder.metrics.is_file() else {}
    print_path(write_metrics(folder, {**before, **result.to_dict()}))
