"""Bridge between torch tensors and Warp kernels: zero-copy arrays, and launches on torch's stream."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor


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
