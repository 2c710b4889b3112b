"""Where processes that share work put large arrays: in memory, and not beyond their command."""

from __future__ import annotations

import atexit
import itertools
import os
import shutil
import tempfile
import weakref
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

_MEMORY = Path("/dev/shm")
_ENOUGH = 2e9
"""Bytes that must be free there; a container has 64 MB of it as it comes."""
_NAME = "toile_arrays_"
_LOCK = ".lock"


@cache
def folder_of_arrays() -> Path:
    """Folder of this process in memory, where there is such a place; it goes when the process ends.

    A process that is killed takes nothing along: what it has put there stays, gigabytes of memory that nobody
    holds, until the machine starts anew. Each folder has a lock, which ends with its process however that
    ends, so the next command sees whose are left over, and removes them.
    """
    place = _MEMORY if _has_room(_MEMORY) else Path(tempfile.gettempdir())
    remove_left_over(place)
    # The lock is there, and held, before the folder that it stands for.
    handle, name = tempfile.mkstemp(_LOCK, _NAME, place)
    os.close(handle)
    lock, folder = FileLock(name), Path(name.removesuffix(_LOCK))
    lock.acquire()
    folder.mkdir()
    # Before joblib puts anything there, so after it has taken that away again.
    atexit.register(_remove, folder, lock)
    return folder


def _has_room(place: Path) -> bool:
    return os.access(place, os.W_OK) and shutil.disk_usage(place).free >= _ENOUGH


LARGE = 2**20
"""Bytes from which on an array that never changes goes to other processes by a file of its own."""

_numbers = itertools.count()
_files: dict[int, Path] = {}
"""Of arrays that are alive, by their identity."""


def never_changes(array: NDArray[Any]) -> bool:
    """Whether nobody can write to an array, through whatever it may be a view of either."""
    owner = array.base if isinstance(array.base, np.ndarray) else array
    return not array.flags.writeable and not owner.flags.writeable and owner.base is None


def file_of(array: NDArray[Any]) -> Path:
    """Where other processes find an array that never changes; it is written there once, and goes with it.

    Raises:
        ValueError: it may change.
    """
    if not never_changes(array):
        raise ValueError("an array that may change has no file of its own")
    if id(array) not in _files:
        path = new_file(".npy")
        np.save(path, array)
        _files[id(array)] = path
        weakref.finalize(array, _forget, id(array)).atexit = False
    return _files[id(array)]


def array_in(path: Path) -> NDArray[Any]:
    """The array of a file, in the memory that all processes share; nobody can write to it."""
    return np.asarray(np.load(path, mmap_mode="r"))


def new_file(suffix: str) -> Path:
    """A file that is not there yet, in the folder of this process."""
    return folder_of_arrays() / f"{next(_numbers)}{suffix}"


def _forget(identity: int) -> None:
    _files.pop(identity).unlink(missing_ok=True)


def remove_left_over(place: Path) -> None:
    """Remove folders of arrays whose process has gone."""
    for name in place.glob(f"{_NAME}*{_LOCK}"):
        lock = FileLock(name, timeout=0)
        try:
            lock.acquire()
        except (Timeout, PermissionError):
            # Somebody holds it, or it is another user's.
            continue
        _remove(name.with_suffix(""), lock)


def _remove(folder: Path, lock: FileLock) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    Path(lock.lock_file).unlink(missing_ok=True)
    lock.release()
