"""Work on several cores: same results in the same order, and no process outlives its command."""

from __future__ import annotations

import gc
import itertools
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.shared_arrays import folder_of_arrays
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


def test_one_process_per_core_gives_every_result(monkeypatch: pytest.MonkeyPatch) -> None:
    for cores in (1, 2):
        monkeypatch.setattr(os, "cpu_count", lambda n=cores: n)
        with Workers(-1) as workers:
            assert list(workers.map(abs, range(-20, 0))) == list(range(20, 0, -1))


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


def test_arrays_are_handed_out_as_they_are_now() -> None:
    """joblib hands out a large array as it was when it was first seen."""
    array = np.zeros(2**18)

    def more(by: int) -> float:
        return float(array[0]) + by

    with Workers(2) as workers:
        for k in range(3):
            array[:] = k
            assert list(workers.map(np.max, [array, array])) == [k, k]
            assert list(workers.map(more, [1, 2])) == [k + 1, k + 2]


def seen(array: np.ndarray, _: None = None) -> tuple[Path, float, bool]:
    assert not array.flags.writeable
    return Path(array.base.filename), array.sum(), array.flags.f_contiguous


def test_large_arrays_that_never_change_are_handed_out_once() -> None:
    array = np.asfortranarray(np.arange(2**18, dtype=np.float32).reshape(512, 512))
    array.flags.writeable = False

    with Workers(2) as workers:
        found = [*workers.map(seen, [array, array]), *workers.map(partial(seen, array), [None, None])]
        assert {(total, order) for _, total, order in found} == {(array.sum(), True)}
        (path,) = {path for path, *_ in found}
        assert path.is_file()
        del array
        gc.collect()
        assert not path.exists()


def test_results_have_their_files_no_longer_than_needed() -> None:
    with Workers(2) as workers:
        assert [len(found) for found in workers.map(np.zeros, [3000000, 2000000])] == [3000000, 2000000]
        gc.collect()
        assert not [*folder_of_arrays().glob("*.given"), *folder_of_arrays().glob("*.found")]


held: list[np.ndarray] = []


def held_in(item: int) -> int:
    held.append(np.ones(5 * 10**7))
    time.sleep(0.6)
    return os.getpid()


def test_a_process_whose_memory_grows_goes_on() -> None:
    """Another one in its place has to import everything."""
    with Workers(2) as workers:
        first = set(workers.map(held_in, range(2)))
        for _ in range(2):
            assert set(workers.map(held_in, range(2))) == first


def test_tensors_come_back_as_they_are() -> None:
    tensor = torch.arange(6.0, dtype=torch.float64).reshape(2, 3)
    across = tensor.T

    def both(by: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        return tensor + by, across + by, torch.ones(2, requires_grad=True)

    with Workers(2) as workers:
        for by, (one, other, leaf) in enumerate(workers.map(both, [0, 1])):
            assert torch.equal(one, tensor + by)
            assert torch.equal(other, across + by)
            assert leaf.requires_grad
            # It can be written to.
            assert torch.equal(one.add_(1), tensor + by + 1)


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
