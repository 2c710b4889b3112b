"""Work on several cores: same results in the same order, and no process outlives its command."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from toile.errors import InputError
from toile.workers import Workers

POOL = """
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from toile.workers import end_with_parent

if __name__ == "__main__":
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=end_with_parent) as pool:
        pool.submit(print, pool.submit(__import__("os").getpid).result(), flush=True).result()
        pool.submit(time.sleep, 600).result()
"""

WORKERS = """
import time
from toile.workers import Workers

if __name__ == "__main__":
    with Workers(2) as workers:
        child, _ = workers.map(eval, ["__import__('os').getpid()"] * 2)
        print(child, flush=True)
        list(workers.map(time.sleep, [600, 600]))
"""


def test_results_come_in_the_order_of_the_items() -> None:
    with Workers(2) as workers:
        assert list(workers.map(abs, [-3, 1, -2])) == [3, 1, 2]


def test_a_call_after_one_that_failed_has_its_own_results_alone() -> None:
    """Fits go on with the next hypothesis where a step has blown up in a process."""
    with Workers(2) as workers:
        for _ in range(3):
            with pytest.raises(ZeroDivisionError):
                list(workers.map(partial(int.__floordiv__, 1), [*range(1, 20), 0, *range(1, 20)]))
            assert list(workers.map(abs, range(-30, 0))) == list(range(30, 0, -1))


def test_results_that_nobody_wants_are_no_results_of_the_next_call() -> None:
    with Workers(2) as workers:
        for _ in range(3):
            first, *_ = itertools.islice(workers.map(abs, range(-30, 0)), 1)
            assert first == 30
            assert list(workers.map(abs, range(-9, 0))) == list(range(9, 0, -1))


def refused(item: int) -> None:
    raise InputError("No such number", where="item", expected="another", got=str(item))


def test_what_is_wrong_is_said_from_process_to_process() -> None:
    with Workers(2) as workers, pytest.raises(InputError, match="No such number") as raised:
        list(workers.map(refused, [1, 2, 3]))
    assert raised.value.got == "1"
    assert "in refused" in "".join(raised.value.__notes__)


@pytest.mark.skipif(os.name != "posix", reason="kills a process")
@pytest.mark.parametrize("program", [POOL, WORKERS], ids=["pool", "workers"])
def test_a_worker_ends_when_its_parent_is_killed(tmp_path: Path, program: str) -> None:
    """A diagnosis whose command was killed went on for minutes, and answered a scene."""
    script = tmp_path / "parent.py"
    script.write_text(program)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        os.kill(child, 0)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        for _ in range(300):
            if not _runs(child):
                break
            time.sleep(0.1)
    assert not _runs(child)


def _runs(process: int) -> bool:
    """Whether it does; one that has ended and that nobody has asked about does not."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{process}/stat")
    return not status.is_file() or status.read_text().rsplit(")", 1)[1].split()[0] != "Z"
