"""Files that are either complete or not there."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}


@contextmanager
def written_atomically(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` (same suffix); rename it to ``path`` when the block succeeds.

    After an exception ``path`` is as it was before and the temporary file is gone.

    Raises:
        OSError: the disk is full or cannot be written to; it names ``path``, whatever the writer raised.
    """
    with disk_failures_name(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            # mkstemp makes files private; give the result the mode any other file would get.
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def disk_failures_name(path: Path) -> Iterator[None]:
    """Let a failure of the disk say what was being written.

    Encoders and archives raise such errors without a file name, or raise another one while they clean up.

    Raises:
        OSError: instead of any exception that has a failure of the disk behind it.
    """
    try:
        yield
    except Exception as error:
        failure = disk_failure(error)
        if failure is None or failure.errno is None:
            raise
        raise OSError(failure.errno, os.strerror(failure.errno), str(path)) from error


def disk_failure(error: BaseException | None) -> OSError | None:
    """The failure of a disk (full, read-only, defect) behind an exception; None where there is none."""
    seen: set[int] = set()
    # An exception that is raised again while another one is handled can stand in its own chain.
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno in _DISK:
            return error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return None


def write_text(path: Path, text: str) -> Path:
    """Write UTF-8 text atomically; returns ``path``."""
    with written_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path
