"""``toile tables SWEEP``: the cells of a sweep over ablations as CSV, Markdown and LaTeX."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, ListConfig

from toile.cli.terminal import print_path
from toile.reports.ablation_table import write_tables
from toile.reports.sweep import read_sweep


def run(cfg: DictConfig) -> None:
    """Write the tables and print their paths."""
    folders = [Path(f) for f in cfg.run] if isinstance(cfg.run, ListConfig) else [Path(str(cfg.run))]
    sweep = read_sweep(folders)
    for path in write_tables(
        sweep, list(cfg.metrics), list(cfg.rows), Path(cfg.output), cfg.name, cfg.note or ""
    ):
        print_path(path)
