"""What the user reads when a process that shares the work is killed, as by a machine without memory."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

import pytest

from toile.cli.failures import PROCESS_KILLED, explain
from toile.workers import Workers


def killed(_: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def by_a_pool() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pool.submit(killed, 0).result()


def by_workers() -> None:
    with Workers(2) as workers:
        list(workers.map(killed, (0, 1)))


@pytest.mark.parametrize("shared", [by_a_pool, by_workers])
def test_a_killed_process_is_said_in_one_message(shared: Callable[[], None]) -> None:
    with pytest.raises(BrokenProcessPool) as raised:
        shared()
    found = explain(raised.value)
    assert found is not None
    assert found.status == PROCESS_KILLED
    assert "was killed" in found.message
    assert "memory" in found.message
