"""Folders that appear only when they are complete."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from toile.atomic_file import disk_failures_name
from toile.errors import InputError


@contextmanager
def folder_written_atomically(folder: Path, *, overwrite: bool) -> Iterator[Path]:
    """Path beside ``folder`` to write to; renamed to ``folder`` at the end, gone if anything fails.

    Raises:
        InputError: the folder exists and ``overwrite`` is False.
    """
    if folder.exists() and not overwrite:
        raise InputError(
            "Scene folder exists already",
            where=str(folder),
            expected="a folder that does not exist, or overwrite=True",
            got="an existing file or folder",
        )
    with _scratch(folder) as scratch:
        new = scratch / "new"
        yield new
        if folder.exists():
            folder.rename(scratch / "old")
        new.rename(folder)


@contextmanager
def entries_written_atomically(folder: Path, names: Sequence[str], *, overwrite: bool) -> Iterator[Path]:
    """Folder beside ``folder`` to write to; what is in it moves to ``folder`` at the end, all or nothing.

    Everything else in ``folder`` stays, and so does everything if anything fails.

    Args:
        folder: target; it need not exist.
        names: files and folders that may be written; those of an earlier run go, written again or not.
        overwrite: whether there may be such.

    Raises:
        InputError: one of them exists and ``overwrite`` is False.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("No folder", where=str(folder), expected="a folder, or nothing", got="a file")
    there = [name for name in names if (folder / name).exists()]
    if there and not overwrite:
        raise InputError(
            "Folder holds an earlier result",
            where=str(folder),
            expected="another folder, or overwrite=true",
            got=", ".join(there),
        )
    with _scratch(folder) as scratch:
        new, old = scratch / "new", scratch / "old"
        new.mkdir()
        old.mkdir()
        yield new
        folder.mkdir(exist_ok=True)
        _exchange(folder, new, old, names)


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A folder beside another one, gone at the end; a full disk names the other one."""
    with disk_failures_name(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            yield scratch
        finally:
            shutil.rmtree(scratch)


def _exchange(folder: Path, new: Path, old: Path, names: Sequence[str]) -> None:
    """Move ``names`` of ``folder`` to ``old``, those of ``new`` to ``folder``; undone if anything fails."""
    moves = [(folder / name, old / name) for name in names] + [(new / name, folder / name) for name in names]
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            if source.exists():
                source.rename(target)
                done.append((source, target))
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise
