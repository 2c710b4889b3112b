"""Failures of threads that write in the background, as TensorBoard's do."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from toile.atomic_file import disk_failure


@contextmanager
def disk_failures_of_threads() -> Iterator[list[OSError]]:
    """Collect the disk's failures in other threads instead of printing a traceback each.

    Whoever started such a thread may never ask how it has ended; without this, lost events would be a text
    on the terminal and an exit status of 0. Other exceptions of threads are printed as usual.
    """
    failures: list[OSError] = []
    before = threading.excepthook

    def hook(arguments: threading.ExceptHookArgs) -> None:
        failure = disk_failure(arguments.exc_value)
        if failure is None:
            before(arguments)
        else:
            failures.append(failure)

    threading.excepthook = hook
    try:
        yield failures
    finally:
        threading.excepthook = before
