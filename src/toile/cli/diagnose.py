"""``toile diagnose scene=...``: where the gap lies, which effect is missing, how far it shrinks with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from toile.cli.alone import alone
from toile.cli.configuration import CONF, instantiate, output_folder, register_resolvers, resolved_yaml
from toile.cli.fit import build_reconstruction
from toile.cli.made_with import made_with_of
from toile.cli.terminal import print_path
from toile.diagnosis.diagnose import diagnose
from toile.diagnosis.workers import Workers
from toile.errors import InputError
from toile.evaluation.diagnosis_record import DIAGNOSIS_FILE, GapReport
from toile.fitting.gauss_newton.recipe import TrackingRecipe
from toile.reports.diagnosis_arrays import DiagnosisArrays
from toile.reports.diagnosis_dashboard import write_diagnosis_dashboard
from toile.reports.diagnosis_wording import mark
from toile.reports.page.diagnosis_page import write_diagnosis_page
from toile.reports.run_folder import create_run_folder, write_config, write_git_revision
from toile.scenes.scene import Scene


@alone
def run(cfg: DictConfig) -> None:
    """Diagnose, write diagnosis.json, and say the verdict; an interrupted diagnosis keeps its tracking."""
    folder = create_run_folder(output_folder())
    write_config(folder, resolved_yaml(cfg))
    write_git_revision(folder)
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=Console(stderr=True)
    ) as bar:
        task = bar.add_task("loading", total=1.0)
        scene, report = _diagnose(
            cfg, folder.path, lambda what, share: bar.update(task, description=what, completed=share)
        )
        bar.update(task, description="done", completed=1.0)
    arrays = DiagnosisArrays.read(folder.path, report)
    write_diagnosis_page(folder.page, report, arrays, scene)
    write_diagnosis_dashboard(folder.path / "tensorboard", report, arrays)
    verdict = report.verdict
    name = verdict.effect if verdict.also is None else f"{verdict.effect} and {verdict.also}"
    print_path(f"{name} (probability {verdict.probability:.2f}{mark(report)}): {verdict.reason}")
    if verdict.next_recording:
        print_path(f"next recording: {verdict.next_recording}")
    print_path(folder.path / DIAGNOSIS_FILE)
    print_path(folder.page)


def diagnose_scene(scene_folder: Path, output_folder: Path, settings: Any) -> None:
    """Diagnose one scene without a command line, as a blind run does: in this process alone.

    Processes that it started would know nothing of what this one is forbidden to read.

    Args:
        scene_folder: native layout.
        output_folder: diagnosis.json goes there.
        settings: None, or overrides of the configuration as ``key=value``.
    """
    register_resolvers()
    scene = ("scene=native", f"scene.name='{scene_folder.resolve()}'", "workers=1")
    overrides = [*scene, *map(str, settings or [])]
    if GlobalHydra.instance().is_initialized():
        cfg = compose("diagnose", overrides)
    else:
        with initialize_config_dir(str(CONF), version_base=None):
            cfg = compose("diagnose", overrides)
    output_folder.mkdir(parents=True, exist_ok=True)
    _diagnose(cfg, output_folder, lambda what, share: None)


def _diagnose(cfg: DictConfig, folder: Path, progress: Any) -> tuple[Scene, GapReport]:
    target = str(cfg.optimization.get("_target_"))
    if target.rpartition(".")[2] != TrackingRecipe.__name__:
        raise InputError(
            "A diagnosis tracks the motion first",
            where="optimization",
            expected="optimization=tracking",
            got=target,
        )
    scene: Scene = instantiate(cfg.scene)
    recipe = instantiate(cfg.optimization)
    effects = list(instantiate(cfg.candidates).values())
    settings = instantiate(cfg.diagnosis)
    if int(cfg.workers) == 0:
        raise InputError(
            "Nobody would work",
            where="workers",
            expected="a number of processes; -1 for one per core",
            got="0",
        )
    with Workers(int(cfg.workers)) as workers:
        report = diagnose(
            build_reconstruction(cfg, scene),
            recipe,
            effects,
            settings,
            folder,
            progress,
            workers,
            made_with_of(cfg),
        )
    report.write(folder / DIAGNOSIS_FILE)
    return scene, report
