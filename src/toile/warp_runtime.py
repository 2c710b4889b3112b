"""NVIDIA Warp: quiet start, and NumPy arrays as kernel arguments without copying."""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

_CACHE_VARIABLE = "WARP_CACHE_PATH"
_PROBE = 64 * 1024  # bytes; a full disk still takes an empty file

_log = logging.getLogger(__name__)
_started: list[bool] = []


def start_warp() -> None:
    """Initialise Warp without its banner; on a machine without a GPU, also without the warning about that.

    Where the folder of its compiled kernels cannot be written to, a temporary one takes its place, with a
    warning. Calling this again does nothing.
    """
    if _started:
        return
    level = wp.config.log_level
    wp.config.log_level = wp.LOG_ERROR
    usual: Path | None = None
    try:
        _init()
        usual = Path(str(wp.config.kernel_cache_dir))
        # Warp itself would find out in the middle of a fit, and with one of several exceptions.
        _require_room(usual)
    except OSError as error:
        _use_temporary_cache(usual, f"{error.strerror}: {error.filename or usual}")
        _init()
    # Warnings yes; progress of kernel compilation no.
    wp.config.log_level = max(level, wp.LOG_WARNING)
    _started.append(True)


def _init() -> None:
    if torch.cuda.is_available():
        wp.init()
    else:
        with _native_stderr_silenced():
            wp.init()


def _require_room(folder: Path) -> None:
    with tempfile.TemporaryFile(dir=folder) as probe:
        probe.write(bytes(_PROBE))


def _use_temporary_cache(usual: Path | None, reason: str) -> None:
    """A folder for compiled kernels that goes with this process; processes that it starts share it.

    Args:
        usual: the folder that Warp has chosen, whose kernels are taken over; None where it could not start.
        reason: what is wrong with it.
    """
    folder = tempfile.mkdtemp(prefix="toile-kernels-")
    # Where Warp looks if it is given the folder from the start.
    cache = Path(folder) / wp.config.version
    cache.mkdir()
    for kernels in [] if usual is None else usual.glob("wp_toile*"):
        shutil.copytree(kernels, cache / kernels.name)
    owner = os.getpid()
    # A forked child has this function, too.
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    os.environ[_CACHE_VARIABLE] = folder
    wp.config.kernel_cache_dir = folder if usual is None else str(cache)
    _log.warning(
        "warning: compiled kernels cannot be kept (%s), so this command compiles anew what is not there; "
        "let %s name a folder that can be written to",
        reason,
        _CACHE_VARIABLE,
    )


@contextmanager
def _native_stderr_silenced() -> Iterator[None]:
    """Send file descriptor 2 to nowhere: Warp's native library prints there, past sys.stderr."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def view(array: NDArray[np.generic], dtype: Any) -> Any:
    """View a C-contiguous NumPy array as a Warp array on the CPU whose items are of ``dtype``.

    The trailing axes that make up one item disappear: (n, N, 3) seen as vec3d has shape (n, N).
    """
    if not array.flags.c_contiguous:
        raise ValueError("expected a C-contiguous array, got one with strides " + str(array.strides))
    item_axes = len(getattr(dtype, "_shape_", ()))
    shape = array.shape[: array.ndim - item_axes]
    shared: Any = wp.array(ptr=array.ctypes.data, dtype=dtype, shape=shape, device="cpu")
    shared.memory = array  # the view must not outlive its memory
    return shared
