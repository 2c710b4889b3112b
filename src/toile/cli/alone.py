"""One run folder, one process."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout
from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.cli.configuration import output_folder
from toile.errors import InputError

T = TypeVar("T")

LOCK = ".lock"
"""File in a run folder that is locked while a process works there; the system frees it when that one ends."""
HOLDER = ".process"
"""Which process that is; means something only while the lock is held."""


class FolderInUseError(InputError):
    """Another process works in the run folder."""


class OtherSettingsError(InputError):
    """A folder holds a run with other settings, which says nothing against that run."""


def alone(run: Callable[[DictConfig], T]) -> Callable[[DictConfig], T]:
    """Let a command have its output folder for itself; a second one in the same folder is refused."""

    @wraps(run)
    def only(cfg: DictConfig) -> T:
        from lightning.pytorch.utilities import rank_zero_only  # heavy, and asked for in a run only

        # Lightning starts the further processes of a training by the same command: they belong to the first.
        if getattr(rank_zero_only, "rank", 0) != 0:
            return run(cfg)
        with alone_in(output_folder()):
            return run(cfg)

    return only


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder.

    What a process that was killed has left behind keeps nobody out, and says nothing about a run.

    Raises:
        FolderInUseError: another process is in there; it is named.
    """
    folder.mkdir(parents=True, exist_ok=True)
    holder = folder / HOLDER
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise FolderInUseError(
            "Another process works in this folder",
            where=str(folder),
            expected="to wait until it has ended, or another folder (hydra.run.dir=...)",
            got=_read(holder),
        ) from None
    try:
        write_text(holder, f"process {os.getpid()} on {socket.gethostname()}\n")
        yield
    finally:
        holder.unlink(missing_ok=True)
        lock.release()


def _read(holder: Path) -> str:
    try:
        return holder.read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        # In the moment between lock and note.
        return "a process that has just begun"
