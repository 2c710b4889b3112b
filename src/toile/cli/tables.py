"""``toile tables SWEEP``: the cells of a sweep over ablations as CSV, Markdown and LaTeX."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, ListConfig

from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.reports.ablation_table import write_tables
from toile.reports.sweep import read_sweep

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
    output = folders[0] / TABLES if cfg.output is None else Path(cfg.output)
    for path in write_tables(sweep, list(cfg.metrics), list(cfg.rows), output, cfg.name, cfg.note or ""):
        print_path(path)
