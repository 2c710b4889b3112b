"""Numbers below the smallest normal one count as zero, where they only cost time.

What moves one vertex hardly moves those far away: tangents of a cloth, and splines through its vertices,
decay by a factor every few vertices and end among the denormal numbers of single precision, which processors
multiply a hundred times more slowly than others. They are 1e-38 of a metre.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

_DENORMAL = np.float32(1e-40)


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Count denormal numbers as zero in this thread, where the processor can; as before afterwards."""
    before = flushing()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def flushing() -> bool:
    """Whether they count as zero in this thread."""
    return bool(_DENORMAL * np.float32(0.5) == 0)
