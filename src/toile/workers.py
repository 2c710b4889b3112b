"""Independent pieces of work on several cores; what comes out does not depend on how many."""

from __future__ import annotations

import multiprocessing
import os
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, pairwise
from threading import Thread
from types import TracebackType
from typing import Generic, TypeVar, cast

from joblib import Parallel, delayed

from toile.denormals import denormals_flushed, flushing
from toile.shared_arrays import folder_of_arrays

T = TypeVar("T")
R = TypeVar("R")

# Larger arrays are put where all processes see them, once, and copied where one writes.
_SHARED = "1M"

_PARTS = 4
"""In which the items of a call are handed to each process; with more, one that is done early waits less."""


class Workers:
    """Processes that share independent work, each with one thread; to be used in a ``with``.

    Args:
        count: of processes; with one, everything happens in this one.
    """

    def __init__(self, count: int = 1) -> None:
        self._count = count
        self._parallel = (
            None
            if count == 1
            else Parallel(
                count,
                return_as="generator",
                max_nbytes=_SHARED,
                mmap_mode="c",
                # At once: what is handed out later is so by a thread, while the next call may have begun.
                pre_dispatch="all",
                temp_folder=str(folder_of_arrays()),
                inner_max_num_threads=1,
                initializer=end_with_parent,
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
            task: of one item; it and what it returns go from process to process.
            items: independent of one another.
        """
        if self._parallel is None or len(items) < 2:
            return map(task, items)
        if flushing():
            task = _Flushed(task)
        # Each part takes the task along, and with it the problem that the items are of.
        n = min(len(items), _PARTS * self._count)
        bounds = [len(items) * k // n for k in range(n + 1)]
        parts = [items[a:b] for a, b in pairwise(bounds)]
        return _results(chain.from_iterable(self._parallel(delayed(_KeptPart(task))(part) for part in parts)))


class _Kept(Generic[T, R]):
    """A task that gives back why it failed, and does not fail.

    A failure makes joblib give up the call, and what is handed out by then may turn up among the results of
    the next one.
    """

    def __init__(self, task: Callable[[T], R]) -> None:
        self.task = task

    def __call__(self, item: T) -> tuple[R | None, Exception | None]:
        try:
            return self.task(item), None
        except Exception as failure:
            failure.add_note("".join(traceback.format_exception(failure)))
            return None, failure


class _KeptPart(Generic[T, R]):
    """The same of a part of the items, one after the other."""

    def __init__(self, task: Callable[[T], R]) -> None:
        self.kept = _Kept(task)

    def __call__(self, items: Sequence[T]) -> list[tuple[R | None, Exception | None]]:
        return [self.kept(item) for item in items]


def _results(found: Iterator[tuple[R | None, Exception | None]]) -> Iterator[R]:
    """Results as they come, or the first failure; in either case nothing is left under way."""
    try:
        for value, failure in found:
            if failure is not None:
                raise failure
            yield cast(R, value)
    except (Exception, GeneratorExit):
        for _ in found:
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


def processes(workers: int) -> int:
    """How many a setting asks for: a negative one means one per core."""
    return (os.cpu_count() or 1) if workers < 0 else workers
