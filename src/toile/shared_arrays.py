"""Where processes that share work put large arrays: in memory, and not beyond their command."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

from filelock import FileLock, Timeout

_MEMORY = Path("/dev/shm")
_NAME = "toile_arrays_"
_LOCK = ".lock"


@cache
def folder_of_arrays() -> Path:
    """Folder of this process in memory, where there is such a place; it goes when the process ends.

    A process that is killed takes nothing along: what it has put there stays, gigabytes of memory that nobody
    holds, until the machine starts anew. Each folder has a lock, which ends with its process however that
    ends, so the next command sees whose are left over, and removes them.
    """
    place = _MEMORY if os.access(_MEMORY, os.W_OK) else Path(tempfile.gettempdir())
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
