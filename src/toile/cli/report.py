"""``toile report RUN...``: the page of a run, or of several side by side."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, ListConfig

from toile.cli.configuration import instantiate
from toile.cli.run_scene import run_scene
from toile.cli.terminal import print_path
from toile.reports.page.run_page import write_result_page
from toile.reports.page.sweep_page import SweepPage, write_sweep_page
from toile.reports.run_folder import RunFolder, open_run_folder, read_trajectory
from toile.reports.run_report import result_page
from toile.reports.sweep import read_sweep

SWEEP_PAGE = "report.html"


def run(cfg: DictConfig) -> None:
    """Write the page and print its path."""
    folders = [Path(f) for f in cfg.run] if isinstance(cfg.run, ListConfig) else [Path(str(cfg.run))]
    output = None if cfg.output is None else Path(cfg.output)
    if len(folders) == 1 and not _holds_runs(folders[0]):
        print_path(written_page(cfg, open_run_folder(folders[0]), output))
    else:
        sweep = read_sweep(folders)
        print_path(write_sweep_page(SweepPage(sweep, output or folders_page(folders, sweep.folder))))


def folders_page(folders: list[Path], common: Path) -> Path:
    """Where the page of several runs goes: into the folder given, or the one they have in common."""
    return (folders[0] if len(folders) == 1 else common) / SWEEP_PAGE


def _holds_runs(folder: Path) -> bool:
    """Whether a folder is none of a run itself but may hold some."""
    run = RunFolder(folder)
    if not folder.is_dir() or run.trajectory.is_file() or run.config.is_file():
        return False
    return any(path.is_dir() for path in folder.iterdir())


def written_page(cfg: DictConfig, folder: RunFolder, output: Path | None) -> Path:
    """Write the page of one run, into its folder if no other file is named."""
    scene = run_scene(cfg, folder, read_trajectory(folder))
    page = result_page(folder, scene, instantiate(cfg.renderer), cfg.pictures)
    return write_result_page(page, output or folder.page)
