"""Folders and files of any name, in every command that takes one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from toile.cli.configuration import name_scenes, name_sessions
from toile.cli.path_arguments import quote_paths
from toile.geometry.io import write_point_cloud
from toile.learning.fit.module import FitModule
from toile.reports.run_folder import RunFolder
from toile.scenes.native import write_native

ODD = "a b,c=d (é)"
TINY_FIT = ("optimization=adam", "optimization.cycles=2", "simulator.substeps=1", "logger=none")


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    folder = tmp_path / ODD
    folder.mkdir()
    return folder


@pytest.fixture
def odd_run(run_folder: RunFolder, odd: Path) -> str:
    """A finished run below the odd folder, relative to the working folder."""
    shutil.move(run_folder.path, odd / "run=1, 2")
    return f"{ODD}/run=1, 2"


@pytest.mark.parametrize("form", ["relative", "absolute", "trailing slash"])
def test_doctor_of_a_scene_by_its_folder(toile, tiny_scene, odd: Path, form) -> None:
    folder = write_native(tiny_scene, odd / ODD)
    scene = {"relative": f"{ODD}/{ODD}", "absolute": str(folder), "trailing slash": f"{folder}/"}[form]
    status, out, err = toile("doctor", f"scene={scene}")
    assert (status, err) == (0, "")
    assert "errors: 0" in out


@pytest.mark.parametrize("scene", [ODD, f"'{ODD}'"])
def test_a_scene_by_its_name_in_the_data_folder(toile, tiny_scene, tmp_path: Path, scene) -> None:
    write_native(tiny_scene, tmp_path / "data" / "made" / ODD)
    status, out, _ = toile("doctor", f"scene={scene}")
    assert status == 0
    assert "errors: 0" in out


def test_a_data_folder(toile, tiny_scene, odd: Path) -> None:
    write_native(tiny_scene, odd / "made" / "tiny")
    assert toile("doctor", "scene=tiny", f"paths.data={ODD}").status == 0


def test_a_sweep_over_scenes_is_still_one(toile, tiny_scene, odd: Path) -> None:
    write_native(tiny_scene, odd / "one")
    status, out, _ = toile("doctor", "-m", "scene=one,two")
    assert status == 2
    assert "Scene one" in out
    assert "Scene two" in out


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_masks(toile, odd: Path) -> None:
    frames = np.zeros((2, 48, 64, 3), dtype=np.uint8)
    frames[:, 12:36, 14:38] = (220, 140, 60)
    iio.imwrite(odd / "clip (1).mp4", frames, plugin="FFMPEG", fps=20, macro_block_size=2)
    video = f"video={ODD}/clip (1).mp4"
    status, out, err = toile("masks", video, f"still={ODD}/still=0.png")
    assert (status, out, err) == (0, f"{ODD}/still=0.png\n", "")
    status, out, err = toile("masks", video, f"scene={ODD}/new, scene", "method=dark_background")
    assert (status, err) == (0, "")
    assert len(list((odd / "new, scene" / "masks").iterdir())) == 2
    assert f"{ODD}/new, scene/masks.mp4" in out
    Image.fromarray(frames[0]).save(odd / "0.png")
    given = odd / "given=é"
    given.mkdir()
    for k in range(2):
        Image.fromarray(frames[k, ..., 0]).save(given / f"{k}.png")
    arguments = ("method=given", f"method.folder={ODD}/given=é")
    assert toile("masks", video, "scene=plain", *arguments).status == 0


def test_template(toile, curved_sheet, odd: Path) -> None:
    write_point_cloud(odd / "cloud=1.npy", torch.from_numpy(curved_sheet.noisy_points()))
    camera = {"focal_length": [420, 410], "optical_center": [163, 117.5]}
    (odd / "camera (1).json").write_text(json.dumps(camera))
    curved_sheet.write_video(odd / "video")
    status, _, err = toile(
        "template",
        f"scene={ODD}/video",
        "surface=points",
        f"surface.file={ODD}/cloud=1.npy",
        f"camera.file={ODD}/camera (1).json",
        "grid=[12,10]",
    )
    assert (status, err) == (0, "")
    assert (odd / "video" / "template.obj").is_file()


def test_generate(toile, odd: Path) -> None:
    tiny = (
        "settings.grid=[5,4]",
        "settings.n_frames=2",
        "settings.image_size=[64,80]",
        "settings.substeps=2",
    )
    scene = (
        "settings.cloth_size=[0.4,0.3]",
        "settings.focal_length=80",
        "texture.height=64",
        "texture.width=64",
    )
    status, out, err = toile("generate", *tiny, *scene, f"folder={ODD}/new (é), 2")
    assert (status, out, err) == (0, f"{ODD}/new (é), 2\n", "")
    assert (odd / "new (é), 2" / "scene.json").is_file()


def test_evaluate_and_export(toile, odd_run: str, odd: Path) -> None:
    status, out, err = toile("evaluate", f"run={odd_run}")
    assert (status, err) == (0, "")
    assert f"{odd_run}/metrics.json" in out
    assert toile("export", f"run={odd_run}", "format=[obj,ply]", f"folder={ODD}/to, there").status == 0
    assert list((odd / "to, there").iterdir())
    # Where it goes by default.
    assert toile("export", f"run={odd_run}", "format=glb").status == 0
    assert list((Path(odd_run) / "export").iterdir())


def test_report_and_tables(toile, odd_run: str, odd: Path) -> None:
    assert toile("evaluate", f"run={odd_run}").status == 0
    status, out, err = toile("report", odd_run, f"output={ODD}/page=1 (é).html")
    assert (status, err, out) == (0, "", f"{ODD}/page=1 (é).html\n")
    assert (odd / "page=1 (é).html").stat().st_size > 0
    shutil.copytree(odd_run, odd / "run=2, 2")
    config = odd / "run=2, 2" / "config.yaml"
    config.write_text(config.read_text() + "seed: 2\n")
    for page in (toile("report", odd_run, f"{ODD}/run=2, 2"), toile("report", ODD)):
        assert (page.status, page.err) == (0, "")
        assert (odd / "report.html").is_file()
    assert toile("tables", ODD, f"output={ODD}/tables, all", "metrics=[chamfer]").status == 0
    assert (odd / "tables, all" / "ablations.md").is_file()


def test_fit_and_resume(toile, swaying_scene, odd: Path, monkeypatch) -> None:
    write_native(swaying_scene, odd / ODD)
    step = FitModule.training_step

    def interrupted(self: FitModule, batch: int, batch_idx: int) -> None:
        if self.cycles_done == 1:
            raise KeyboardInterrupt
        step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(FitModule, "training_step", interrupted)
        assert toile("fit", f"scene={ODD}/{ODD}", *TINY_FIT, f"paths.outputs={ODD}/out").status == 130
    # Named after the scene, whatever its name.
    (run,) = (odd / "out" / "fit" / ODD).iterdir()
    for resumed in (str(run), f"{ODD}/out/fit/{ODD}/{run.name}"):
        outcome = toile("fit", f"resume={resumed}")
        assert outcome.status == 0, outcome.err
    assert (run / "index.html").is_file()
    assert len(list((odd / "out" / "fit" / ODD).iterdir())) == 1
    assert not Path("outputs").exists()


def test_train_and_resume(toile, odd: Path) -> None:
    outcome = toile(
        "train", "training=tiny", "threads=1", "logger=none", f"hydra.run.dir={ODD}/run=1", "max_minutes=0"
    )
    assert outcome.status == 0, outcome.err
    outcome = toile("train", f"resume={ODD}/run=1", "max_minutes=null")
    assert outcome.status == 0, outcome.err
    weights = odd / "run=1" / "surrogate.pt"
    assert weights.is_file()
    _, shown, _ = toile(
        "fit", "scene=R1", "simulator=surrogate", f"simulator.build.weights={weights}", "--cfg", "job"
    )
    assert yaml.safe_load(shown)["simulator"]["build"]["weights"] == str(weights)


@pytest.mark.parametrize("command", ["diagnose", "fit"])
def test_the_scene_of_commands_that_take_long(toile, command, odd: Path) -> None:
    _, out, _ = toile(command, f"scene={odd}", f"hydra.run.dir={ODD}/new=1", "--cfg", "all")
    shown = yaml.safe_load(out)
    assert shown["scene"]["name"] == str(odd)
    assert shown["hydra"]["run"]["dir"] == f"{ODD}/new=1"


def test_blind(toile, odd: Path) -> None:
    places = (f"folder={ODD}/set", f"key={ODD}/the=key", f"predictions={ODD}/p (1)", "name=x")
    _, out, _ = toile("blind", "make", *places, "--cfg", "job")
    shown = yaml.safe_load(out)
    assert (shown["folder"], shown["key"]) == (f"{ODD}/set", f"{ODD}/the=key")
    assert shown["predictions"] == f"{ODD}/p (1)"


def test_a_config_folder(toile, odd: Path) -> None:
    (odd / "scene").mkdir()
    (odd / "scene" / "curtain.yaml").write_text("defaults: [native]\nname: red curtain\n")
    status, out, _ = toile("doctor", "--config-dir", ODD, "scene=curtain", "--cfg", "job")
    assert status == 0
    assert "name: red curtain" in out
    assert "curtain" in toile("doctor", "--config-dir", ODD, "--help").out


@pytest.mark.parametrize(
    "argument",
    [
        "run=[a,b]",
        "run=a,b",
        "run=plain",
        "run=with space",
        "run='quoted, already'",
        "output=null",
        "folder=${paths.data}/x",
        "run=glob(*)",
        "run=choice(a,b)",
        "seed=1,2",
        "seed=range(1,4)",
        "grid=[4,5]",
        "scene=R1",
        "--config-dir=a,b",
        "~renderer",
        "callbacks.progress=null",
        "corners=[[1,2],[3,4]]",
        "grid=[4,5",
    ],
)
def test_hydras_syntax_stays(argument, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert quote_paths([argument]) == [argument]


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        # A folder may be called like a number.
        ("run=12_3", "run='12_3'"),
        ("video=1e3", "video='1e3'"),
        ("output=new (é).html", "output='new (é).html'"),
        ("output=it's.html", r"output='it\'s.html'"),
        ("+run=x=y", "+run='x=y'"),
        # What is there is a path, even if it could be a sweep.
        ("run=there,too", "run='there,too'"),
        ("settings.name=there=too", "settings.name='there=too'"),
        ("seed=0,1", "seed=0,1"),
    ],
)
def test_paths_are_quoted(argument, expected, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("there,too", "there=too", "0,1"):
        (tmp_path / name).mkdir()
    assert quote_paths([argument]) == [expected]


@pytest.mark.parametrize(
    ("scene", "names"),
    [
        ("R1,a1cb40", "'R1','a1cb40'"),
        ("there,too", "'there,too'"),
        ("not there (é)", "'not there (é)'"),
        ("'a,b'", "'a,b'"),
        ("1e4", "'1e4'"),
    ],
)
def test_names_of_scenes(scene, names, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there,too").mkdir()
    assert name_scenes([f"scene={scene}"]) == ["scene=native", f"scene.name={names}"]


@pytest.mark.parametrize(
    ("given", "session"),
    [(["session=mine"], "mine"), (["session=mine", "session=other"], "other"), (["session='a,b'"], "a,b")],
)
def test_a_session_is_found_again_from_anywhere(given, session, tmp_path: Path, monkeypatch) -> None:
    """``resume=`` reads what the command line had said, wherever it is called."""
    monkeypatch.chdir(tmp_path)
    whole = tmp_path / session
    assert name_sessions(["seed=1", *given]) == ["seed=1", f"session='{whole}'", f"scene.name='{whole}'"]


def test_every_job_of_a_sweep_is_called_after_its_own_session() -> None:
    assert name_sessions(["session=mine,other"]) == ["session=mine,other", "scene.name=${session}"]
    assert name_sessions(["session=mine", "scene=R1"]) == ["session=mine", "scene=R1"]
    assert name_sessions(["session=null"]) == ["session=null"]


def test_a_switch_is_no_path(toile) -> None:
    """video=<file> names a path, report.video=false does not."""
    _, out, _ = toile("fit", "scene=R1", "report.video=false", "--cfg", "job")
    assert "video: false" in out
