"""Independent steps and windows of one layer in processes, with the digits of one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import torch
from joblib.externals.loky import ProcessPoolExecutor
from torch import Tensor

from toile.capture.layer.layer import LayerStep, SimulationLayer

T = TypeVar("T")
R = TypeVar("R")


class LayerWorkers:
    """Processes that hold a copy of a layer each, with one thread; to be used in a ``with``.

    Digits are those of this process where its BLAS has one thread too, which it takes from OMP_NUM_THREADS
    and OPENBLAS_NUM_THREADS when it is loaded; ``toile`` and ``make`` set both to 1. With more, sums in the
    factor of the matrix come in another order.

    A copy is made when the first work comes: some seconds, for imports and for the pattern of the matrix.

    Args:
        layer: whose steps are asked for.
        count: of processes; with one, everything happens in this one.
    """

    def __init__(self, layer: SimulationLayer, count: int = 1) -> None:
        if count < 1:
            raise ValueError(f"count: expected a number of processes from 1 on, got {count}")
        self.layer, self.count = layer, count
        self._pool: Any = None

    def __enter__(self) -> LayerWorkers:
        """The processes are kept until the end of the block."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let them go."""
        self.close()

    def close(self) -> None:
        """Let the processes go; further work starts others."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=True)
            self._pool = None

    def map(self, task: Callable[[SimulationLayer, T], R], items: Sequence[T]) -> list[R]:
        """Results in the order of the items.

        Args:
            task: of the layer and one item; it, the item and the result go from process to process where
                there are several, and so have no gradients.
            items: independent of one another.
        """
        if self.count == 1 or len(items) < 2:
            return [task(self.layer, item) for item in items]
        if self._pool is None:
            threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
            self._pool = ProcessPoolExecutor(
                self.count, initializer=_keep, initargs=(self.layer,), env=threads, timeout=None
            )
        waiting = [self._pool.submit(_with_kept, task, item) for item in items]
        return [future.result() for future in waiting]

    def step_batch(
        self, positions: Tensor, velocities: Tensor, bodies: Tensor, next_bodies: Tensor, time_step: float
    ) -> list[LayerStep]:
        """Steps of B scenes, each with the digits that it has alone.

        Args:
            positions: (B, N, 3), see ``SimulationLayer.step``.
            velocities: (B, N, 3).
            bodies: at the begin (B, V, 3).
            next_bodies: at the end (B, V, 3).
            time_step: h [s].

        Raises:
            ValueError: gradients are asked for, and there are several processes.
        """
        inputs = positions, velocities, bodies, next_bodies
        if self.count > 1 and torch.is_grad_enabled() and any(given.requires_grad for given in inputs):
            raise ValueError(f"gradients stay within a process: expected count=1, got {self.count}")
        scenes = [_Scene(*scene, time_step) for scene in zip(*inputs, strict=True)]
        return self.map(_step, scenes)


class _Scene(NamedTuple):
    positions: Tensor
    velocities: Tensor
    body: Tensor
    next_body: Tensor
    time_step: float


def _step(layer: SimulationLayer, scene: _Scene) -> LayerStep:
    return layer.step(*scene)


_kept: list[SimulationLayer] = []


def _keep(layer: SimulationLayer) -> None:
    """First thing that a process does."""
    torch.set_num_threads(1)
    _kept[:] = [layer]


def _with_kept(task: Callable[[SimulationLayer, T], R], item: T) -> R:
    """Do the task in a process that holds the layer."""
    return task(_kept[0], item)
