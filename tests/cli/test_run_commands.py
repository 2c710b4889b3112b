"""``toile evaluate``, ``export`` and ``report`` on a run folder."""

from __future__ import annotations

import importlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from toile.cli.run_scene import run_scene
from toile.reports.run_folder import RunFolder, read_trajectory, write_config, write_trajectory


def test_evaluate(toile, run_folder: RunFolder) -> None:
    status, out, err = toile("evaluate", "run=run")
    assert (status, err) == (0, "")
    saved = json.loads(run_folder.metrics.read_text())
    assert saved["scene"] == "tiny"
    assert saved["n_frames"] == 3
    # 1 mm off in depth, everywhere.
    assert saved["metrics"]["vertex_error"]["mean"] == pytest.approx(1.0, abs=1e-6)
    assert "Vertex error" in out
    assert "unaligned" in out
    assert out.splitlines()[-1] == str(Path("run/metrics.json"))


def test_evaluate_again_gives_the_same_bytes(toile, run_folder: RunFolder) -> None:
    toile("evaluate", "run=run")
    first = run_folder.metrics.read_bytes()
    toile("evaluate", "run=run")
    assert run_folder.metrics.read_bytes() == first


def test_evaluate_keeps_what_the_fit_noted(toile, run_folder: RunFolder) -> None:
    run_folder.metrics.write_text('{"fit": {"cycles": 3}, "seed": 7}')
    assert toile("evaluate", "run=run").status == 0
    saved = json.loads(run_folder.metrics.read_text())
    assert (saved["fit"], saved["seed"]) == ({"cycles": 3}, 0)


def test_evaluate_keeps_the_out_of_balance_force(toile, run_folder: RunFolder) -> None:
    """Only the fit knows the forces; an evaluation of fewer frames must not lose it either."""
    metric = {
        "title": "Out-of-balance force / weight",
        "unit": "",
        "protocol": "as measured",
        "higher_is_better": False,
        "mean": 0.2,
        "per_frame": [None, 0.2, None],
    }
    run_folder.metrics.write_text(json.dumps({"fit": {"out_of_balance": metric}}))
    for frames, expected in ((None, [None, 0.2, None]), (2, [None, 0.2]), (None, [None, 0.2, None])):
        more = () if frames is None else (f"n_frames={frames}",)
        assert toile("evaluate", "run=run", *more).status == 0
        saved = json.loads(run_folder.metrics.read_text())
        assert saved["metrics"]["out_of_balance"]["per_frame"] == expected
        assert "out_of_balance" not in saved["skipped"]


def test_evaluate_against_a_named_scene_and_without_renderer(toile, run_folder: RunFolder) -> None:
    run_folder.config.unlink()
    status, _, _ = toile("evaluate", "run=run", "scene=tiny", "scene.n_frames=3", "~renderer")
    assert status == 0
    assert "no renderer" in json.loads(run_folder.metrics.read_text())["skipped"]["silhouette_iou"]


def test_evaluate_without_a_scene(toile, run_folder: RunFolder) -> None:
    run_folder.config.unlink()
    status, _, err = toile("evaluate", "run=run")
    assert status == 2
    assert "config.yaml" in err
    write_config(run_folder, "seed: 1\n")
    status, _, err = toile("evaluate", "run=run")
    assert status == 2
    assert "names no scene" in err
    write_config(run_folder, "a: [\n")
    status, _, err = toile("evaluate", "run=run")
    assert status == 2
    assert "no YAML" in err


def test_evaluate_calls_nothing_that_a_run_folder_names(toile, run_folder: RunFolder, tmp_path: Path) -> None:
    text = run_folder.config.read_text()
    write_config(run_folder, text.replace("toile.scenes.registry.load_scene", "os.mkdir"))
    status, _, err = toile("evaluate", "run=run")
    assert status == 2
    assert "os.mkdir" in err
    write_config(run_folder, text.replace("toile.scenes.texture_coordinates.from_file", "os.mkdir"))
    assert toile("evaluate", "run=run").status == 2
    write_config(run_folder, text.replace("fps: null", "fps: ${oc.create:{_target_:os.mkdir}}"))
    assert toile("evaluate", "run=run").status == 2


def test_evaluate_a_trajectory_of_another_scene(toile, run_folder: RunFolder) -> None:
    write_trajectory(run_folder, np.zeros((3, 4, 4, 3)), fps=25.0)
    status, _, err = toile("evaluate", "run=run")
    assert status == 2
    assert "(3, 6, 5, 3)" in err
    assert "(3, 4, 4, 3)" in err


@pytest.mark.parametrize("command", ["evaluate", "export", "report"])
def test_no_run_folder(toile, tmp_path: Path, command) -> None:
    status, _, err = toile(command, "run=nowhere")
    assert status == 2
    assert "Not a run folder" in err
    assert "nowhere" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["evaluate", "export", "report"])
def test_broken_trajectory(toile, run_folder: RunFolder, command) -> None:
    run_folder.trajectory.write_bytes(run_folder.trajectory.read_bytes()[:100])
    status, _, err = toile(command, "run=run")
    assert status == 2
    assert "trajectory.npz" in err


@pytest.mark.parametrize("command", ["evaluate", "report"])
def test_unreadable_image(toile, run_folder: RunFolder, scene_folder: Path, command) -> None:
    (scene_folder / "rgbs" / "rgb_001.png").write_bytes(b"no image")
    status, _, err = toile(command, "run=run")
    assert status == 2
    assert "rgb_001.png" in err


def test_interrupted_write_leaves_the_old_file(toile, run_folder: RunFolder, monkeypatch) -> None:
    run_folder.metrics.write_text('{"fit": "old"}')
    before = sorted(run_folder.path.iterdir())

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupt)
    status, _, err = toile("evaluate", "run=run")
    assert (status, err) == (130, "interrupted\n")
    assert run_folder.metrics.read_text() == '{"fit": "old"}'
    assert sorted(run_folder.path.iterdir()) == before


def test_full_errors_on_request(toile, run_folder: RunFolder, monkeypatch, capsys) -> None:
    from toile.cli.main import main

    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    assert main(["evaluate", "run=nowhere"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_failed_simulation_has_its_own_status(toile, run_folder: RunFolder, monkeypatch) -> None:
    from toile.cli import evaluate
    from toile.physics.simulator import SimulationError

    def fail(*_: object, **__: object) -> None:
        raise SimulationError("simulation failed at frame 3")

    monkeypatch.setattr(evaluate, "evaluate", fail)
    status, _, err = toile("evaluate", "run=run")
    assert (status, err) == (3, "error: simulation failed at frame 3\n")


def test_mistakes_in_the_program_keep_their_traceback(toile, run_folder: RunFolder, monkeypatch) -> None:
    from toile.cli import evaluate

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr(evaluate, "evaluate", fail)
    with pytest.raises(ZeroDivisionError):
        toile("evaluate", "run=run")


@pytest.mark.parametrize(
    ("format", "files"),
    [
        ("glb", {"cloth.glb"}),
        ("usd", {"cloth.usdc"}),
        ("obj", {"obj"}),
        ("ply", {"ply"}),
        ("[glb,ply]", {"cloth.glb", "ply"}),
    ],
)
def test_export(toile, run_folder: RunFolder, format, files) -> None:
    status, out, err = toile("export", "run=run", f"format={format}")
    assert (status, err) == (0, "")
    assert files <= {path.name for path in (run_folder.path / "export").iterdir()}
    assert str(Path("run/export")) in out


def test_export_elsewhere_without_a_scene(toile, run_folder: RunFolder, tmp_path: Path) -> None:
    run_folder.config.unlink()
    assert toile("export", "run=run", "texture=false", "folder=there", "format=ply").status == 0
    assert len(list((tmp_path / "there" / "ply").glob("*.ply"))) == 3


def test_export_to_an_unknown_format(toile, run_folder: RunFolder) -> None:
    status, _, err = toile("export", "run=run", "format=[glb,fbx]")
    assert status == 2
    assert "obj, ply, glb, usd" in err
    assert "fbx" in err
    assert not (run_folder.path / "export").exists()


def test_report(toile, run_folder: RunFolder) -> None:
    toile("evaluate", "run=run")
    run_folder.history.write_text("cycle,loss,stretching [N/m]\n0,2.0,10\n1,1.0,11\n")
    status, out, err = toile("report", "run=run", "pictures=2")
    assert (status, err) == (0, "")
    assert out.strip() == str(Path("run/index.html"))
    page = run_folder.page.read_text()
    # The figures write the slash of N/m as an escape.
    for expected in ("tiny", "Vertex error", "areal density", "kg/m²", "stretching [N", "Frame 2"):
        assert expected in page


@pytest.mark.parametrize("command", ["export", "report"])
def test_fitted_texture_coordinates_are_used(toile, run_folder: RunFolder, monkeypatch, command) -> None:
    module = importlib.import_module(f"toile.cli.{command}")
    used = []
    monkeypatch.setattr(module, "run_scene", lambda *a, **k: used.append(run_scene(*a, **k)) or used[-1])
    trajectory = read_trajectory(run_folder)
    for offset in (0.0, 0.25):
        parameters = {"texture offset": np.full((6, 5, 2), offset)}
        write_trajectory(run_folder, trajectory.positions, fps=25.0, parameters=parameters)
        assert toile(command, "run=run").status == 0
    without, with_offset = (scene.texture_coordinates for scene in used)
    assert torch.allclose(with_offset - without, torch.tensor(0.25))


def test_report_of_a_bare_trajectory(toile, run_folder: RunFolder) -> None:
    run_folder.config.unlink()
    assert toile("report", "run=run", "scene=tiny").status == 0
    # The scene has a truth, and nobody has compared.
    assert "Not evaluated yet" in run_folder.page.read_text()
    assert len(read_trajectory(run_folder).positions) == 3


def test_report_takes_plain_folders(toile, run_folder: RunFolder, tmp_path: Path) -> None:
    status, out, _ = toile("report", "run", "scene=tiny", "output=there/page.html")
    assert (status, out.strip()) == (0, str(Path("there/page.html")))
    assert (tmp_path / "there" / "page.html").is_file()
    assert not run_folder.page.exists()


def test_report_of_several_runs(toile, run_folder: RunFolder, tmp_path: Path) -> None:
    toile("evaluate", "run=run")
    for name in ("it's, a=b", "other"):
        shutil.copytree(run_folder.path, tmp_path / "sweep" / "deep" / name)
    for arguments, page in (
        (("sweep",), "sweep/report.html"),
        (("run=sweep",), "sweep/report.html"),
        (("sweep/deep/it's, a=b", "sweep/deep/other"), "sweep/deep/report.html"),
        (("run", "sweep", "output=all.html"), "all.html"),
    ):
        status, out, err = toile("report", *arguments)
        assert (status, err) == (0, "")
        assert (tmp_path / out.strip()).samefile(tmp_path / page)
    text = (tmp_path / "all.html").read_text()
    assert "3 runs of tiny" in text
    assert "sweep/deep/other" in text


def test_report_of_nothing(toile, tmp_path: Path) -> None:
    (tmp_path / "empty" / "below").mkdir(parents=True)
    status, _, err = toile("report", "empty")
    assert status == 2
    assert "no fit below" in err
    status, _, err = toile("report")
    assert status == 2
    assert "say run=" in err


def test_plain_arguments_are_left_to_hydra_elsewhere(toile) -> None:
    assert toile("evaluate", "somewhere").status == 2
