"""``toile report run=<run folder>``: the result page of a run."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from toile.cli.configuration import instantiate
from toile.cli.run_scene import run_scene
from toile.cli.terminal import print_path
from toile.reports.page.run_page import write_result_page
from toile.reports.run_folder import open_run_folder, read_trajectory
from toile.reports.run_report import result_page


def run(cfg: DictConfig) -> None:
    """Write index.html into the run folder and print its path."""
    folder = open_run_folder(Path(cfg.run))
    scene = run_scene(cfg, folder, read_trajectory(folder))
    page = result_page(folder, scene, instantiate(cfg.renderer), cfg.pictures)
    print_path(write_result_page(page, folder.page))
