"""``toile diagnose scene=...``: where the gap lies, which effect is missing, how far it shrinks with it."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from toile.cli.alone import alone
from toile.cli.configuration import CONF, instantiate, output_folder, register_resolvers, resolved_yaml
from toile.cli.fit import build_reconstruction, check_losses_are_used
from toile.cli.made_with import made_with_of
from toile.cli.resume import check_settings_as_before
from toile.cli.scene_warnings import scene_warnings
from toile.cli.settings import check_settings
from toile.cli.terminal import print_path
from toile.diagnosis.diagnose import diagnose
from toile.diagnosis.made_with import MadeWith
from toile.diagnosis.planned_clip import STILL_AIR
from toile.diagnosis.problem import DiagnosisProblem, check_problem
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport
from toile.diagnosis.session_diagnosis import diagnose_session
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.shooting import ShootingSettings
from toile.effects.base import Effect
from toile.errors import InputError
from toile.reconstruction.gauss_newton.recipe import TrackingRecipe
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reports.diagnosis_arrays import DiagnosisArrays
from toile.reports.diagnosis_dashboard import write_diagnosis_dashboard
from toile.reports.diagnosis_wording import mark
from toile.reports.page.diagnosis_page import write_diagnosis_page
from toile.reports.run_folder import (
    RunFolder,
    create_run_folder,
    write_config,
    write_git_revision,
    write_overrides,
)
from toile.scenes.scene import Scene
from toile.scenes.session import Session, load_session
from toile.workers import Workers


@alone
def run(cfg: DictConfig) -> None:
    """Diagnose, write diagnosis.json, and say the verdict; an interrupted diagnosis can be continued."""
    folder = create_run_folder(output_folder())
    report = finished_before(cfg, folder)
    if report is not None:
        print_path(folder.path, ": finished before with the same settings")
        _say(folder, report)
        return
    with Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=Console(stderr=True)
    ) as bar:
        task = bar.add_task("loading", total=1.0)
        report = finished_diagnosis(
            cfg, folder, lambda what, share: bar.update(task, description=what, completed=share)
        )
    _say(folder, report)


def finished_before(cfg: DictConfig, folder: RunFolder) -> GapReport | None:
    """The answer of an earlier call; None where there is something left to do.

    Raises:
        InputError: the folder holds a diagnosis with other settings.
    """
    if folder.config.is_file():
        check_settings_as_before(folder, resolved_yaml(cfg))
    answer = folder.path / DIAGNOSIS_FILE
    # The page is the last thing a diagnosis writes.
    return GapReport.read(answer) if answer.is_file() and folder.page.is_file() else None


def finished_diagnosis(
    cfg: DictConfig, folder: RunFolder, progress: Callable[[str, float], None]
) -> GapReport:
    """Diagnose and fill the run folder; an interrupted diagnosis can be continued.

    Args:
        cfg: configuration of the command.
        folder: of the run.
        progress: told what is being done, and which share of all is done.

    Raises:
        InputError: the scene, or a setting, is of no use.
        KeyboardInterrupt: it was interrupted; how to continue has been printed.
    """
    problem = _problem(cfg)
    # What is refused leaves no settings behind that another try would have to agree with.
    write_config(folder, resolved_yaml(cfg))
    write_overrides(folder, HydraConfig.get().overrides.task)
    write_git_revision(folder)
    try:
        report = problem.diagnosed(folder.path, progress)
        progress("done", 1.0)
        arrays = DiagnosisArrays.read(folder.path, report)
        write_diagnosis_dashboard(folder.path / "tensorboard", report, arrays)
        write_diagnosis_page(folder.page, report, arrays, problem.scene, problem.name)
    except KeyboardInterrupt:
        print_path(shlex.join(("toile", "diagnose", f"resume={folder.path}")), " continues")
        raise
    return report


def _say(folder: RunFolder, report: GapReport) -> None:
    """The verdict, and where all of it is."""
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
    _diagnose_alone(("scene=native", f"scene.name='{scene_folder.resolve()}'"), output_folder, settings)


def diagnose_session_folder(session_folder: Path, output_folder: Path, settings: Any) -> None:
    """Diagnose one session, as diagnose_scene does one scene.

    Args:
        session_folder: with session.yaml.
        output_folder: diagnosis.json goes there.
        settings: None, or overrides of the configuration as ``key=value``.
    """
    _diagnose_alone((f"session='{session_folder.resolve()}'",), output_folder, settings)


def _diagnose_alone(recording: tuple[str, ...], output_folder: Path, settings: Any) -> None:
    register_resolvers()
    overrides = [*recording, "workers=1", *map(str, settings or [])]
    if GlobalHydra.instance().is_initialized():
        cfg = compose("diagnose", overrides)
    else:
        with initialize_config_dir(str(CONF), version_base=None):
            cfg = compose("diagnose", overrides)
    check_settings(cfg)
    output_folder.mkdir(parents=True, exist_ok=True)
    _problem(cfg).diagnosed(output_folder, lambda what, share: None)


def check_settings_are_used(cfg: DictConfig) -> None:
    """Refuse settings that a diagnosis would pass over.

    Raises:
        InputError: a fit's start values or effects, losses, another optimisation than one stage of tracking,
            or no workers.
    """
    elsewhere = {
        "parameters": "diagnosis.stiffness=[Y in N/m, S per cell area in N/m, B in N·m]",
        "effect": "candidates by effect@candidates=[...]; the motion is tracked with free forces alone",
        "fixed_effects": "candidates by effect@candidates=[...]; none is fixed",
    }
    for key, expected in elsewhere.items():
        if key in cfg:
            raise InputError(
                "A diagnosis has no such setting",
                where=key,
                expected=expected,
                got=f"{key}: {cfg[key]}"[:100],
            )
    target = str(cfg.optimization.get("_target_"))
    if target.rpartition(".")[2] != TrackingRecipe.__name__:
        raise InputError(
            "A diagnosis tracks the motion first",
            where="optimization",
            expected="optimization=track",
            got=target,
        )
    stages = [name for name, stage in cfg.optimization.stages.items() if stage is not None]
    if len(stages) != 1:
        raise InputError(
            "A diagnosis tracks the motion in one stage",
            where="optimization.stages",
            expected="one of them, as optimization=track has",
            got=", ".join(map(str, stages)) or "none",
        )
    check_losses_are_used(cfg)


@dataclass(frozen=True)
class _Problem:
    """What a configuration asks for, built and checked.

    Attributes:
        reconstruction, recipe, effects, settings: see toile.diagnosis.diagnose.diagnose.
        workers: processes.
        made_with: settings that the evidence depends on.
        warnings: what is remarkable about the scene.
    """

    reconstruction: Reconstruction
    recipe: TrackingRecipe
    effects: tuple[Effect, ...]
    settings: DiagnosisSettings
    workers: int
    made_with: MadeWith
    warnings: tuple[str, ...]

    @property
    def scene(self) -> Scene:
        """For the page."""
        return self.reconstruction.scene

    @property
    def name(self) -> str:
        """For the page."""
        return self.scene.name

    def diagnosed(self, folder: Path, progress: Callable[[str, float], None]) -> GapReport:
        """The answer, in ``diagnosis.json`` as well."""
        with Workers(self.workers) as workers:
            report = diagnose(
                self.reconstruction,
                self.recipe,
                self.effects,
                self.settings,
                folder,
                progress,
                workers,
                self.made_with,
            )
        report = replace(report, warnings=self.warnings)
        report.write(folder / DIAGNOSIS_FILE)
        return report


@dataclass(frozen=True)
class SessionProblem:
    """What a configuration asks for of a session, built and checked.

    Attributes:
        clips: one problem each.
        session: see Session.
        together: settings of all clips.
        workers: processes.
    """

    clips: tuple[_Problem, ...]
    session: Session
    together: SessionSettings
    workers: int

    @property
    def scene(self) -> None:
        """No single one is shown."""
        return None

    @property
    def name(self) -> str:
        """For the page."""
        return self.session.name

    def diagnosed(self, folder: Path, progress: Callable[[str, float], None]) -> GapReport:
        """The answer, in ``diagnosis.json`` as well."""
        first = self.clips[0]
        problems = [DiagnosisProblem(p.reconstruction, p.recipe, p.effects, p.settings) for p in self.clips]
        with Workers(self.workers) as workers:
            report = diagnose_session(
                problems,
                self.session,
                first.effects,
                first.settings,
                self.together,
                folder,
                progress,
                workers,
            )
        warnings = dict.fromkeys(warning for clip in self.clips for warning in clip.warnings)
        report = replace(report, warnings=(*warnings, *report.warnings))
        report.write(folder / DIAGNOSIS_FILE)
        return report


_SAME_CLOTH = 0.02
"""Share by which sides of one cloth, measured twice, may differ."""


def _size(scene: Scene) -> str:
    return " x ".join(f"{side:.3f}" for side in scene.cloth_size) + " m"


_OF_SESSION = ("window", "boundary_knot", "boundary", "likelihood_weight", "jump_position", "jump_velocity")
"""Settings of a clip's windows that a session has its own of."""
_OF_ONE_CLIP = (
    "refinement",
    "usual_discrepancy",
    "usual_cost",
    "refitted",
    "base_refits",
    "weights",
    "compared",
    "placebos",
    "refits",
    "prediction",
    "shooting.modes",
    "shooting.force_knot",
)
"""Settings of a diagnosis that have no say in that of a session."""


def session_problem(cfg: DictConfig) -> SessionProblem:
    """What a configuration with ``session`` asks for.

    Raises:
        InputError: the session, a scene or a setting is of no use.
    """
    # The command line calls run folders after the session, see name_sessions.
    own = str(Path(str(cfg.session)).expanduser().resolve())
    if not OmegaConf.is_missing(cfg.scene, "name") and str(cfg.scene.name) not in (own, str(cfg.session)):
        raise InputError(
            "Either a scene or a session is diagnosed",
            where="command line",
            expected="scene=<name or folder> or session=<folder>",
            got=f"scene={cfg.scene.name} and session={cfg.session}",
        )
    if cfg.diagnosis.held_out not in (0, DiagnosisSettings().held_out):
        raise InputError(
            "A session holds out a whole clip, no share of the frames",
            where="diagnosis.held_out",
            expected="no value, or 0",
            got=str(cfg.diagnosis.held_out),
        )
    usual = ShootingSettings()
    for name in _OF_SESSION:
        if cfg.diagnosis.shooting[name] != getattr(usual, name):
            raise InputError(
                "The windows of a session have settings of their own",
                where=f"diagnosis.shooting.{name}",
                expected=f"session_model.{name}",
                got=str(cfg.diagnosis.shooting[name]),
            )
    _check_of_one_clip(cfg.diagnosis)
    session = load_session(str(cfg.session))
    clips = []
    for clip in session.clips:
        of_clip = cfg.copy()
        OmegaConf.update(of_clip, "scene.name", str(clip.folder.resolve()))
        # What is held out is a whole clip; every frame of the others is fitted.
        OmegaConf.update(of_clip, "diagnosis.held_out", 0.0)
        clips.append(_clip_problem(of_clip))
    grids = {clip.reconstruction.scene.grid for clip in clips}
    if len(grids) > 1:
        raise InputError(
            "The clips of a session are of one cloth, on one grid",
            where=str(cfg.session),
            expected="templates of the same grid",
            got=", ".join(map(str, sorted(grids))),
        )
    scenes = [clip.reconstruction.scene for clip in clips]
    for name, scene in zip(session.clip_names, scenes, strict=True):
        if not np.allclose(scene.cloth_size, scenes[0].cloth_size, rtol=_SAME_CLOTH):
            raise InputError(
                "The clips of a session are of one cloth",
                where=f"{cfg.session}: {name}",
                expected=f"a cloth of {_size(scenes[0])}, as in {session.clip_names[0]}",
                got=_size(scene),
            )
    longest = max((scene.n_frames - 1) / scene.fps for scene in scenes)
    effects = tuple(effect.for_clip(longest).in_detail() for effect in clips[0].effects)
    if any(clip.motion in STILL_AIR for clip in session.clips):
        effects = tuple(effect.in_still_air() for effect in effects)
    clips = [replace(clip, effects=effects) for clip in clips]
    return SessionProblem(tuple(clips), session, instantiate(cfg.session_model), int(cfg.workers))


def _check_of_one_clip(diagnosis: DictConfig) -> None:
    """Refuse what was set for the fits of one clip, but for what diagnosis=quick sets of it."""
    default, quick = (OmegaConf.load(CONF / "diagnosis" / f"{name}.yaml") for name in ("default", "quick"))
    for name in _OF_ONE_CLIP:
        got = OmegaConf.select(diagnosis, name)
        if all(
            got != OmegaConf.select(preset, name) for preset in (default, OmegaConf.merge(default, quick))
        ):
            raise InputError(
                "The fits of a session have settings of their own",
                where=f"diagnosis.{name}",
                expected="none: what a session goes by is in session_model",
                got=str(got),
            )


def _problem(cfg: DictConfig) -> _Problem | SessionProblem:
    return _clip_problem(cfg) if cfg.session is None else session_problem(cfg)


def _clip_problem(cfg: DictConfig) -> _Problem:
    check_settings_are_used(cfg)
    scene: Scene = instantiate(cfg.scene)
    warnings = scene_warnings(scene, force=cfg.force)
    recipe = instantiate(cfg.optimization)
    # candidates.<name>=null takes one out.
    effects = tuple(e for e in (instantiate(cfg.get("candidates")) or {}).values() if e is not None)
    settings = instantiate(cfg.diagnosis)
    # The stiffness is that of the settings, in SI units: the diagnosis puts it in.
    make_parameters = partial(ClothParameters, stretching=1.0, shearing=1.0, bending=1.0)
    reconstruction = build_reconstruction(cfg, scene, make_parameters)
    check_problem(reconstruction, effects, settings)
    return _Problem(
        reconstruction, recipe, effects, settings, int(cfg.workers), made_with_of(cfg), tuple(warnings)
    )
