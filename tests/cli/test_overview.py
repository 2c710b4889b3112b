"""Finding one's way: overview, help, shown configurations, wrong commands and wrong settings."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from toile.cli import THREAD_VARIABLES
from toile.cli.commands import COMMANDS


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_overview_lists_every_command(toile, arguments) -> None:
    status, out, _ = toile(*arguments)
    assert status == 0
    for name, command in COMMANDS.items():
        assert name in out
        assert command.summary in out


def test_unknown_command(toile) -> None:
    status, out, err = toile("fti", "scene=R1")
    assert status == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert "'fti'" in err
    assert "fit" in err


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_complete(command) -> None:
    assert importlib.util.find_spec(COMMANDS[command].module) is not None


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_choices_and_settings(toile, command) -> None:
    status, out, err = toile(command, "--help")
    assert (status, err) == (0, "")
    assert COMMANDS[command].summary in out
    assert "paths: default" in out
    assert "data: ${oc.env:TOILE_DATA,data}" in out


def test_shown_configuration(toile) -> None:
    status, out, _ = toile("doctor", "scene=R1", "--cfg", "job")
    assert status == 0
    assert "name: R1" in out
    assert "toile.scenes.texture_coordinates.projected" in out


def test_any_name_or_folder_is_a_scene(toile) -> None:
    _, out, _ = toile("doctor", "scene=../some where/12e4", "--cfg", "job")
    assert "name: ../some where/12e4" in out
    _, out, _ = toile("doctor", "scene=12e4", "--cfg", "job", "--resolve")
    assert "name: 12e4" in out or "name: '12e4'" in out


def test_flags_may_stand_anywhere(toile) -> None:
    status, out, _ = toile("evaluate", "run=x", "--cfg", "job", "seed=4", "-p", "seed", "~renderer")
    assert status == 0
    assert out.split() == ["4"]


def test_scenes_of_a_config_folder_stay_files(toile, tmp_path: Path) -> None:
    (tmp_path / "mine" / "scene").mkdir(parents=True)
    (tmp_path / "mine" / "scene" / "curtain.yaml").write_text("defaults: [native]\nname: red curtain\n")
    status, out, _ = toile("doctor", "--config-dir", "mine", "scene=curtain", "--cfg", "job")
    assert status == 0
    assert "name: red curtain" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("doctor",), "scene="),
        (("evaluate",), "run="),
        (("doctor", "scene=R1", "scene.nframes=3"), "scene.nframes"),
        (("doctor", "scene=R1", "colour=red"), "colour"),
        (("doctor", "scene=R1", "="), "="),
        (("evaluate", "run=x", "renderer=opengl"), "warp"),
        (("doctor", "scene=R1", "paths.data=${nothing}"), "nothing"),
    ],
)
def test_wrong_settings(toile, arguments, named) -> None:
    status, out, err = toile(*arguments)
    assert status == 2
    assert out == ""
    assert err.startswith("error: ")
    assert named in err


def test_setting_that_nothing_takes(toile, run_folder) -> None:
    status, _, err = toile("evaluate", "run=run", "+renderer.shine=2")
    assert status == 2
    assert "shine" in err


def test_threads_are_set_before_numpy_is_loaded() -> None:
    code = (
        "import os, sys, toile.cli.main\n"
        "assert not {'numpy', 'torch'} & set(sys.modules)\n"
        f"print(*(os.environ[name] for name in {THREAD_VARIABLES}))"
    )
    clean = {k: v for k, v in os.environ.items() if k not in THREAD_VARIABLES} | {"OMP_NUM_THREADS": "3"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=clean, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3", "1", "1"]


def test_console_script(tmp_path: Path) -> None:
    """The real process: entry point, exit status, nothing on stdout."""
    script = Path(sys.executable).with_name("toile")
    command = [script, "doctor", "scene.nothing=1"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "scene.nothing" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
