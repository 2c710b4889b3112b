"""``toile.fit`` and its like: what the commands do, from Python."""

from __future__ import annotations

import dataclasses
import inspect
import json
import pydoc
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

import toile
from toile import api
from toile.cli.configuration import CONF
from toile.diagnosis.fingerprint import fingerprint
from toile.effects.air_drag import AirDrag
from toile.effects.base import ForceEffect, Parameter, Stage, Surroundings
from toile.effects.catalogue import CATALOGUE, STAGES, also_known
from toile.effects.gusts import Gusts
from toile.effects.shading import Shading
from toile.errors import InputError
from toile.reports.run_folder import RunFolder, read_metrics, read_trajectory
from toile.scenes.native import write_native
from toile.scenes.scene import Scene

Toile = Callable[..., Any]
QUICK = {"logger": "none", "report": {"video": False, "page": False}}
QUICK_LINES = ("logger=none", "report.video=false", "report.page=false")


class Breath(ForceEffect):
    """A breath of air away from the camera, in the middle of the clip."""

    NAME: ClassVar[str] = "breath"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (
        Parameter("strength", "m/s²", -20.0, 20.0, 3.0, "acceleration away from the camera"),
    )
    SOURCE: ClassVar[str] = "this test"

    def acceleration(self, times: torch.Tensor, around: Surroundings) -> torch.Tensor:
        """See ForceEffect."""
        shape = torch.exp(-(((times - times[-1] / 2) / 0.03) ** 2))
        away = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        return self.value("strength") * shape[:, None, None] * away


@pytest.fixture
def swaying(swaying_scene: Scene, toile: Toile, tmp_path: Path) -> Path:
    """The scene "swaying" in the data folder of the current folder."""
    return write_native(swaying_scene, tmp_path / "data" / "made" / "swaying")


def same(a: api.Run, b: api.Run) -> bool:
    assert a.parameters.keys() == b.parameters.keys()
    equal = [np.array_equal(v, b.parameters[k]) for k, v in a.parameters.items()]
    return np.array_equal(a.positions, b.positions) and all(equal)


@pytest.mark.usefixtures("swaying")
def test_a_fit_is_that_of_the_command_bit_for_bit(toile: Toile) -> None:
    settings = ("seed=3", "optimization.stages.track.term.per_side=48")
    outcome = toile("fit", "scene=swaying", *settings, *QUICK_LINES, "hydra.run.dir=command")
    assert outcome.status == 0, outcome.err
    track = {"seed": 3, "optimization": {"stages": {"track": {"term": {"per_side": 48}}}}}
    found = api.fit(api.load_scene("swaying"), {**track, **QUICK}, folder="python")
    assert same(found, api.load_run("command"))
    assert same(found, api.fit("swaying", [*settings, *QUICK_LINES], folder="lines"))
    # The folder is as good as one of the command.
    assert (found.folder / "config.yaml").read_text() == Path("command/config.yaml").read_text().replace(
        str(Path("command").absolute()), str(Path("python").absolute())
    )
    resumed = toile("fit", "resume=python")
    assert resumed.status == 0
    assert "finished before" in resumed.out
    with pytest.raises(InputError, match="seed: 4 instead of 3"):
        api.fit("swaying", {**track, **QUICK, "seed": 4}, folder="python")


@pytest.mark.usefixtures("swaying")
def test_a_run_is_pleasant_to_look_at(tmp_path: Path) -> None:
    found = api.fit("swaying", QUICK)
    assert found.folder.parent == tmp_path / "outputs" / "fit" / "swaying"
    assert found.positions.shape == (5, 8, 8, 3)
    assert found.stiffness.keys() == found.network_stiffness.keys() == {"stretching", "shearing", "bending"}
    saved = read_trajectory(RunFolder(found.folder)).parameters
    assert found.stiffness["shearing"] == saved["shearing [N·m]"]
    assert found.network_stiffness["shearing"] == saved["shearing [network units]"]
    assert found.metrics["chamfer"] < 1.0
    assert "Squared Chamfer distance" in repr(found)
    assert len(repr(found)) < 2000
    assert found.history["cycle"].is_monotonic_increasing
    page = found.page()
    assert page.is_file()
    page.unlink()
    assert found.page().read_text(encoding="utf-8").startswith("<!doctype html>")
    assert found.scene().name == "swaying"
    # Simulated again from what was found, it is the same motion.
    p = found.parameters
    again = api.simulate(
        "swaying",
        found.stiffness,
        wind=p["wind [m/s²]"],
        turbulence=p["turbulence [m/s²]"],
        boundary_motion=p["boundary motion [m]"],
    )
    np.testing.assert_allclose(again.positions, found.positions, atol=1e-6)
    assert again.stiffness == pytest.approx(found.stiffness)
    pictures = api.render("swaying", found)
    assert pictures.rgb.shape[:3] == pictures.depth.shape == pictures.silhouettes.shape
    seen = pictures.silhouettes > 0.5
    depth = found.positions[..., 2]
    assert depth.min() - 1e-3 < pictures.depth[seen].min() < pictures.depth[seen].max() < depth.max() + 1e-3


@pytest.mark.usefixtures("swaying")
def test_an_effect_from_python_is_that_of_the_configuration() -> None:
    named = {"effect": "air_drag", "effect.air_drag.values": {"normal": 0.5}, **QUICK}
    assert same(
        api.fit("swaying", named, folder="named"),
        api.fit("swaying", QUICK, folder="given", effects=[AirDrag({"normal": 0.5})]),
    )
    plain, slowed = api.simulate("swaying"), api.simulate("swaying", effects=[AirDrag({"normal": 20.0})])
    moved = [np.abs(m.positions - m.positions[0]).mean() for m in (plain, slowed)]
    assert moved[1] < 0.9 * moved[0]
    np.testing.assert_array_equal(
        slowed.positions,
        api.simulate(
            "swaying", settings={"effect": "air_drag", "effect.air_drag.values.normal": 20.0}
        ).positions,
    )


@pytest.mark.usefixtures("swaying")
def test_evaluation(tmp_path: Path) -> None:
    scene = api.load_scene("swaying")
    motion = api.simulate(scene)
    measured = api.evaluate(motion, scene)
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    error = np.linalg.norm(motion.positions - scene.ground_truth.vertices.numpy(), axis=-1).mean()
    assert measured.mean("vertex_error") == pytest.approx(1e3 * error)
    assert api.evaluate(scene.ground_truth.vertices, "swaying").mean("vertex_error") == 0
    found = api.fit(scene, QUICK, folder="run")
    assert found.evaluation is not None
    again = api.evaluate("run")
    # What only the fit can measure is kept.
    assert again.to_dict()["metrics"] == found.evaluation.to_dict()["metrics"]
    before = read_metrics(RunFolder(tmp_path / "run"))
    api.evaluate(found, n_frames=3)
    assert read_metrics(RunFolder(tmp_path / "run")) == before
    api.evaluate(found, n_frames=3, save=True)
    after = read_metrics(RunFolder(tmp_path / "run"))
    assert (after["n_frames"], after["fit"]) == (3, before["fit"])
    with pytest.raises(InputError, match="belong to no run"):
        api.evaluate(motion)


@pytest.mark.usefixtures("swaying")
def test_a_scene_in_memory_is_kept_with_its_run(toile: Toile, tmp_path: Path) -> None:
    scene = api.load_scene("swaying")
    motion = api.simulate(scene, wind=(0.0, 0.0, 2.0))
    filmed = api.render(scene, motion).as_scene("windy")
    found = api.fit(filmed, QUICK, folder="run")
    kept = api.load_scene(tmp_path / "run" / "scene" / "windy")
    torch.testing.assert_close(kept.frames, filmed.frames, atol=0.5 / 255 + 1e-6, rtol=0)
    assert kept.ground_truth is not None
    np.testing.assert_array_equal(kept.ground_truth.vertices, motion.positions)
    # The cloth is where it was put.
    assert found.metrics["vertex_error_percent"] < 2.0
    assert toile("report", "run").status == 0
    assert same(api.fit(filmed, QUICK, folder="run"), found)
    other = dataclasses.replace(filmed, frames=1 - filmed.frames)
    with pytest.raises(InputError, match="another scene of that name"):
        api.fit(other, QUICK, folder="run")
    with pytest.raises(InputError, match="a folder may have"):
        api.fit(dataclasses.replace(filmed, name="a/b"), QUICK)


@pytest.mark.usefixtures("toile")
def test_an_effect_of_ones_own_is_diagnosed(tmp_path: Path) -> None:
    small = {
        "texture": {"height": 120, "width": 120},
        "settings": {
            "grid": (8, 8),
            "refinement": 1,
            "cloth_size": (0.4, 0.4),
            "n_frames": 12,
            "substeps": 2,
            "image_size": (120, 120),
            "focal_length": 170.0,
        },
    }
    scene = api.generate("calm", small)
    assert (scene.name, scene.n_frames) == ("calm", 12)
    settings = {
        "diagnosis": "quick",
        "diagnosis.sides": [8],
        "diagnosis.shooting": {"modes": 2, "window": 4},
        "optimization.stages.track.term.per_side": 24,
        "workers": 1,
        "effect@candidates": ["air_drag", "shading"],
    }
    found = api.diagnose(scene, settings, folder="diagnosis", effects=[Breath()])
    assert set(found.table().index) == {"air_drag", "shading", "breath"}
    assert found.table().loc["breath", "stage"] == "actuation"
    assert not found.calibrated
    assert found.effect in repr(found)
    assert found.page().is_file()
    assert json.loads((tmp_path / "diagnosis" / "diagnosis.json").read_text())["verdict"]["effect"]
    assert "breath" not in CATALOGUE
    # As one that is finished it is read, not made again.
    assert api.diagnose(scene, settings, folder="diagnosis", effects=[Breath()]).report == found.report


def test_an_effect_is_known_for_a_while_only() -> None:
    with also_known([Breath(), AirDrag()]):
        assert CATALOGUE["breath"] is Breath
        assert STAGES["breath"] is Stage.ACTUATION
    assert "breath" not in CATALOGUE
    assert "breath" not in STAGES
    assert CATALOGUE["air_drag"] is AirDrag

    class Impostor(Breath):
        NAME: ClassVar[str] = "air_drag"

    with pytest.raises(InputError, match="in the catalogue"), also_known([Impostor()]):
        pass


def test_stages_know_the_code_of_an_effect_from_outside() -> None:
    made = "class Own(Breath):\n    def acceleration(self, times, around):\n        return {} * times"

    def own(factor: str) -> ForceEffect:
        names: dict[str, Any] = {"Breath": Breath, "__name__": "own"}
        exec(made.format(factor), names)
        effect = names["Own"]()
        assert isinstance(effect, ForceEffect)
        return effect

    assert fingerprint(own("1.0")) == fingerprint(own("1.0"))
    assert fingerprint(own("1.0")) != fingerprint(own("2.0"))
    assert fingerprint(own("1.0")) != fingerprint(Breath())


@pytest.mark.usefixtures("swaying")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: api.fit("swaying", {"optimisation": "track"}), "Did you mean optimization"),
        (lambda: api.fit("swaying", {"optimization": "trak"}), "Did you mean optimization=track"),
        (lambda: api.fit("swaying", {"seed": -1}), "a whole number >= 0"),
        (lambda: api.fit("swaying", {"cloth.areal_density": "thin"}), "a number > 0"),
        (lambda: api.fit("swaying", {"scene.name": "R1"}), "argument of its own"),
        (lambda: api.fit("swaying", ["seed"]), "key=value"),
        (lambda: api.fit("swaying", {"seed": object()}), "cannot have such a value"),
        (lambda: api.fit("swaying", effects=[Shading()]), "effects on the motion"),
        (lambda: api.fit("swaying", effects=[Gusts(n_modes=2)]), "cannot be stored"),
        (lambda: api.fit("swaying", effects=[AirDrag]), "is no effect"),
        (lambda: api.fit("swaying", {"effect": "air_drag"}, effects=[AirDrag()]), "acts twice"),
        (lambda: api.fit("nowhere"), "not found"),
        (lambda: api.diagnose("swaying", {"parameters.shearing": 3}), "Could not override"),
        (lambda: api.load_scene("swaying", fps=-1.0), "a number > 0"),
        (lambda: api.load_run("nowhere"), "Not a run folder"),
        (lambda: api.simulate("swaying", {"stretchiness": 3.0}), "There is no such stiffness"),
        (lambda: api.simulate("swaying", {"bending": -3.0}), "There is no such stiffness"),
        (lambda: api.simulate("swaying", wind=(1.0, 2.0)), r"shape \(3,\)"),
        (lambda: api.simulate("swaying", turbulence=np.zeros((4, 8, 8))), r"\(4, 8, 8, 3\)"),
        (lambda: api.simulate("swaying", settings={"seed": 3}), "has no such setting"),
        (lambda: api.render("swaying", np.zeros((2, 3, 3, 3))), "do not fit the scene"),
        (lambda: api.render("swaying", np.full((2, 8, 8, 3), np.nan)), "NaN or infinite"),
        (lambda: api.generate("data/made/swaying"), "exists already"),
    ],
)
def test_bad_input(call: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.usefixtures("swaying")
def test_hydra_of_the_caller_is_left_alone() -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        outer, config = GlobalHydra.instance().hydra, HydraConfig.instance().cfg
        api.simulate("swaying")
        assert GlobalHydra.instance().hydra is outer
        assert HydraConfig.instance().cfg is config
        assert compose("fit", ["scene=R1"]).scene.name == "R1"


def test_defaults_of_loading_are_those_of_the_command(swaying: Path) -> None:
    assert torch.equal(api.load_scene("swaying").frames, api.load_scene(swaying).frames)
    assert api.load_scene("swaying", n_frames=2).n_frames == 2
    assert api.load_scene("swaying", settings={"scene.crop_margin": None}).camera.height == 64


def test_the_package_is_light_until_it_is_used() -> None:
    code = (
        "import sys, toile\n"
        "assert 'fit' in dir(toile)\n"
        "assert not {'torch', 'numpy', 'hydra', 'toile.api'} & set(sys.modules)\n"
        "assert toile.fit.__module__ == 'toile.api'\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="fti"):
        _ = toile.fti  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", [name for name in toile.__all__ if not name.startswith("_")])
def test_help_reads_well(name: str) -> None:
    function = getattr(toile, name)
    text = pydoc.plain(pydoc.render_doc(function))
    for part in (f"{name}(", "Raises:", "InputError"):
        assert part in text
    signature = inspect.signature(function)
    assert not {p.kind for p in signature.parameters.values()} & {
        inspect.Parameter.VAR_POSITIONAL,
        inspect.Parameter.VAR_KEYWORD,
    }
    for parameter in signature.parameters:
        assert f"{parameter}: " in text
