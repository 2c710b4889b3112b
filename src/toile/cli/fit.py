"""``toile fit scene=R1``: reconstruct the cloth of one video."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from typing import NamedTuple

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from toile.cli.alone import alone
from toile.cli.configuration import instantiate, output_folder, resolved_yaml
from toile.cli.dashboard import write_final_numbers
from toile.cli.fit_results import (
    Seconds,
    last_picture,
    write_motion,
    write_numbers,
    write_pictures,
)
from toile.cli.fit_tries import Fitted, fit_with_guard
from toile.cli.resume import is_finished, last_checkpoint
from toile.cli.scene_warnings import scene_warnings
from toile.cli.terminal import print_evaluation, print_path
from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, evaluate
from toile.learning.quiet import quiet_lightning
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.fitted_motion import residual_force
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import scene_units
from toile.reconstruction.scene_steps import scene_frame_steps
from toile.reports.run_folder import (
    RunFolder,
    create_run_folder,
    read_metrics,
    write_config,
    write_git_revision,
    write_overrides,
)
from toile.scenes.scene import Scene

log = logging.getLogger(__name__)


class FinishedFit(NamedTuple):
    """A run folder with everything in it.

    Attributes:
        folder: of the run.
        evaluation: of its trajectory.
        before: whether an earlier call with the same settings had finished it.
    """

    folder: RunFolder
    evaluation: EvaluationResult
    before: bool


@alone
def run(cfg: DictConfig) -> float | None:
    """Fit, and print what came of it.

    Returns:
        Mean of the metric named by ``objective``, for the search for settings; None where there is none.
    """
    folder, evaluation, before = finished_fit(cfg)
    if before:
        print_path(folder.path, ": finished before with the same settings")
    else:
        print_evaluation(evaluation)
        print_path(folder.path)
        if cfg.report.page:
            print_path(folder.page)
    return objective(cfg, evaluation)


def finished_fit(cfg: DictConfig) -> FinishedFit:
    """Fit, evaluate, and fill the run folder; an interrupted fit leaves what it has and can be continued.

    Raises:
        InputError: the scene, or a setting, is of no use.
        KeyboardInterrupt: it was interrupted; how to continue has been printed.
    """
    started = time.perf_counter()
    quiet_lightning()
    check_ablation_applies(cfg)
    folder = create_run_folder(output_folder())
    config = resolved_yaml(cfg)
    if is_finished(folder, config, last_picture(folder, cfg.report) or folder.metrics):
        return FinishedFit(folder, EvaluationResult.from_dict(read_metrics(folder)), before=True)
    checkpoint = last_checkpoint(folder, config)
    check_losses_are_used(cfg)
    write_config(folder, config)
    if checkpoint is None or not folder.overrides.is_file():
        # What the run was started with; what a later call adds may yet turn out to be wrong.
        write_overrides(folder, HydraConfig.get().overrides.task)
    write_git_revision(folder)
    scene: Scene = instantiate(cfg.scene)
    warnings = scene_warnings(scene, force=cfg.force)
    fitted = fit_with_guard(cfg, scene, folder, checkpoint, build_reconstruction)
    module, trajectory = fitted.module, fitted.trajectory
    if trajectory is None:
        print_path(folder.path, ": stopped before the first cycle was done; there is nothing to continue")
        raise KeyboardInterrupt
    write_motion(folder, module, trajectory)
    if fitted.interrupted:
        print_path(folder.path, f": {fitted.interrupted} stopped{_progress_of(fitted)}")
        print_path(f"toile fit resume={folder.path}", " continues")
        raise KeyboardInterrupt
    warnings = [*warnings, *fitted.warnings]
    log.info("evaluating")
    evaluation = evaluate(
        trajectory,
        scene,
        module.reconstruction.renderer,
        seed=cfg.seed,
        out_of_balance=residual_force(module.reconstruction, trajectory),
    )
    seconds = Seconds(fitted.seconds, time.perf_counter() - started, fitted.processor_seconds)
    write_numbers(folder, module, trajectory, evaluation, seconds, warnings)
    write_final_numbers(cfg, folder, config)
    if last_picture(folder, cfg.report):
        log.info("writing pictures")
    write_pictures(folder, module, trajectory, evaluation, cfg.report)
    return FinishedFit(folder, evaluation, before=False)


def _progress_of(fitted: Fitted) -> str:
    module = fitted.module
    return f" after {module.cycles_done} of {module.n_cycles} cycles" if fitted.interrupted == "fit" else ""


def objective(cfg: DictConfig, evaluation: EvaluationResult) -> float | None:
    """The mean of the metric that the configuration names, turned so that less is better.

    Raises:
        InputError: it was not measured.
    """
    if cfg.objective is None:
        return None
    metric = evaluation.metrics.get(cfg.objective)
    if metric is None or math.isnan(metric.mean):
        measured = [key for key, m in evaluation.metrics.items() if not math.isnan(m.mean)]
        raise InputError(
            "The objective was not measured",
            where="objective",
            expected=", ".join(measured) or "a scene with ground truth",
            got=str(cfg.objective),
        )
    return -metric.mean if metric.higher_is_better else metric.mean


def check_ablation_applies(cfg: DictConfig) -> None:
    """Refuse an ablation that means nothing for the optimisation.

    Raises:
        InputError: there is no conf/ablation_of/<optimization>/<ablation>.yaml and the ablation needs one.
    """
    if OmegaConf.is_missing(cfg, "ablation"):
        choices = HydraConfig.get().runtime.choices
        raise InputError(
            "The optimisation does not know this ablation",
            where=f"ablation={choices['ablation']}",
            expected=f"conf/ablation_of/{choices['optimization']}/{choices['ablation']}.yaml",
            got="no such file",
        )


def check_losses_are_used(cfg: DictConfig) -> None:
    """Refuse terms that the optimisation would ignore.

    Raises:
        InputError: there are terms in ``loss`` but the optimisation brings its own.
    """
    terms = [name for name, term in (cfg.get("loss") or {}).items() if term is not None]
    if terms and "losses" not in cfg.optimization:
        raise InputError(
            "The optimisation has terms of its own",
            where="loss",
            expected="loss=none, or an optimisation that takes them, as optimization=adam does",
            got=", ".join(map(str, terms)),
        )


def build_reconstruction(
    cfg: DictConfig, scene: Scene, make_parameters: Callable[..., ClothParameters] | None = None
) -> Reconstruction:
    """The problem that the configuration describes for a scene; None takes its ``parameters``."""
    cloth = instantiate(cfg.cloth)(scene)
    parameters = (make_parameters or instantiate(cfg.parameters))(
        scene.n_frames,
        cloth.n_vertices,
        len(cloth.pinned),
        scene_units(scene, cfg.cloth.areal_density),
        of_cloth=cloth.energies.parameters,
    )
    make_simulator = instantiate(cfg.simulator.build)
    return Reconstruction(
        scene,
        cloth,
        make_simulator,
        scene_frame_steps(
            scene,
            cfg.simulator.substeps,
            cfg.simulator.longest_substep,
            cfg.simulator.largest_time_error,
        ),
        parameters,
        instantiate(cfg.renderer),
        FitEffects(
            tuple((instantiate(cfg.get("effect")) or {}).values()), tuple(cfg.get("fixed_effects") or ())
        ),
    )
