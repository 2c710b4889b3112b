"""The judge of bad inputs can say "bad", and the page shows it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
REFUSED = "error: No such scene\n  where:    nowhere\n"


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    """benchmarks/bad_inputs."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from bad_inputs import case, page, processes, running, verdict

    yield SimpleNamespace(case=case, page=page, processes=processes, running=running, verdict=verdict)
    for name in [name for name in sys.modules if name.split(".")[0] == "bad_inputs"]:
        del sys.modules[name]


def judged(tools: SimpleNamespace, folder: Path, status: int | None, err: str, **changes: object) -> str:
    case = tools.case.Case("group", "what", ("fit", "scene=nowhere"), says=("nowhere",))
    answer = tools.verdict.Answer(status, "", err, 1.0)
    verdict = tools.verdict.judge(replace(case, **changes), answer, folder)
    return f"{verdict.kind}: {verdict.why}".rstrip(": ")


def test_refusals(tools: SimpleNamespace, tmp_path: Path) -> None:
    assert judged(tools, tmp_path, 2, REFUSED) == "good"
    assert judged(tools, tmp_path, 2, "") == "bad: not a word"
    assert (
        judged(tools, tmp_path, 2, "error: something is wrong\n") == "bad: the message does not say “nowhere”"
    )
    assert judged(tools, tmp_path, 2, REFUSED + "more\n" * 40) == "bad: 42 lines"
    traceback = "Traceback (most recent call last):\nValueError: nowhere\n"
    assert judged(tools, tmp_path, 1, traceback) == "bad: traceback"
    assert (
        judged(tools, tmp_path, 2, f"Exception in thread Thread-1:\n{traceback}{REFUSED}") == "bad: traceback"
    )
    assert judged(tools, tmp_path, -11, REFUSED) == "bad: ended by signal 11"
    assert judged(tools, tmp_path, None, REFUSED) == "bad: no end within 120 s"
    assert judged(tools, tmp_path, 2, REFUSED, want=tools.case.Want.SUCCESS).startswith("bad")


def test_what_goes_on_must_warn_everywhere(tools: SimpleNamespace, tmp_path: Path) -> None:
    warning = "warning: nowhere is odd\n"
    assert judged(tools, tmp_path, 0, "done\n").startswith("bad: silent")
    assert judged(tools, tmp_path, 0, "cloth from nowhere\n").startswith("bad: silent")
    assert judged(tools, tmp_path, 0, warning) == "bad: the warning is not in the log nor in the page"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "fit.log").write_text(warning)
    (tmp_path / "run" / "index.html").write_text("<p>fine</p>")
    assert judged(tools, tmp_path, 0, warning) == "bad: the warning is not in the page"
    (tmp_path / "run" / "index.html").write_text("<p>nowhere is odd</p>")
    assert judged(tools, tmp_path, 0, warning) == "warned"
    (tmp_path / "run" / "index.html").unlink()
    assert judged(tools, tmp_path, 0, warning, harmless=True) == "warned"
    remark = "/a/nowhere.py:41: RuntimeWarning: invalid value\n  down = gravity / nowhere\n"
    assert judged(tools, tmp_path, 0, remark).startswith("bad: silent")
    assert judged(tools, tmp_path, 0, warning, want=tools.case.Want.REFUSAL) == "bad: exit status 0"


def test_success_must_leave_something(tools: SimpleNamespace, tmp_path: Path) -> None:
    asked = {"want": tools.case.Want.SUCCESS, "leaves": ("run/index.html",)}
    assert judged(tools, tmp_path, 0, "", **asked) == "bad: left no run/index.html"
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "index.html").touch()
    assert judged(tools, tmp_path, 0, "", **asked) == "good"


CASES = {
    "traceback": ("fit", ("x",), "bad: traceback"),
    "silent": ("evaluate", ("x",), "bad: silent: exit status 0 and no warning"),
    "refused": ("report", ("no such",), "good"),
    "lost": ("export", ("no such",), "bad: changed or lost: kept.txt"),
    "endless": ("train", ("x",), "bad: no end within 2 s"),
}


def commands(arguments: list[str]) -> int:
    """Stands for toile: every command answers in another way."""
    import time

    match arguments[0]:
        case "fit":
            raise ValueError("x")
        case "report":
            print("error: no such run", file=sys.stderr)
            return 2
        case "export":
            Path("kept.txt").write_text("other")
            print("error: no such run", file=sys.stderr)
            return 2
        case "train":
            time.sleep(60)
    return 0


@pytest.mark.parametrize("name", CASES)
def test_whole_cases(
    tools: SimpleNamespace, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a process, from the copy of the stock to the row of the table."""
    command, says, expected = CASES[name]
    (tmp_path / "stock").mkdir()
    (tmp_path / "stock" / "kept.txt").write_text("content")
    monkeypatch.setattr("toile.cli.main.main", commands)
    case = tools.case.Case("group", name, (command, "a=b c"), says=says, keeps=("kept.txt",), at_most=2.0)
    result = tools.running.run_case(case, tmp_path / "stock", tmp_path / "case")
    assert f"{result.kind}: {result.why}".rstrip(": ") == expected
    assert result.command == f'toile {command} "a=b c"'
    text = tools.page.page([result, replace(result, kind="good", why="")], "a machine", "1.0")
    assert ("## Bad" in text) == (result.kind == "bad")
    assert "toile 1.0, a machine" in text
    assert ("1 good, 0 warned, 1 bad; 50.0 %" in text) == (result.kind == "bad")


def test_every_case_is_told_apart(tools: SimpleNamespace) -> None:
    from bad_inputs.cases import CASES as ALL

    assert len({tools.running.key_of(case) for case in ALL}) == len(ALL) >= 85
    commands = {case.arguments[0] for case in ALL}
    from toile.cli.commands import COMMANDS

    assert commands >= set(COMMANDS)
    # A complaint that need not name anything would not be a clear one.
    vague = [c.wrong for c in ALL if c.want is not tools.case.Want.SUCCESS and not c.says]
    assert vague == []
