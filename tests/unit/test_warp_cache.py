"""Where Warp's compiled kernels cannot be kept, a command works all the same and says so."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

START = """
import toile.cli
from pathlib import Path
import warp as wp
from toile.warp_runtime import start_warp
start_warp()
start_warp()
cache = Path(wp.config.kernel_cache_dir)
(cache / "kernel").write_text("compiled")
print(cache)
print(sorted(p.name for p in cache.iterdir()))
"""


def started(usual: Path, temporary: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "WARP_CACHE_PATH": str(usual), "TMPDIR": str(temporary)}
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", START],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
        timeout=120,
    )


def test_a_cache_that_can_be_written_to_is_used(tmp_path: Path) -> None:
    done = started(tmp_path / "usual", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[0].startswith(str(tmp_path / "usual"))


def test_a_cache_that_cannot_even_be_made(tmp_path: Path) -> None:
    (tmp_path / "usual").write_text("a file is in the way")
    (tmp_path / "temporary").mkdir()
    done = started(tmp_path / "usual", tmp_path / "temporary")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0].startswith(str(tmp_path / "temporary"))
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("warning: compiled kernels cannot be kept (Not a directory")
    # It goes with the process.
    assert not list((tmp_path / "temporary").glob("toile-kernels-*"))


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="only root can mount")
def test_a_read_only_cache_is_copied(tmp_path: Path) -> None:
    usual = tmp_path / "usual"
    usual.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "tmpfs", usual], check=False, capture_output=True).returncode:
        pytest.skip("mounting is not allowed")
    try:
        import warp

        (usual / warp.config.version / "wp_toile_kernels").mkdir(parents=True)
        (usual / warp.config.version / "wp_others_kernels").mkdir()
        subprocess.run(["mount", "-o", "remount,ro", usual], check=True)
        (tmp_path / "temporary").mkdir()
        done = started(usual, tmp_path / "temporary")
    finally:
        subprocess.run(["umount", usual], check=True)
    assert done.returncode == 0, done.stderr
    assert "warning: compiled kernels cannot be kept (Read-only file system" in done.stderr
    assert done.stdout.splitlines()[1] == "['kernel', 'wp_toile_kernels']"
