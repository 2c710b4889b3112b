"""Running a diagnosis over a blind set in processes that cannot read its labels.

Two walls. The labels are encrypted and the key is elsewhere (see blind_sealing). And the diagnosis runs in
child processes in which every attempt to open or list a sealed label, a key or a grade fails, whoever owns
the process: Python tells its audit hooks of every file that it opens, and a hook cannot be taken back.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from toile.atomic_file import write_text
from toile.blind.answers import read_answer
from toile.blind.sealing import KEY_SUFFIX, BlindSet, is_key_file
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport
from toile.diagnosis.stage_times import TIMES_FILE, read_times
from toile.errors import InputError
from toile.json_file import parse_json_object
from toile.workers import end_with_parent

SECONDS_FILE = "seconds.txt"
"""Time that a diagnosis took, beside it."""

Diagnose = Callable[[Path, Path, Any], None]
"""Writes diagnosis.json for a scene: ``diagnose(scene_folder, output_folder, settings)``."""

_WATCHED = {"open", "os.listdir", "os.scandir", "os.rename", "os.link", "os.symlink", "shutil.copyfile"}


@dataclass(frozen=True)
class Predictions:
    """Places of what a diagnosis has answered for a set.

    Attributes:
        folder: of the answers, outside the set.
    """

    folder: Path

    def diagnosis(self, name: str) -> Path:
        """diagnosis.json of one scene."""
        return self.folder / name / DIAGNOSIS_FILE

    def seconds(self, name: str) -> float | None:
        """Time that the diagnosis of one scene took [s], None where it is not known."""
        try:
            return float((self.folder / name / SECONDS_FILE).read_text())
        except (OSError, ValueError):
            return None

    def failure(self, name: str) -> Path:
        """Why a scene has none."""
        return self.folder / name / "failure.txt"

    @property
    def list(self) -> Path:
        """All verdicts and the hashes of all files."""
        return self.folder / "predictions.json"

    @property
    def hash(self) -> Path:
        """Hash of the list, written before any label is opened."""
        return self.folder / "predictions.sha256"

    @property
    def grade(self) -> Path:
        """What grading has found; from then on the set is spent."""
        return self.folder / "grade"


def run_blind(
    blind: BlindSet,
    predictions: Predictions,
    diagnose: Diagnose,
    settings: Any = None,
    *,
    jobs: int = 1,
    only: tuple[str, ...] | None = None,
    report: Callable[[str, int, int, str | None], None] | None = None,
) -> list[str]:
    """Diagnose every scene that has no diagnosis yet, each in a guarded process.

    Args:
        blind: the set; only ``scenes/`` is read.
        predictions: where the answers go.
        diagnose: importable by name; called in child processes.
        settings: third argument of ``diagnose``; can be pickled.
        jobs: processes at a time; -1 for one per core.
        only: names of a part of the set; None for all.
        report: called with (name, number done, number to do, failure or None) after every scene.

    Returns:
        Names without a diagnosis.

    Raises:
        InputError: labels lie open, a key is within reach, or the set is graded already.
    """
    check_sealed(blind)
    check_not_graded(blind, predictions)
    names = blind.names() if only is None else only
    missing = [name for name in names if not blind.is_there(name)]
    if missing:
        raise InputError(
            "The set is not complete",
            where=str(blind.scenes),
            expected="all scenes; toile blind make makes what is missing",
            got=f"without {', '.join(missing[:10])}",
        )
    todo = [name for name in names if not _is_answered(predictions, name)]
    workers = max(1, min(len(todo), (os.cpu_count() or 1) if jobs < 0 else jobs))
    if todo:
        # Spawned, not forked: a child starts without anything that this process has read.
        pool = ProcessPoolExecutor(
            workers,
            mp_context=get_context("spawn"),
            initializer=_begin,
            initargs=(str(blind.folder.resolve()), str(predictions.grade.resolve())),
        )
        with pool, _stopped_at_once(pool):
            running = {
                pool.submit(
                    _diagnose_one,
                    diagnose,
                    str((blind.scenes / name).resolve()),
                    str((predictions.folder / name).resolve()),
                    settings,
                ): name
                for name in todo
            }
            for done, future in enumerate(as_completed(running), 1):
                failure = future.result()
                if report is not None:
                    report(running[future], done, len(todo), failure)
    return [name for name in names if not _is_answered(predictions, name)]


def write_predictions(blind: BlindSet, predictions: Predictions, *, incomplete: bool = False) -> str:
    """Write all verdicts with the hashes of their files, and the hash of this list.

    Args:
        blind: the set.
        predictions: of all its scenes.
        incomplete: whether scenes may lack a diagnosis; they count as wrong.

    Returns:
        The hash.

    Raises:
        InputError: a scene has no diagnosis, one cannot be understood, or the set is graded already.
    """
    check_not_graded(blind, predictions)
    entries: dict[str, Any] = {}
    for name in blind.names():
        path = predictions.diagnosis(name)
        if not path.is_file():
            if incomplete:
                entries[name] = None
                continue
            raise InputError(
                f"Scene {name} has no diagnosis",
                where=str(predictions.folder),
                expected="one of every scene; the same command makes what is missing",
                got="see failure.txt" if predictions.failure(name).is_file() else "none",
            )
        report = read_answer(path).report
        beside = {
            str(file): _hash_of((path.parent / file).read_bytes())
            for file in (report.where.vertices, report.where.acts_on, SECONDS_FILE)
            if file and (path.parent / file).is_file()
        }
        verdict = report.to_json()["verdict"]
        entries[name] = {"verdict": verdict, "sha256": _hash_of(path.read_bytes()), "beside": beside}
    text = json.dumps({"predictions": entries}, indent=1, sort_keys=True) + "\n"
    digest = _hash_of(text.encode())
    write_text(predictions.list, text)
    write_text(predictions.hash, digest + "\n")
    return digest


def read_predictions(blind: BlindSet, predictions: Predictions) -> dict[str, GapReport | None]:
    """All answers, after a check that nothing has changed since they were hashed.

    Raises:
        InputError: the list or a file has changed, or scenes are missing from it.
    """
    try:
        text, digest = predictions.list.read_text(), predictions.hash.read_text().strip()
    except (OSError, ValueError) as error:
        raise InputError(
            "No predictions",
            where=str(predictions.folder),
            expected="predictions.json and predictions.sha256 from toile blind run",
            got=str(error),
        ) from error
    if _hash_of(text.encode()) != digest:
        raise _changed(predictions.list, digest, _hash_of(text.encode()))
    entries = _entries(text, predictions.list)
    if set(entries) != set(blind.names()):
        raise _changed(predictions.list, f"{len(blind.names())} scenes of this set", f"{len(entries)} others")
    found: dict[str, GapReport | None] = {}
    for name, entry in entries.items():
        path = predictions.diagnosis(name)
        if entry is None:
            if path.is_file():
                raise _changed(path, "no file: it was not answered when answers were hashed", "a diagnosis")
            found[name] = None
            continue
        got = _hash_of(path.read_bytes()) if path.is_file() else "no file"
        if got != entry["sha256"]:
            raise _changed(path, entry["sha256"], got)
        for file, known in entry.get("beside", {}).items():
            other = path.parent / file
            got = _hash_of(other.read_bytes()) if other.is_file() else "no file"
            if got != known:
                raise _changed(other, known, got)
        found[name] = read_answer(path).report
    return found


def _entries(text: str, path: Path) -> dict[str, Any]:
    try:
        entries = parse_json_object(text.encode())["predictions"]
        if not isinstance(entries, dict) or not all(e is None or "sha256" in e for e in entries.values()):
            raise ValueError("other than one entry per scene")
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            "Predictions cannot be understood",
            where=str(path),
            expected="predictions.json as toile blind run has written it",
            got=f"{type(error).__name__}: {error}",
        ) from error
    return entries


def check_sealed(blind: BlindSet) -> None:
    """Refuse a set whose labels could be read.

    Raises:
        InputError: a label or truth lies open in it, or a key lies in it or beside it.
    """
    blind.read_description()
    for path in sorted(blind.folder.rglob("*")):
        inside = path.relative_to(blind.folder)
        if path.is_dir():
            if path.name == "ground_truth":
                raise _open_label(path)
            continue
        if inside.parts[0] == "sealed" and path.suffix != ".sealed":
            raise _open_label(path)
        if path.name.startswith(("label", "truth")) or is_key_file(path):
            raise _open_label(path)
    # Beside it only what is called a key: reading strangers' files is none of our business.
    for path in sorted(blind.folder.resolve().parent.glob(f"*{KEY_SUFFIX}")):
        raise _open_label(path)


def check_not_graded(blind: BlindSet, predictions: Predictions) -> None:
    """Refuse to answer once labels have been opened; a set for development may be answered again.

    Raises:
        InputError: there is a grade.
    """
    if blind.read_description()["blind"] and (predictions.grade.exists() or blind.spent.exists()):
        raise InputError(
            "The labels of this set have been opened",
            where=str(blind.spent),
            expected="a set that has not been graded; a blind set serves once",
            got="a grade",
        )


def forbid_reading_labels(set_folder: str, grade_folder: str) -> None:
    """Make every later attempt of this process to open a label, key or grade a PermissionError, for good."""
    sealed = os.path.realpath(os.path.join(set_folder, "sealed"))
    commitments = os.path.realpath(os.path.join(set_folder, "commitments.json"))
    forbidden = (sealed, commitments, os.path.realpath(grade_folder))
    busy = False

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal busy
        if event not in _WATCHED or busy:
            return
        busy = True  # realpath lists and reads links itself
        try:
            for argument in arguments[:2]:
                if not isinstance(argument, str | bytes | os.PathLike):
                    continue
                path = os.path.realpath(os.fsdecode(argument))
                below = any(path == f or path.startswith(f + os.sep) for f in forbidden)
                if below or path.endswith(KEY_SUFFIX):
                    raise PermissionError(f"a blind diagnosis may not read {path}")
        finally:
            busy = False

    sys.addaudithook(hook)


def _begin(set_folder: str, grade_folder: str) -> None:
    """In a child process, first of all."""
    end_with_parent()
    forbid_reading_labels(set_folder, grade_folder)


def _diagnose_one(diagnose: Diagnose, scene: str, output: str, settings: Any) -> str | None:
    """In a child process; returns why there is no diagnosis, or None."""
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    note = folder / "failure.txt"
    note.unlink(missing_ok=True)
    try:
        begin = time.perf_counter()
        diagnose(Path(scene), folder, settings)
        read_answer(folder / DIAGNOSIS_FILE)
        seconds = time.perf_counter() - begin + _of_earlier_attempts(folder)
        write_text(folder / SECONDS_FILE, f"{seconds:.1f}\n")
    except Exception as error:
        write_text(note, "".join(traceback.format_exception(error)))
        return f"{type(error).__name__}: {error}"
    return None


def _of_earlier_attempts(folder: Path) -> float:
    """What stages took that an interrupted attempt has made, and this one has read [s]."""
    path = folder / TIMES_FILE
    made = read_times(path).values() if path.is_file() else ()
    return sum(stage.wall for stage in made if stage.cached and stage.wall is not None)


def _is_answered(predictions: Predictions, name: str) -> bool:
    try:
        read_answer(predictions.diagnosis(name))
    except InputError:
        return False
    return True


@contextmanager
def _stopped_at_once(pool: ProcessPoolExecutor) -> Iterator[None]:
    """Drop what has not begun when interrupted."""
    try:
        yield
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise


def _hash_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _changed(path: Path, expected: str, got: str) -> InputError:
    return InputError(
        "Predictions have changed since they were hashed", where=str(path), expected=expected, got=got
    )


def _open_label(path: Path) -> InputError:
    return InputError(
        "Labels are within reach of the diagnosis",
        where=str(path),
        expected="sealed labels, and the key in another folder than the set's",
        got="an open label, a truth or a key",
    )
