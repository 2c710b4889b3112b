"""toile from Python: scenes, simulations, pictures, fits, evaluations and diagnoses.

A thin layer over the commands: the same configurations, the same checks, the same numbers, the same run
folders. ``toile.fit("R1", {"seed": 1})`` is ``toile fit scene=R1 seed=1``, and each can go on with what the
other has begun.

Wherever ``settings`` are taken, they are those of the command, in one of two forms::

    {"optimization": "identification", "parameters": {"shearing": 8}, "optimization.stages.polish": None}
    ["optimization=identification", "parameters.shearing=8", "optimization.stages.polish=null"]

``toile <command> --help`` lists them. What a command would refuse raises ``toile.errors.InputError``, which
says what is wrong, where, what was expected and what was got.

Positions are in metres in the camera frame of the scene (OpenCV: x right, y down, z forward), grids have
shape (H, W), row i and column j, and F counts frames.
"""

from __future__ import annotations

import filecmp
import logging
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from toile.cli.alone import alone_in
from toile.cli.configuration import instantiate, output_folder
from toile.cli.diagnose import finished_before, finished_diagnosis
from toile.cli.evaluate import evaluated, store
from toile.cli.fit import build_reconstruction, finished_fit
from toile.cli.from_python import (
    Settings,
    called,
    effect_overrides,
    names_in,
    overrides,
    scene_overrides,
    setting_name,
)
from toile.cli.generate import written_scene
from toile.cli.report import written_page
from toile.cli.run_scene import TEXTURE_OFFSET, run_scene
from toile.diagnosis.record import GapReport
from toile.effects.base import Effect
from toile.effects.catalogue import also_known
from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult
from toile.evaluation.evaluate import evaluate as _evaluate
from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces
from toile.physics.cloth import GRID_PARAMETERS
from toile.physics.units import NetworkUnits
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.scene_cloth import scene_units
from toile.reports.run_folder import (
    RunFolder,
    create_run_folder,
    open_run_folder,
    read_history,
    read_metrics,
    read_trajectory,
)
from toile.reports.run_report import SCENE_WARNINGS
from toile.scenes.native import write_native
from toile.scenes.scene import GroundTruth, Scene
from toile.scenes.texture_coordinates import project_coordinates

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Diagnosis",
    "Motion",
    "Pictures",
    "Run",
    "Settings",
    "diagnose",
    "evaluate",
    "fit",
    "generate",
    "load_run",
    "load_scene",
    "render",
    "simulate",
]

log = logging.getLogger(__name__)

Array = npt.NDArray[Any]

NETWORK_UNITS = "network units"

# How scenes were loaded, so that a run says where its scene is; for as long as the scene is in use.
_LOADED: WeakKeyDictionary[Scene, list[str]] = WeakKeyDictionary()


@dataclass(frozen=True, repr=False)
class Motion:
    """A simulated motion.

    Attributes:
        positions: (F, H, W, 3) [m], camera frame, float64.
        times: of the frames (F,) [s], the first 0.
        stiffness: by name, in SI units: stretching [N/m], shearing [N·m], bending [N·m].
        network_stiffness: the same in the paper's network units (Stotko et al., CVPR 2024, section 3.1.3).
    """

    positions: Array
    times: Array
    stiffness: Mapping[str, float]
    network_stiffness: Mapping[str, float]

    def __repr__(self) -> str:
        return f"Motion of {_size(self.positions)}, {self.times[-1]:.3g} s"


@dataclass(frozen=True, repr=False)
class Pictures:
    """What a camera sees of a motion.

    Attributes:
        rgb: colours (F, h, w, 3) in [0, 1], float32, black where there is no cloth.
        silhouettes: coverage (F, h, w) in [0, 1].
        depth: (F, h, w) [m], 0 where there is no cloth.
        positions: what was drawn, (F, H, W, 3) [m].
        scene: whose texture, and as a rule camera, were used.
    """

    rgb: Array
    silhouettes: Array
    depth: Array
    positions: Array
    scene: Scene = field(repr=False)

    def __repr__(self) -> str:
        frames, height, width = self.silhouettes.shape
        return f"Pictures of {self.scene.name}: {frames} frames of {height} × {width} px"

    def as_scene(self, name: str) -> Scene:
        """A scene that was filmed with this motion, whose true positions are known.

        Args:
            name: of the new scene, as a folder may be called.

        Returns:
            The scene with these pictures, silhouettes of more than one half as masks, frame 0 as template and
            texture; everything else is that of ``scene``. It is in memory only; a fit or a diagnosis writes
            it into its run folder.
        """
        positions = torch.from_numpy(self.positions)
        frames = torch.from_numpy(self.rgb)
        return replace(
            self.scene,
            name=name,
            frames=frames,
            masks=(torch.from_numpy(self.silhouettes) > 0.5).float(),
            texture=frames[0],
            texture_coordinates=project_coordinates(positions[0], self.scene.camera),
            template=positions[0],
            ground_truth=GroundTruth(vertices=positions),
            times=None if self.scene.times is None else self.scene.times[: len(positions)],
            source=None,
            notes=(),
        )


@dataclass(frozen=True, repr=False)
class Run:
    """A finished, or interrupted, fit.

    Attributes:
        folder: of the run.
        positions: reconstructed (F, H, W, 3) [m], camera frame, float64.
        times: of the frames (F,) [s], the first 0.
        parameters: everything that was fitted, by name and unit, e.g. "wind [m/s²]" (3,),
            "turbulence [m/s²]" (F-1, H, W, 3), "air_drag normal [1/s]" ().
        evaluation: metrics with their protocols; None where the fit was interrupted.
        warnings: what is remarkable about the scene or the fit, one sentence each.
    """

    folder: Path
    positions: Array
    times: Array
    parameters: Mapping[str, Array]
    evaluation: EvaluationResult | None
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        lines = [f"Run of {_size(self.positions)} in {self.folder}"]
        if self.evaluation is not None:
            metrics = self.evaluation.metrics.values()
            lines += [f"  {m.title}: {m.mean:.4g} {m.unit}".rstrip() for m in metrics]
        return "\n".join([*lines, *(f"  {warning}" for warning in self.warnings)])

    @property
    def stiffness(self) -> dict[str, float]:
        """Fitted stiffnesses by name, in SI units: stretching [N/m], shearing [N·m], bending [N·m]."""
        names = self.network_stiffness
        parts = ((key.partition(" [")[0], key, value) for key, value in self.parameters.items())
        return {name: float(v) for name, key, v in parts if name in names and NETWORK_UNITS not in key}

    @property
    def network_stiffness(self) -> dict[str, float]:
        """The same in the paper's network units (Stotko et al., CVPR 2024, section 3.1.3)."""
        end = f" [{NETWORK_UNITS}]"
        return {k.removesuffix(end): float(v) for k, v in self.parameters.items() if k.endswith(end)}

    @property
    def metrics(self) -> dict[str, float]:
        """Mean of every metric by its key, e.g. "chamfer"; ``evaluation`` has units, frames and protocols."""
        return {key: m.mean for key, m in self.evaluation.metrics.items()} if self.evaluation else {}

    @property
    def history(self) -> pd.DataFrame:
        """One row per cycle of the optimisation: cost, stiffnesses, wind, effects.

        Raises:
            InputError: the run has no history.csv.
        """
        return read_history(RunFolder(self.folder))

    def scene(self, *, data: str | Path | None = None) -> Scene:
        """The scene of the run, with the texture coordinates that the run has fitted.

        Args:
            data: data folder; None for TOILE_DATA, else ``./data``.

        Raises:
            InputError: the scene is no longer where it was.
        """
        with called("evaluate", [*_run_override(self.folder), *_data_override(data)]) as cfg:
            run = RunFolder(self.folder)
            return run_scene(cfg, run, read_trajectory(run))

    def page(self, *, show: bool = False) -> Path:
        """The result page, one file without network; written anew if the run has none.

        Args:
            show: open it in the browser.

        Raises:
            InputError: it has to be written, and the scene of the run is not found.
        """
        page = RunFolder(self.folder).page
        if not page.is_file():
            with called("report", _run_override(self.folder)) as cfg:
                written_page(cfg, RunFolder(self.folder), None)
        if show:
            webbrowser.open(page.absolute().as_uri())
        return page


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """Why a simulation differs from its video.

    Attributes:
        folder: of the run.
        report: all of ``diagnosis.json``.
    """

    folder: Path
    report: GapReport

    def __repr__(self) -> str:
        verdict = self.report.verdict
        lines = [f"{verdict.effect} (probability {verdict.probability:.2f}): {verdict.reason}"]
        if not self.calibrated:
            lines.append("Not calibrated for these settings: probabilities rank the candidates and no more.")
        lines += [f"Next recording: {verdict.next_recording}"] if verdict.next_recording else []
        return "\n".join([*lines, *self.report.warnings, str(self.folder)])

    @property
    def effect(self) -> str:
        """The answer: an effect of the catalogue, "none", "ambiguous" or "unknown"."""
        return self.report.verdict.effect

    @property
    def candidates(self) -> tuple[str, ...]:
        """The most probable hypotheses that together hold 90 %, most probable first."""
        return self.report.verdict.candidates

    @property
    def calibrated(self) -> bool:
        """Whether probabilities are calibrated for the settings that were used."""
        return self.report.calibration is not None and self.report.calibration.calibrated

    def table(self) -> pd.DataFrame:
        """One row per candidate: stage, probability, first parameter with its interval and unit."""
        import pandas as pd

        rows = []
        for effect in sorted(self.report.effects, key=lambda e: -e.probability):
            for name, number in list(effect.parameters.items())[:1]:
                values = (name, number.estimate, number.low, number.high, number.unit)
                rows.append((effect.name, effect.stage, effect.probability, *values))
        columns = ["effect", "stage", "probability", "parameter", "estimate", "low", "high", "unit"]
        return pd.DataFrame(rows, columns=columns).set_index("effect")

    def page(self, *, show: bool = False) -> Path:
        """The page of the diagnosis, one file without network.

        Args:
            show: open it in the browser.
        """
        page = RunFolder(self.folder).page
        if show:
            webbrowser.open(page.absolute().as_uri())
        return page


def load_scene(
    name: str | Path,
    *,
    data: str | Path | None = None,
    n_frames: int | None = None,
    fps: float | None = None,
    gravity: Sequence[float] | None = None,
    pinned_vertices: Sequence[int] | None = None,
    settings: Settings = None,
) -> Scene:
    """Load a recorded or generated scene, with the defaults of ``toile fit`` (conf/scene).

    Args:
        name: of a scene in the data folder ("R1"), or the path of a folder in the native layout.
        data: data folder; None for the environment variable TOILE_DATA, else ``./data``.
        n_frames: load only the first ones; None for all.
        fps: frames per second; None for what the data says.
        gravity: (x, y, z) [m/s²], camera frame; None for what the data says.
        pinned_vertices: flattened grid indices i * W + j; None for what the data says.
        settings: further ones of the scene, e.g. ``{"scene.crop_margin": None}``.

    Returns:
        The scene: frames (F, h, w, 3) and masks (F, h, w) in [0, 1], template (H, W, 3) [m], camera [px],
        ground truth where there is any.

    Raises:
        InputError: there is no such scene, or something in it is wrong.
    """
    given = {"n_frames": n_frames, "fps": fps, "gravity": gravity, "pinned_vertices": pinned_vertices}
    named = {f"scene.{key}": value for key, value in given.items() if value is not None}
    lines = [*scene_overrides(name), *_data_override(data), *overrides(named), *overrides(settings)]
    with called("fit", lines) as cfg:
        scene: Scene = instantiate(cfg.scene)
    _LOADED[scene] = lines
    return scene


def generate(folder: str | Path, settings: Settings = None, *, overwrite: bool = False) -> Scene:
    """Make a synthetic scene with known truth, as ``toile generate`` does.

    A sheet hangs from two corners in the wind; it is simulated on a finer grid and with shorter steps than a
    fit uses, and drawn from there.

    Args:
        folder: that the scene is written to, in the native layout; its name is the scene's.
        settings: of ``toile generate``, e.g. ``{"preset": "demo", "settings": {"n_frames": 12}}``.
        overwrite: replace a folder that exists.

    Returns:
        The scene, read back from the folder.

    Raises:
        InputError: a setting is of no use, or the folder exists.
        SimulationError: the motion cannot be simulated.
    """
    place = Path(folder)
    own = {"folder": place, "overwrite": overwrite, "settings.name": place.absolute().name}
    lines = _without(overrides(settings), tuple(own), "generate")
    with called("generate", [*lines, *overrides(own)]) as cfg:
        written_scene(cfg)
    return load_scene(place)


def simulate(
    scene: Scene | str | Path,
    stiffness: Mapping[str, float] | None = None,
    *,
    wind: Sequence[float] = (0.0, 0.0, 0.0),
    turbulence: npt.ArrayLike | None = None,
    boundary_motion: npt.ArrayLike | None = None,
    effects: Sequence[Effect] = (),
    settings: Settings = None,
) -> Motion:
    """Simulate the cloth of a scene from rest at its template, one implicit step after the other.

    Stretching, shearing and bending as in Stotko et al., CVPR 2024, Eqs. 5-11; by default Newton's method
    with BDF2 steps (``simulator=implicit``). The video itself is not looked at.

    Args:
        scene: its template, cloth size, pinned vertices, gravity and frame times are used.
        stiffness: by name, in SI units: stretching [N/m], shearing [N·m], bending [N·m], as
            ``Run.stiffness``; those left out are where a fit starts.
        wind: constant force per mass beside gravity, (3,) [m/s²].
        turbulence: force over an interior vertex's mass, (F-1, H, W, 3) [m/s²]; entry t acts between frame t
            and frame t + 1. None for none.
        boundary_motion: displacement of the n pinned vertices from the template, (F, n, 3) [m]; None holds
            them still.
        effects: what acts beside that, with their values, e.g. ``[AirDrag({"normal": 0.5})]``.
        settings: of ``cloth`` and ``simulator`` in ``toile fit``, e.g. ``{"simulator.substeps": 4}``.

    Returns:
        Positions at the frames of the scene.

    Raises:
        InputError: a stiffness that there is none of, a wrong shape, an effect of the image, or a setting
            that a simulation has no use for.
        SimulationError: a step did not converge.
    """
    lines = _only(overrides(settings), ("cloth", "simulator", "effect"), "simulate")
    loaded = scene if isinstance(scene, Scene) else load_scene(scene)
    with called("fit", ["scene.name=unused", *lines]) as cfg:
        units = scene_units(loaded, cfg.cloth.areal_density)
        start = {name: float(cfg.parameters[name]) for name in ClothParameters.STIFFNESSES}
        network = {**start, **_in_network_units(stiffness or {}, units)}
        make: Callable[..., ClothParameters] = ClothParameters
        problem = build_reconstruction(cfg, loaded, partial(make, **network))
        if effects:
            problem.effects = FitEffects((*problem.effects.acting(), *effects))
        p = problem.parameters
        with torch.no_grad():
            _put(p.wind, wind, "wind")
            if turbulence is not None:
                _put(p.turbulence, turbulence, "turbulence", (len(p.turbulence), *loaded.grid, 3))
            if boundary_motion is not None:
                _put(p.boundary_motion, boundary_motion, "boundary_motion")
            positions = problem.simulate(loaded.n_frames).positions[0]
            si = _in_si(p)
    return Motion(
        positions.reshape(loaded.n_frames, *loaded.grid, 3).numpy(), _times(loaded), si, dict(network)
    )


def render(
    scene: Scene | str | Path,
    positions: Run | Motion | npt.ArrayLike,
    *,
    camera: Camera | None = None,
    settings: Settings = None,
) -> Pictures:
    """Draw positions with the texture and the camera of a scene.

    Args:
        scene: its camera, texture and texture coordinates are used.
        positions: (F, H, W, 3) or (H, W, 3) [m], camera frame; a Run brings the texture coordinates that it
            has fitted.
        camera: that is looked through; None for the scene's. With another one, ``Pictures.as_scene`` makes a
            scene whose camera is not what it is taken for.
        settings: of ``renderer`` in ``toile fit``, e.g. ``{"renderer.supersampling": 2}``.

    Returns:
        Colours, silhouettes and depth of every frame.

    Raises:
        InputError: positions of another grid, or not finite.
    """
    lines = _only(overrides(settings), ("renderer",), "render")
    loaded = scene if isinstance(scene, Scene) else load_scene(scene)
    x = _positions(positions, loaded)
    uv = loaded.texture_coordinates
    offset = positions.parameters.get(TEXTURE_OFFSET) if isinstance(positions, Run) else None
    if offset is not None:
        uv = uv + torch.from_numpy(offset).to(uv.dtype)
    with called("fit", ["scene.name=unused", *lines]) as cfg:
        renderer = instantiate(cfg.renderer)
    faces, flat = grid_faces(*loaded.grid), uv.reshape(-1, 2)
    through = loaded.camera if camera is None else camera
    drawn = []
    with torch.no_grad():
        for frame in x.reshape(len(x), 1, -1, 3):
            drawn.append(renderer.render(frame, faces, flat, loaded.texture, through))
    return Pictures(
        rgb=torch.cat([images.rgb for images in drawn]).numpy(),
        silhouettes=torch.cat([images.silhouette for images in drawn]).numpy(),
        depth=torch.cat([images.depth for images in drawn]).numpy(),
        positions=x.numpy(),
        scene=loaded,
    )


def fit(
    scene: Scene | str | Path,
    settings: Settings = None,
    *,
    folder: str | Path | None = None,
    effects: Sequence[Effect] = (),
) -> Run:
    """Reconstruct the cloth of one video: its motion, its stiffness and the forces on it.

    By default Gauss-Newton through the implicit solver in sliding windows: once to calibrate the stiffness,
    once to track the forces (``optimization=tracking``). The physics, and ``experiment=paper``, follow
    Stotko, Wandel, Klein, Physics-guided Shape-from-Template, CVPR 2024 (Eqs. 4-11 and 17). It takes minutes;
    stopped and called again with the same folder and settings, it goes on where it was, bit for bit.

    Args:
        scene: from ``load_scene`` or ``generate``, the name of a scene, or its folder. A scene that was made
            or changed in memory is written into the run folder and read from there.
        settings: of ``toile fit``, e.g. ``{"optimization": "identification", "seed": 1}``.
        folder: of the run; None for ``outputs/fit/<scene>/<time>`` in the current folder.
        effects: what acts beside inertia, the three energies, gravity and wind, with the values that the fit
            starts from; those of the package by name as well: ``{"effect": ["air_drag", "gusts"]}``.

    Returns:
        Positions (F, H, W, 3) [m], stiffnesses in SI and network units, all fitted parameters, metrics, and
        the folder with trajectory, video and page.

    Raises:
        InputError: the scene or a setting is of no use, or the folder holds a run with other settings.
        SimulationError: the motion could not be simulated.
        KeyboardInterrupt: it was interrupted; how to continue has been printed.
    """
    task = _task("fit", scene, settings, folder, effects, "effect")
    with called("fit", task.arguments, task.folder) as cfg, alone_in(output_folder()):
        task.write_scene()
        run = finished_fit(cfg).folder
    return load_run(run.path)


def evaluate(
    motion: Run | Motion | str | Path | npt.ArrayLike,
    scene: Scene | str | Path | None = None,
    *,
    seed: int = 0,
    n_frames: int | None = None,
    settings: Settings = None,
    save: bool = False,
) -> EvaluationResult:
    """Measure a motion by every metric that the ground truth of its scene allows.

    Chamfer distances are unaligned, as in Stotko et al., CVPR 2024, Tables 1-3; each metric says in its
    ``protocol`` how it is measured.

    Args:
        motion: a run, its folder, or positions (F, H, W, 3) [m].
        scene: to measure against; None for that of the run.
        seed: of the samples on the surfaces.
        n_frames: only the first frames; None for all of the scene.
        settings: of ``toile evaluate``, e.g. ``{"renderer": "reference"}``.
        save: write the numbers into the metrics.json of the run, as the command does.

    Returns:
        Metrics with unit, mean, values per frame and protocol; ``summary_table()`` shows them.

    Raises:
        InputError: positions without a scene, or that do not fit it; a folder that holds no run.
    """
    common = [*overrides({"seed": seed, "n_frames": n_frames}), *overrides(settings)]
    if isinstance(motion, str | Path):
        motion = load_run(motion)
    on_disk = [] if scene is None else _where(scene)
    if isinstance(motion, Run) and on_disk is not None:
        with called("evaluate", [*_run_override(motion.folder), *on_disk, *common]) as cfg:
            run = open_run_folder(motion.folder)
            result = evaluated(cfg, run)
            if save:
                store(result, run)
        return result
    if scene is None or save:
        raise InputError(
            "Positions, or a scene in memory, belong to no run",
            where="evaluate",
            expected="a scene beside positions, and save=False",
            got="no scene" if scene is None else "save=True",
        )
    loaded = scene if isinstance(scene, Scene) else load_scene(scene)
    lines = _only(common, ("renderer", "seed", "n_frames"), "evaluate")
    with called("evaluate", ["run=unused", *lines]) as cfg:
        x = _positions(motion, loaded)
        return _evaluate(x, loaded, instantiate(cfg.renderer), seed=cfg.seed, n_frames=cfg.n_frames)


def diagnose(
    scene: Scene | str | Path,
    settings: Settings = None,
    *,
    folder: str | Path | None = None,
    effects: Sequence[Effect] = (),
) -> Diagnosis:
    """Say why the simulation differs from a video: which effect the model lacks, where, and how sure that is.

    Every candidate competes with "none" and "something else" by its evidence around its own best fit, and by
    how it predicts windows of frames ahead; docs/diagnosis/method.md has the equations and their sources. It
    takes minutes; stopped and called again with the same folder and settings, it goes on where it was.

    Args:
        scene: as for ``fit``.
        settings: of ``toile diagnose``, e.g. ``{"diagnosis": "quick", "workers": 1}``.
        folder: of the run; None for ``outputs/diagnose/<scene>/<time>`` in the current folder.
        effects: candidates beside those of the package, with all values zero. Probabilities are calibrated
            for the package's own candidates alone.

    Returns:
        The answer with probability, candidates, gap maps and page.

    Raises:
        InputError: the scene or a setting is of no use, or the folder holds a diagnosis with other settings.
        SimulationError: the motion could not be simulated.
        KeyboardInterrupt: it was interrupted; how to continue has been printed.
    """
    task = _task("diagnose", scene, settings, folder, effects, "candidates")
    with (
        also_known(effects),
        called("diagnose", task.arguments, task.folder) as cfg,
        alone_in(output_folder()),
    ):
        task.write_scene()
        run = create_run_folder(output_folder())
        report = finished_before(cfg, run) or finished_diagnosis(
            cfg, run, lambda what, share: log.info("%s, %.0f %%", what, 100 * share)
        )
    return Diagnosis(run.path, report)


def load_run(folder: str | Path) -> Run:
    """Read what a fit has left in its folder, finished or interrupted.

    Args:
        folder: of the run, e.g. ``outputs/fit/R1/2026-11-23_10-00-00``.

    Raises:
        InputError: no run, or a file in it cannot be read.
    """
    run = open_run_folder(Path(folder))
    saved = read_trajectory(run)
    metrics = read_metrics(run) if run.metrics.is_file() else None
    return Run(
        run.path,
        saved.positions,
        saved.times,
        saved.parameters,
        None if metrics is None else EvaluationResult.from_dict(metrics),
        tuple((metrics or {}).get(SCENE_WARNINGS, ())),
    )


@dataclass(frozen=True)
class _Task:
    """A fit or diagnosis to be run.

    Attributes:
        arguments: overrides of the command.
        folder: of the run; None for the one that the configuration names.
        scene: to be written first, and where to, if it is in memory only.
    """

    arguments: list[str]
    folder: Path | None
    scene: tuple[Scene, Path] | None = None

    def write_scene(self) -> None:
        """Write a scene that was made in memory.

        Raises:
            InputError: the folder holds another one.
        """
        if self.scene is None:
            return
        scene, target = self.scene
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            write_native(scene, target)
            return
        with TemporaryDirectory() as temporary:
            new = write_native(scene, Path(temporary) / target.name)
            if not _same_files(new, target):
                raise InputError(
                    "The folder holds a run of another scene of that name",
                    where=str(target),
                    expected="the scene it was begun with, or another folder",
                    got=f"scene {scene.name} with other contents",
                )


def _task(
    command: str,
    scene: Scene | str | Path,
    settings: Settings,
    folder: str | Path | None,
    effects: Sequence[Effect],
    group: str,
) -> _Task:
    # Settings come last and win over how a scene was loaded.
    lines = _without(overrides(settings), ("scene", "scene.name", "hydra.run.dir", "resume"), command)
    if effects:
        added = effect_overrides(effects, group)
        with called(command, [*scene_overrides("unused"), *lines]) as cfg:
            _check_once([*names_in(cfg, group), *(str(effect.NAME) for effect in effects)])
        lines = [*lines, *added]
    place = None if folder is None else Path(folder)
    known = _where(scene)
    if known is not None:
        return _Task([*known, *lines], place)
    assert isinstance(scene, Scene)
    if Path(scene.name).name != scene.name:
        raise InputError(
            "A scene in memory needs a name that a folder may have",
            where="Scene.name",
            expected="no slashes, and not empty",
            got=repr(scene.name),
        )
    if place is None:
        with called(command, [*scene_overrides(scene.name), *lines]):
            place = output_folder()
    target = place.absolute() / "scene" / scene.name
    as_written = {"scene.crop_margin": None, "scene.minimum_component": 0.0}
    arguments = [*scene_overrides(target), *overrides(as_written), *lines]
    return _Task(arguments, place, (scene, target))


def _check_once(names: list[str]) -> None:
    if len(set(names)) < len(names):
        raise InputError(
            "An effect acts twice",
            where="effects",
            expected="each once, by settings or from Python",
            got=", ".join(names),
        )


def _where(scene: Scene | str | Path) -> list[str] | None:
    """Overrides that load the scene; None for one that is in memory only."""
    return _LOADED.get(scene) if isinstance(scene, Scene) else scene_overrides(scene)


def _only(lines: list[str], groups: tuple[str, ...], function: str) -> list[str]:
    """The overrides, if they are of these parts of the configuration."""
    for line in lines:
        name = setting_name(line)
        if name.partition(".")[0].partition("/")[0] not in groups:
            raise InputError(
                f"toile.{function} has no such setting",
                where="settings",
                expected=f"settings of {', '.join(groups)}",
                got=line,
            )
    return lines


def _without(lines: list[str], names: tuple[str, ...], function: str) -> list[str]:
    """The overrides, if none is for what the function's own arguments say."""
    for line in lines:
        if setting_name(line) in names:
            raise InputError(
                f"toile.{function} takes this as an argument of its own",
                where="settings",
                expected=f"settings other than {', '.join(names)}",
                got=line,
            )
    return lines


def _run_override(folder: Path) -> list[str]:
    return overrides({"run": str(folder)})


def _data_override(data: str | Path | None) -> list[str]:
    return [] if data is None else overrides({"paths.data": str(data)})


def _in_network_units(stiffness: Mapping[str, float], units: NetworkUnits) -> dict[str, float]:
    """Stiffnesses in SI units, converted; those that are not given are left out."""
    one = {p.name: units.of(p.unit) for p in GRID_PARAMETERS}
    for name, value in stiffness.items():
        if name not in one or not (isinstance(value, int | float) and 0 < value < float("inf")):
            raise InputError(
                "There is no such stiffness",
                where=f"stiffness: {name}",
                expected=f"{', '.join(one)}, each a finite number > 0 in SI units",
                got=repr(value),
            )
    return {name: float(value) / one[name] for name, value in stiffness.items()}


def _in_si(parameters: ClothParameters) -> dict[str, float]:
    material = parameters.material()
    return {name: float(material[name].detach()) for name in parameters.STIFFNESSES}


def _put(parameter: Tensor, value: npt.ArrayLike, name: str, shape: tuple[int, ...] | None = None) -> None:
    """Give a parameter its value, in the parameter's own shape or the one a user knows it by."""
    expected = tuple(parameter.shape) if shape is None else shape
    given = np.asarray(value, dtype=np.float64)
    if given.shape != expected or not np.isfinite(given).all():
        raise InputError(
            f"{name} does not fit the scene",
            where=name,
            expected=f"finite numbers of shape {expected}",
            got=f"shape {given.shape}" if given.shape != expected else "NaN or infinite numbers",
        )
    parameter.copy_(torch.from_numpy(given).reshape(parameter.shape))


def _positions(motion: object, scene: Scene) -> Tensor:
    """Positions (F, H, W, 3) [m] of a run, a motion or an array, on the scene's grid."""
    x = motion.positions if isinstance(motion, Run | Motion) else motion
    array = np.asarray(x, dtype=np.float64)
    array = array[None] if array.ndim == 3 else array
    if array.shape[1:] != (*scene.grid, 3) or not np.isfinite(array).all():
        raise InputError(
            "Positions do not fit the scene",
            where=f"scene {scene.name}",
            expected=f"finite positions of shape (F, {scene.grid[0]}, {scene.grid[1]}, 3) in metres",
            got=f"shape {array.shape}, {int((~np.isfinite(array)).sum())} numbers that are NaN or infinite",
        )
    return torch.from_numpy(array.copy())


def _times(scene: Scene) -> Array:
    if scene.times is not None:
        return scene.times.numpy()
    return np.arange(scene.n_frames) / scene.fps


def _size(positions: Array) -> str:
    n_frames, height, width, _ = positions.shape
    return f"{n_frames} frames, {height} × {width} vertices"


def _same_files(one: Path, other: Path) -> bool:
    names = sorted(str(p.relative_to(one)) for p in one.rglob("*") if p.is_file())
    others = sorted(str(p.relative_to(other)) for p in other.rglob("*") if p.is_file())
    return names == others and not any(filecmp.cmpfiles(one, other, names, shallow=False)[1:])
