"""NVIDIA Warp: quiet start, and NumPy arrays as kernel arguments without copying."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray


def start_warp() -> None:
    """Initialise Warp without its banner; on a machine without a GPU, also without the warning about that."""
    level = wp.config.log_level
    wp.config.log_level = wp.LOG_ERROR
    if torch.cuda.is_available():
        wp.init()
    else:
        with _native_stderr_silenced():
            wp.init()
    # Warnings yes; progress of kernel compilation no.
    wp.config.log_level = max(level, wp.LOG_WARNING)


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
