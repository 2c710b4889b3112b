"""Arrays that processes share: gone with their command, and after it if it was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from toile.shared_arrays import remove_left_over

OWNER = """
import sys, time
from operator import attrgetter
from pathlib import Path

import numpy as np

from toile import shared_arrays
from toile.workers import Workers

if __name__ == "__main__":
    shared_arrays._MEMORY = Path(sys.argv[1])
    for _ in range(2):
        with Workers(2) as workers:
            array = np.zeros(2**18)
            array.flags.writeable = False
            files = list(workers.map(attrgetter("base.filename"), [array] * 2))
        assert all(Path(file).is_relative_to(shared_arrays.folder_of_arrays()) for file in files)
    (shared_arrays.folder_of_arrays() / "array").write_bytes(bytes(1000))
    print(shared_arrays.folder_of_arrays(), flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "memory").mkdir()
    return tmp_path / "memory"


def begun(place: Path) -> tuple[subprocess.Popen[str], Path]:
    """A process that has put arrays there, and its folder; it ends when it is told to."""
    script = place.parent / "owner.py"
    script.write_text(OWNER)
    owner = subprocess.Popen(
        [sys.executable, str(script), str(place)], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert owner.stdout is not None
    return owner, Path(owner.stdout.readline().strip())


def test_nothing_is_left_when_the_process_ends(place: Path) -> None:
    owner, folder = begun(place)
    with owner:
        assert (folder / "array").is_file()
        remove_left_over(place)
        assert (folder / "array").is_file(), "it still runs"
        owner.communicate("\n")
    assert owner.returncode == 0
    assert not list(place.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="kills a process")
def test_what_a_killed_process_left_is_removed(place: Path) -> None:
    """4.5 GB stayed in memory after diagnoses that had been killed, and had the next one killed."""
    owner, folder = begun(place)
    with owner:
        owner.send_signal(signal.SIGKILL)
    assert (folder / "array").is_file()
    remove_left_over(place)
    assert not list(place.iterdir())


def test_what_others_have_put_there_stays(place: Path) -> None:
    other = place / "joblib_memmapping_folder_1"
    other.mkdir()
    remove_left_over(place)
    assert other.is_dir()
