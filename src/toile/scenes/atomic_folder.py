"""Folders that appear only when they are complete."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        new = scratch / "new"
        yield new
        if folder.exists():
            folder.rename(scratch / "old")
        new.rename(folder)
    finally:
        shutil.rmtree(scratch)
