"""``toile tables SWEEP``: the cells of a sweep over ablations as CSV, Markdown and LaTeX."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig, ListConfig

from toile.atomic_file import write_text
from toile.cli.run_scene import run_scene
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, evaluate
from toile.json_file import read_json_object
from toile.reports.ablation_table import write_tables
from toile.reports.run_folder import RunFolder, read_trajectory
from toile.reports.sweep import Run, read_sweep

log = logging.getLogger(__name__)

TABLES = "tables"
"""Folder of the tables beside the runs."""


def run(cfg: DictConfig) -> None:
    """Write the tables and print their paths.

    Raises:
        InputError: several folders and no ``output``, or see read_sweep and write_tables.
    """
    folders = [Path(f) for f in cfg.run] if isinstance(cfg.run, ListConfig) else [Path(str(cfg.run))]
    if cfg.output is None and len(folders) > 1:
        raise InputError(
            "Nothing says where the tables go",
            where="output",
            expected="output=<folder>, because several folders of runs are given",
            got="none",
        )
    sweep = read_sweep(folders)
    if cfg.seeds:
        sweep = replace(sweep, runs=tuple(measured_with(run, list(cfg.seeds), cfg) for run in sweep.runs))
    output = folders[0] / TABLES if cfg.output is None else Path(cfg.output)
    written = write_tables(
        sweep,
        list(cfg.metrics),
        list(cfg.rows),
        output,
        cfg.name,
        cfg.note or "",
        list(cfg.published),
    )
    for path in written:
        print_path(path)


def measured_with(run: Run, seeds: list[int], cfg: DictConfig) -> Run:
    """The run with its motion measured with these seeds too, but for the one it has been measured with.

    Metrics that need a renderer draw no samples and are left out. Results stay in the run's folder.
    """
    others = [seed for seed in dict.fromkeys(seeds) if seed != run.evaluation.seed]
    return replace(run, other_seeds=tuple(_with_seed(run.folder, seed, cfg) for seed in others))


def _with_seed(folder: RunFolder, seed: int, cfg: DictConfig) -> EvaluationResult:
    file = folder.metrics_of_seed(seed)
    if file.is_file() and file.stat().st_mtime_ns >= folder.trajectory.stat().st_mtime_ns:
        return EvaluationResult.from_dict(read_json_object(file))
    log.info("measuring %s with seed %d", folder.path, seed)
    motion = torch.from_numpy(read_trajectory(folder).positions)
    result = evaluate(motion, run_scene(cfg, folder), seed=seed)
    write_text(file, json.dumps(result.to_dict()))
    return result
