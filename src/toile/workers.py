"""Independent pieces of work on several cores; what comes out does not depend on how many."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import time
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Any, Generic, TypeVar, cast

import cloudpickle
import numpy as np
import torch
from joblib import Parallel, delayed
from joblib.externals.loky import process_executor

from toile.denormals import denormals_flushed, flushing
from toile.shared_arrays import LARGE, array_in, file_of, folder_of_arrays, never_changes, new_file

T = TypeVar("T")
R = TypeVar("R")

_PARTS = 4
"""In which the items of a call are handed to each process; with more, one that is done early waits less."""


def processes(workers: int) -> int:
    """How many a setting asks for: a negative one means one per core."""
    return (os.cpu_count() or 1) if workers < 0 else workers


class Workers:
    """Processes that share independent work, each with one thread; to be used in a ``with``.

    Args:
        count: of processes; with one, everything happens in this one. -1: one per core.
    """

    def __init__(self, count: int = 1) -> None:
        self._count = processes(count)
        self._parallel = (
            None
            if self._count == 1
            else Parallel(
                self._count,
                return_as="generator",
                # It would hand out an array as it was when it was first seen, changed since or not.
                max_nbytes=None,
                # At once: what is handed out later is so by a thread, while the next call may have begun.
                pre_dispatch="all",
                # Whatever it leaves there goes with what is ours.
                temp_folder=str(folder_of_arrays()),
                inner_max_num_threads=1,
                initializer=_begin,
            )
        )

    def __enter__(self) -> Workers:
        """The processes are kept until the end of the block."""
        if self._parallel is not None:
            self._parallel.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let them go."""
        if self._parallel is not None:
            self._parallel.__exit__(kind, error, trace)

    def map(self, task: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
        """Results in the order of the items, as they come. Denormal numbers count there as they do here.

        Args:
            task: of one item; it and what it returns go from process to process, it once to each.
            items: independent of one another. Large arrays that nobody can write to, whether of the task or
                of items, are put where all processes see them, once for all calls.
        """
        if self._parallel is None or len(items) < 2:
            return map(task, items)
        if flushing():
            task = _Flushed(task)
        n = min(len(items), _PARTS * self._count)
        bounds = [len(items) * k // n for k in range(n + 1)]
        parts = [items[a:b] for a, b in pairwise(bounds)]
        written = [_Written(value) for value in (task, *parts)]
        kept = _KeptPart(written[0].path)
        return _results(written, self._parallel(delayed(kept)(part.path) for part in written[1:]))


_PLAIN = (torch.float32, torch.float64, torch.int64, torch.bool)


class _Pickler(cloudpickle.Pickler):
    """Tensors are pickled as arrays, which takes less time."""

    def reducer_override(self, obj: Any) -> Any:
        """See pickle.Pickler."""
        if (
            type(obj) is torch.Tensor
            and obj.device.type == "cpu"
            and obj.dtype in _PLAIN
            and obj.is_contiguous()
            and not obj.requires_grad
        ):
            return torch.from_numpy, (obj.numpy(),)
        return super().reducer_override(obj)


class _HandingPickler(_Pickler):
    """Large arrays that never change are pickled by the files that they have."""

    def reducer_override(self, obj: Any) -> Any:
        """See pickle.Pickler."""
        if type(obj) is np.ndarray and obj.nbytes >= LARGE and never_changes(obj):
            return array_in, (file_of(obj),)
        return super().reducer_override(obj)


class _Written:
    """A task, or items, in a file that goes with this, as what comes of them does.

    Args:
        value: kept here, and with it the arrays that have files of their own.
    """

    def __init__(self, value: object) -> None:
        self.value, self.path = value, new_file(".given")
        for path in (self.path, _results_of(self.path)):
            weakref.finalize(self, path.unlink, missing_ok=True)
        with self.path.open("wb") as file:
            _HandingPickler(file).dump(value)


def _results_of(items: Path) -> Path:
    return items.with_suffix(".found")


def _read(path: Path) -> Any:
    with path.open("rb") as file:
        return pickle.load(file)


@lru_cache(maxsize=1)
def _task_in(path: Path) -> Callable[[Any], Any]:
    """Read once by each process: the problem that items are of may be large."""
    return cast("Callable[[Any], Any]", _read(path))


class _KeptPart:
    """A task of a part of the items that gives back why it failed, and does not fail.

    A failure makes joblib give up the call, and what is handed out by then may turn up among the results of
    the next one.

    Args:
        task: where it is.
    """

    def __init__(self, task: Path) -> None:
        self.task = task

    def __call__(self, items: Path) -> None:
        # By a file, which is written here and read there at once: a pipe takes longer.
        with _results_of(items).open("wb") as file:
            _Pickler(file).dump([self._kept(item) for item in _read(items)])

    def _kept(self, item: object) -> tuple[Any, Exception | None]:
        try:
            return _task_in(self.task)(item), None
        except Exception as failure:
            failure.add_note("".join(traceback.format_exception(failure)))
            return None, failure


def _results(written: Sequence[_Written], done: Iterator[None]) -> Iterator[Any]:
    """Results as they come, or the first failure; in either case nothing is left under way.

    Args:
        written: the task, and every part of the items; their files stay as long as this does.
        done: comes to its next one when the next part is done.
    """
    try:
        for part, _ in zip(written[1:], done, strict=True):
            found = _read(_results_of(part.path))
            _results_of(part.path).unlink()
            for value, failure in found:
                if failure is not None:
                    raise failure
                yield value
    except (Exception, GeneratorExit):
        for _ in done:
            pass
        raise


class _Flushed(Generic[T, R]):
    """A task during which denormal numbers count as zero."""

    def __init__(self, task: Callable[[T], R]) -> None:
        self.task = task

    def __call__(self, item: T) -> R:
        with denormals_flushed():
            return self.task(item)


ALONE = Workers(1)
"""One process."""


def _begin() -> None:
    """Of every process that shares work."""
    # A process that has 0.3 GB more than after its first task is taken for one that leaks, and another one
    # has to import everything; arrays that all processes see count as its own there.
    process_executor._MAX_MEMORY_LEAK_SIZE = sys.maxsize
    end_with_parent()


def end_with_parent() -> None:
    """Let this process end when the one that started it is gone, killed or not.

    An initializer for processes that share work: such a process looks for its parent only between two pieces
    of work, and those of a diagnosis take minutes.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        try:
            parent.join()
        except ValueError:
            # joblib's processes have nothing to wait for; an orphan has another parent.
            while os.getppid() == parent.pid:
                time.sleep(1)
        os._exit(1)

    Thread(target=watch, name="end_with_parent", daemon=True).start()
