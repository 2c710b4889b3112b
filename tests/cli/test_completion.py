"""Completion as the shells ask for it; bash itself, with the script that ``toile completion bash`` prints."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from toile.cli.commands import COMMANDS
from toile.cli.completion import SCRIPTS, candidates


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TOILE_DATA", str(tmp_path / "data"))


def test_commands() -> None:
    assert set(candidates([""])) == {*COMMANDS, "completion"}
    assert candidates(["di"]) == ["diagnose"]
    assert candidates(["completion", ""]) == ["bash", "fish", "zsh"]
    assert candidates(["nothing", ""]) == []


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("fit optimization=", ["adam", "identification", "track", "tracking"]),
        ("fit optimization=tr", ["track", "tracking"]),
        ("fit optimization=adam,tr", ["adam,track", "adam,tracking"]),
        ("fit simulator/integrator=", ["backward_euler", "bdf2"]),
        ("fit effect=[air_drag,gu", ["[air_drag,gusts"]),
        ("fit seed=", ["0"]),
        ("fit report.video=", ["false", "true"]),
        ("masks scene=R1 method=gi", ["given"]),
    ],
)
def test_values(words: str, expected: list[str]) -> None:
    *before, last = words.split()
    key = last.partition("=")[0]
    assert candidates([*before, last]) == [f"{key}={value}" for value in expected]


def test_settings_and_groups() -> None:
    found = candidates(["fit", ""])
    assert "resume=" in candidates(["diagnose", "res"])
    assert {"optimization=", "optimization.", "seed=", "resume=", "simulator/integrator="} <= set(found)
    assert not [word for word in found if word.startswith(("hydra", "_"))]
    assert "method=" not in found
    assert candidates(["fit", "cloth.a"]) == ["cloth.areal_density="]
    priors = candidates(["fit", "optimization.stages.track.priors.turb"])
    assert "optimization.stages.track.priors.turbulence=" in priors


def test_settings_follow_what_stands_before() -> None:
    assert candidates(["fit", "optimization.cyc"]) == []
    assert "optimization.cycles=" in candidates(["fit", "optimization=adam", "optimization.cyc"])
    # A sweep, or a mistake, must not silence it.
    assert candidates(["fit", "seed=0,1", "nonsense=(", "see"]) == ["seed="]


def test_scenes_of_the_data_folder(scene_folder: Path) -> None:
    assert candidates(["fit", "scene=ti"]) == ["scene=tiny"]
    assert candidates(["fit", "scene=dat"]) == ["scene=data/"]
    assert candidates(["fit", "paths.data=elsewhere", "scene=ti"]) == []


def test_files(tmp_path: Path) -> None:
    (tmp_path / "clip one.mp4").touch()
    (tmp_path / "clips").mkdir()
    (tmp_path / ".clip").touch()
    assert candidates(["masks", "video=cl"]) == ["video=clip one.mp4", "video=clips/"]
    assert candidates(["report", "cl"]) == ["clip one.mp4", "clips/"]
    assert candidates(["blind", "gr"]) == ["grade"]


def test_another_name_of_a_setting() -> None:
    assert "set=" in candidates(["blind", "make", "se"])
    assert candidates(["blind", "make", "set=sess"]) == [
        "set=sessions",
        "set=sessions_effects",
        "set=sessions_medium",
        "set=sessions_outside",
        "set=sessions_short",
        "set=sessions_tiny",
    ]
    assert "diagnosis=" in candidates(["record", "diag"])


def test_flags() -> None:
    assert candidates(["fit", "--cf"]) == ["--cfg"]
    assert candidates(["fit", "--cfg", ""]) == ["all", "hydra", "job"]


def in_bash(line: str, tmp_path: Path) -> list[str]:
    """COMPREPLY after the tab key at the end of a line."""
    tool = tmp_path / "bin" / "toile"
    tool.parent.mkdir(exist_ok=True)
    tool.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m toile.cli.main "$@"\n')
    tool.chmod(0o755)
    script = (
        'eval "$(toile completion bash)"\n'
        "[[ $(complete -p toile) == *'-F _toile_complete toile' ]] || exit 9\n"
        f"COMP_LINE={shlex.quote(line)} COMP_POINT={len(line)}\n"
        '_toile_complete\nfor found in "${COMPREPLY[@]}"; do printf "%s|\\n" "$found"; done\n'
    )
    environment = {**os.environ, "PATH": f"{tool.parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    return [found.removesuffix("|") for found in done.stdout.splitlines()]


def test_bash(tmp_path: Path) -> None:
    """Bash breaks words at "=", so only what stands behind it is to be given; a finished word ends in " "."""
    (tmp_path / "clip (one).mp4").touch()
    assert in_bash("toile gen", tmp_path) == ["generate "]
    assert in_bash("toile fit optimization=id", tmp_path) == ["identification "]
    assert in_bash("toile fit cloth.a", tmp_path) == ["cloth.areal_density="]
    assert in_bash("toile masks video=clip", tmp_path) == [r"clip\ \(one\).mp4 "]
    assert in_bash(r"toile masks video=clip\ \(", tmp_path) == [r"clip\ \(one\).mp4 "]
    assert in_bash("toile masks video='clip (", tmp_path) == ["clip (one).mp4' "]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_other_shells_ask_for_words(toile, shell: str) -> None:
    status, out, err = toile("completion", shell)
    assert (status, err) == (0, "")
    assert out == SCRIPTS[shell]
    assert "toile completion words" in out
    status, out, err = toile("completion", "words", "fit", "optimization=tr")
    assert (status, out, err) == (0, "optimization=track\noptimization=tracking\n", "")


def test_another_shell(toile) -> None:
    status, out, err = toile("completion", "tcsh")
    assert (status, out) == (2, "")
    assert "bash, zsh, fish" in err
    assert "tcsh" in err
    assert toile("completion").out.count("completion") == 3


def test_hydras_own_completion_is_refused(toile) -> None:
    status, out, err = toile("fit", "-sc", "install=bash")
    assert (status, out) == (2, "")
    assert "toile completion bash" in err
