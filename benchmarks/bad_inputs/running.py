"""Cases, each in a folder and a process of its own, several at a time; answers that are known are kept."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from bad_inputs.case import Case
from bad_inputs.processes import start, warm_up
from bad_inputs.stock import make_stock
from bad_inputs.verdict import Answer, Kind, Verdict, judge, message, plain

DISK = "disk"
_READ_ONLY = 64 * 1024 * 1024  # bytes of a disk that is only there to be read-only


@dataclass(frozen=True)
class Result:
    """A case that was run.

    Attributes:
        key: see ``key_of``.
        group: of the case.
        wrong: what is wrong.
        command: as typed.
        status: of the exit; None: no end.
        said: first lines of the message.
        kind: of the verdict.
        why: it is not better.
        seconds: of the command.
    """

    key: str
    group: str
    wrong: str
    command: str
    status: int | None
    said: tuple[str, ...]
    kind: Kind
    why: str
    seconds: float


def key_of(case: Case) -> str:
    """Name of a case's files."""
    return hashlib.sha256(f"{case.group}/{case.wrong}/{case.arguments}".encode()).hexdigest()[:12]


def fingerprint(folders: Sequence[Path]) -> str:
    """Of all that answers depend on: results of other code are not kept."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix in {".py", ".yaml", ".json", ".pt"} and path.name != "page.py":
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def run_all(
    cases: Sequence[Case], work: Path, code: str, workers: int, report: Callable[[Result], None]
) -> list[Result]:
    """Run what has no result yet; results in the order of the cases.

    Args:
        cases: to run.
        work: folder for the stock, the results and the cases' folders.
        code: fingerprint of the code.
        workers: cases at a time.
        report: called with every new result.
    """
    results = work / f"results-{code}"
    results.mkdir(parents=True, exist_ok=True)
    todo = [case for case in cases if not (results / f"{key_of(case)}.json").is_file()]
    if todo:
        warm_up()
        make_stock(work / f"stock-{code}")
    running: dict[int, Case] = {}
    while todo or running:
        while todo and len(running) < workers:
            case = todo.pop(0)
            pid = os.fork()
            if pid == 0:
                _work(case, work, code, results)
            running[pid] = case
        pid, _ = os.wait()
        if pid in running:
            path = results / f"{key_of(running.pop(pid))}.json"
            if path.is_file():
                report(_read(path))
    missing = [case.wrong for case in cases if not (results / f"{key_of(case)}.json").is_file()]
    if missing:
        raise RuntimeError(f"no result of: {', '.join(missing)}; see above")
    return [_read(results / f"{key_of(case)}.json") for case in cases]


def run_case(case: Case, stock: Path, folder: Path) -> Result:
    """Run one case in a folder that does not exist yet."""
    shutil.copytree(stock, folder, symlinks=True)
    logs = folder.with_name(f"{folder.name}-logs")
    logs.mkdir(parents=True, exist_ok=True)
    answer = Answer(None, "", "", 0.0)
    with _disk(case, folder) as largest_file:
        verdict = _before(case, folder, logs)
        if verdict is None:
            case.prepare(folder)
            if case.read_only:
                subprocess.run(["mount", "-o", "remount,ro", folder / DISK], check=True)
            kept = _contents(case, folder)
            answer, besides = _answer(case, folder, logs, largest_file)
            verdict = besides or judge(case, answer, folder)
            changed = [name for name, data in kept.items() if _bytes(folder / name) != data]
            if verdict.kind != "bad" and changed:
                verdict = Verdict("bad", f"changed or lost: {', '.join(changed)}")
            if verdict.kind != "bad":
                verdict = _afterwards(case, folder, logs) or verdict
    return Result(
        key_of(case),
        case.group,
        case.wrong,
        _typed(case),
        answer.status,
        _first_lines(message(answer), folder),
        verdict.kind,
        verdict.why,
        round(answer.seconds, 1),
    )


def _work(case: Case, work: Path, code: str, results: Path) -> None:
    """Be the process of one case; never returns."""
    folder = work / f"cases-{code}" / key_of(case)
    try:
        shutil.rmtree(folder, ignore_errors=True)
        result = run_case(case, work / f"stock-{code}", folder)
        path = results / f"{key_of(case)}.json"
        path.with_suffix(".new").write_text(json.dumps(asdict(result)))
        path.with_suffix(".new").rename(path)
        if result.kind != "bad":  # of the others one wants to see more
            shutil.rmtree(folder, ignore_errors=True)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(0)


def _answer(case: Case, folder: Path, logs: Path, largest_file: int | None) -> tuple[Answer, Verdict | None]:
    environment = {"TOILE_DATA": "", "HYDRA_FULL_ERROR": "", "COLUMNS": "160", **case.environment}
    other = None
    if case.beside:
        other = start(case.beside, folder, logs / "beside", environment, process=False)
        until = time.monotonic() + 60
        while not any(folder.glob(case.ready)) and not other.has_ended() and time.monotonic() < until:
            time.sleep(0.005)
    answer = start(
        case.arguments,
        folder,
        logs / "command",
        environment,
        process=case.process,
        largest_file=largest_file,
    ).wait(case.at_most)
    if other is None:
        return answer, None
    overtaken = other.has_ended()
    beside = other.wait(case.at_most)
    if beside.status != 0:
        return answer, Verdict("bad", f"the command beside it ended with {beside.status}")
    # Otherwise there was nothing to disturb.
    return answer, Verdict("bad", "the command beside it ended first") if overtaken else None


def _before(case: Case, folder: Path, logs: Path) -> Verdict | None:
    if not case.before:
        return None
    answer = start(case.before, folder, logs / "before", {"TOILE_DATA": ""}, process=False).wait(case.at_most)
    return None if answer.status == 0 else Verdict("bad", f"toile {case.before[0]} failed before")


def _afterwards(case: Case, folder: Path, logs: Path) -> Verdict | None:
    for k, arguments in enumerate(case.then):
        log = logs / f"then{k}"
        answer = start(arguments, folder, log, {"TOILE_DATA": ""}, process=False).wait(case.at_most)
        if answer.status != 0:
            typed = " ".join(arguments)
            said = (*message(answer).splitlines(), "")[0]
            return Verdict("bad", f"afterwards, toile {typed} ends with {answer.status}: {said}")
    return None


@contextmanager
def _disk(case: Case, folder: Path) -> Iterator[int | None]:
    """A small file system, or a read-only one; where none can be made, the largest size of a file instead."""
    size = _READ_ONLY if case.read_only else case.disk
    if size is None:
        yield None
        return
    disk = folder / DISK
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", disk]
    if subprocess.run(mount, check=False, capture_output=True).returncode != 0:
        if case.read_only:
            raise RuntimeError("this needs the right to mount a file system")
        yield size
        return
    try:
        yield None
    finally:
        # Somebody may still be leaving.
        for _ in range(20):
            if subprocess.run(["umount", disk], check=False, capture_output=True).returncode == 0:
                break
            time.sleep(0.1)


def _contents(case: Case, folder: Path) -> dict[str, bytes]:
    kept = {}
    for pattern in case.keeps:
        found = [p for p in folder.glob(pattern) if p.is_file()]
        if not found:
            raise RuntimeError(f"{case.wrong}: nothing to keep, {pattern}")
        kept |= {str(p.relative_to(folder)): p.read_bytes() for p in found}
    return kept


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _typed(case: Case) -> str:
    words = [f'"{a}"' if any(c in a for c in " '()[]{}*?$") else a for a in case.arguments]
    variables = [f"{name}={value}" for name, value in case.environment.items()]
    return " ".join((*variables, "toile", *words))


def _first_lines(text: str, folder: Path) -> tuple[str, ...]:
    """Without what differs from machine to machine."""
    lines = [line.replace(f"{folder}/", "").replace(str(folder), ".") for line in plain(text).splitlines()]
    lines = [" ".join(line.split()) for line in lines if line.strip()]
    if any(line.startswith("Traceback") for line in lines):
        lines = ["Traceback …", lines[-1]]
    return tuple(line if len(line) <= 160 else f"{line[:159]}…" for line in lines[:3])


def _read(path: Path) -> Result:
    values = json.loads(path.read_text())
    return Result(**{**values, "said": tuple(values["said"])})
