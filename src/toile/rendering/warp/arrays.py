"""Bridge between torch tensors and Warp kernels: zero-copy arrays, and launches on torch's stream."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import warp as wp
from torch import Tensor


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


def share(tensor: Tensor, dtype: Any) -> Any:
    """View a contiguous tensor as a flat Warp array of ``dtype`` items, without copying."""
    length = wp.types.type_size(dtype)
    flat = tensor.detach().view(-1) if length == 1 else tensor.detach().view(-1, length)
    return wp.from_torch(flat, dtype=dtype, return_ctype=True)


def launch(kernel: Any, dim: tuple[int, ...], inputs: list[Any], device: torch.device) -> None:
    """Run ``kernel`` on torch's device, in order with torch's own work there."""
    if 0 in dim:
        return
    if device.type == "cuda":
        stream = wp.stream_from_torch(torch.cuda.current_stream(device))
        wp.launch(kernel, dim=dim, inputs=inputs, stream=stream)
    else:
        wp.launch(kernel, dim=dim, inputs=inputs, device="cpu")


def span(width: int, device: torch.device) -> int:
    """Pixels of a row that one thread handles.

    The per-pixel kernels set a face up once per run of pixels that show it. One core gains from whole
    rows; a GPU gains more from many threads.
    """
    return min(width, 4) if device.type == "cuda" else width
