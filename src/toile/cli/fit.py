"""``toile fit scene=R1``: reconstruct the cloth of one video."""

from __future__ import annotations

import logging
import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning import Trainer
from lightning.pytorch.trainer.states import TrainerStatus
from omegaconf import DictConfig, OmegaConf

from toile.cli.configuration import instantiate, output_folder, resolved_yaml
from toile.cli.dashboard import write_final_numbers
from toile.cli.fit_results import (
    final_trajectory,
    residual_force,
    write_motion,
    write_numbers,
    write_pictures,
)
from toile.cli.resume import is_finished, last_checkpoint
from toile.cli.terminal import print_evaluation, print_path
from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, evaluate
from toile.fitting.effects import FitEffects
from toile.fitting.module import Cycles, FitModule
from toile.fitting.parameters import ClothParameters
from toile.fitting.quiet import quiet_lightning
from toile.fitting.reconstruction import Reconstruction
from toile.fitting.scene_cloth import scene_units
from toile.reports.run_folder import create_run_folder, read_metrics, write_config, write_git_revision
from toile.scenes.scene import Scene

log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> float | None:
    """Fit, evaluate, and fill the run folder; an interrupted fit leaves what it has and can be continued.

    Returns:
        Mean of the metric named by ``objective``, for the search for settings; None where there is none.
    """
    started = time.perf_counter()
    quiet_lightning()
    check_ablation_applies(cfg)
    folder = create_run_folder(output_folder())
    config = resolved_yaml(cfg)
    if is_finished(folder, config):
        print_path(folder.path, ": finished before with the same settings")
        return objective(cfg, EvaluationResult.from_dict(read_metrics(folder)))
    checkpoint = last_checkpoint(folder, config)
    write_config(folder, config)
    write_git_revision(folder)
    check_losses_are_used(cfg)
    scene: Scene = instantiate(cfg.scene)
    module = FitModule(build_reconstruction(cfg, scene), instantiate(cfg.optimization), cfg.seed)
    interrupted = optimise(cfg, module, checkpoint)
    trajectory = final_trajectory(module.reconstruction, module.recipe.substep_positions())
    write_motion(folder, module, trajectory)
    if interrupted:
        print_path(folder.path, f": stopped after {module.cycles_done} of {module.n_cycles} cycles")
        print_path(f"toile fit resume={folder.path}", " continues")
        raise KeyboardInterrupt
    evaluation = evaluate(
        trajectory,
        scene,
        module.reconstruction.renderer,
        seed=cfg.seed,
        out_of_balance=residual_force(module.reconstruction, trajectory),
    )
    write_numbers(folder, module, trajectory, evaluation, time.perf_counter() - started)
    write_final_numbers(cfg, folder, config)
    write_pictures(folder, module, trajectory, evaluation, cfg.report)
    print_evaluation(evaluation)
    print_path(folder.path)
    print_path(folder.page)
    return objective(cfg, evaluation)


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
        scene.n_frames, cloth.n_vertices, len(cloth.held), scene_units(scene, cfg.cloth.areal_density)
    )
    make_simulator = instantiate(cfg.simulator.build)
    return Reconstruction(
        scene,
        cloth,
        make_simulator,
        substeps_per_frame(cfg.simulator, scene.fps),
        parameters,
        instantiate(cfg.renderer),
        FitEffects(
            tuple((instantiate(cfg.get("effect")) or {}).values()), tuple(cfg.get("fixed_effects") or ())
        ),
    )


def substeps_per_frame(simulator: DictConfig, fps: float) -> int:
    """The number asked for, or as few as keep a sub-step within ``longest_substep``."""
    if simulator.substeps is not None:
        return int(simulator.substeps)
    # Rounding must not turn 0.02 s / 0.01 s into three sub-steps.
    return max(1, math.ceil(1 / fps / simulator.longest_substep - 1e-9))


def optimise(cfg: DictConfig, module: FitModule, checkpoint: Path | None) -> bool:
    """Run the cycles, from a checkpoint if there is one; returns whether it was interrupted."""
    callbacks = [c for c in instantiate(cfg.callbacks).values() if c is not None]
    logger: Any = instantiate(cfg.logger) if cfg.get("logger") else False
    trainer: Trainer = instantiate(cfg.trainer)(callbacks=callbacks, logger=logger)
    if checkpoint is not None:
        log.info("continuing from %s", checkpoint)
    on_interrupt = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, Cycles(module), ckpt_path=checkpoint, weights_only=True)
    except SystemExit:
        # Lightning turns Ctrl-C into this, and ignores Ctrl-C from then on.
        if trainer.state.status is not TrainerStatus.INTERRUPTED:
            raise
        signal.signal(signal.SIGINT, on_interrupt)
        module.roll_back()
        return True
    return False
