"""What the machine does to a command: full disks, other processes, torn files, terminals without Unicode."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock

from toile.cli.alone import HOLDER, LOCK
from toile.learning.fit.module import FitModule
from toile.reports.overlay import write_video
from toile.reports.run_folder import RunFolder
from toile.scenes.native import write_native
from toile.scenes.scene import Scene

Toile = Callable[..., Any]
FIT = (
    "fit",
    "scene=swaying",
    "experiment=paper",
    "optimization.cycles=2",
    "optimization.first_frames=null",
    "logger=none",
    "report.video=false",
    "report.page=false",
    "hydra.run.dir=run",
)
TRAIN = ("train", "training=tiny", "threads=1", "logger=none", "hydra.run.dir=run")
FULL = OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture
def swaying(swaying_scene: Scene, tmp_path: Path) -> Path:
    return write_native(swaying_scene, tmp_path / "data" / "made" / "swaying")


@pytest.fixture
def stopped(swaying: Path, toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fit that was interrupted in its second cycle; the folder of its checkpoint."""
    step = FitModule.training_step

    def interrupted(self: FitModule, batch: int, batch_idx: int) -> None:
        if self.cycles_done == 1:
            raise KeyboardInterrupt
        step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(FitModule, "training_step", interrupted)
        assert toile(*FIT).status == 130
    return tmp_path / "run" / "checkpoints"


# -- one folder, one process -----------------------------------------------------------------------------


def in_another_process(folder: Path) -> subprocess.Popen[str]:
    """A process that has the folder for itself until it reads a line."""
    # As toile.cli.alone does, without the seconds that importing it takes.
    code = (
        "import os, sys, socket; from filelock import FileLock\n"
        "folder = sys.argv[1]; os.makedirs(folder)\n"
        f"with FileLock(f'{{folder}}/{LOCK}'), open(f'{{folder}}/{HOLDER}', 'w') as holder:\n"
        "    holder.write(f'process {os.getpid()} on {socket.gethostname()}'); holder.flush()\n"
        "    print('in', flush=True); sys.stdin.readline()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "in\n"
    return process


def end(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


@pytest.mark.usefixtures("swaying")
@pytest.mark.parametrize("command", [FIT, TRAIN, ("diagnose", "scene=swaying", "hydra.run.dir=run")])
def test_a_second_process_is_refused(command: tuple[str, ...], toile: Toile, tmp_path: Path) -> None:
    other = in_another_process(tmp_path / "run")
    try:
        outcome = toile(*command)
    finally:
        end(other)
    assert outcome.status == 2
    assert "Another process works in this folder" in outcome.err
    assert f"process {other.pid} on {os.uname().nodename}" in outcome.err
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.usefixtures("swaying")
def test_a_process_that_was_killed_keeps_nobody_out(toile: Toile, tmp_path: Path) -> None:
    end(in_another_process(tmp_path / "run"))
    assert (tmp_path / "run" / HOLDER).is_file()  # it had no time to clean up
    outcome = toile(*FIT)
    assert outcome.status == 0, outcome.err
    assert not (tmp_path / "run" / HOLDER).exists()
    # Nor is the lock that stays behind taken for a run that goes on.
    assert (tmp_path / "run" / LOCK).is_file()
    again = toile(*FIT)
    assert again.status == 0
    assert "finished before" in again.out


def test_a_refused_cell_of_a_sweep_leaves_the_other_process_alone(
    swaying: Path, toile: Toile, tmp_path: Path
) -> None:
    """No failure.txt in a folder where another process is at work: its run is not a failed one."""
    run = tmp_path / "sweep" / "0_swaying"
    other = in_another_process(run)
    try:
        outcome = toile(*FIT[:-1], "-m", "hydra.sweep.dir=sweep", "seed=0")
    finally:
        end(other)
    assert outcome.status == 2
    assert "Another process works in this folder" in outcome.err
    assert not RunFolder(run).failure.exists()


@pytest.mark.usefixtures("swaying")
def test_further_processes_of_a_training_belong_to_the_first(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lightning.pytorch.utilities import rank_zero_only

    from toile.cli import alone

    calls = []
    monkeypatch.setattr(alone, "output_folder", lambda: tmp_path / "run")
    command = alone.alone(calls.append)
    (tmp_path / "run").mkdir()
    with FileLock(tmp_path / "run" / LOCK):
        monkeypatch.setattr(rank_zero_only, "rank", 1)
        command("second")  # type: ignore[arg-type]
        monkeypatch.setattr(rank_zero_only, "rank", 0)
        with pytest.raises(alone.FolderInUseError):
            command("another")  # type: ignore[arg-type]
    assert calls == ["second"]


# -- disks -----------------------------------------------------------------------------------------------


def test_a_full_disk_is_one_line_and_nothing_is_lost(
    toile: Toile, run_folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert toile("evaluate", "run=run").status == 0
    before = run_folder.metrics.read_bytes()

    def full(self: Path, *_: Any, **__: Any) -> int:
        raise FULL

    monkeypatch.setattr(Path, "write_text", full)
    outcome = toile("evaluate", "run=run")
    assert outcome.status == 2
    assert outcome.err == "error: No space left on device: run/metrics.json\n"
    assert run_folder.metrics.read_bytes() == before
    assert not list(run_folder.path.glob(".metrics*"))


@pytest.mark.usefixtures("swaying")
def test_a_full_disk_under_a_checkpoint(
    toile: Toile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What Lightning raises names a temporary file, if anything."""

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/tmp/tmp1234")

    monkeypatch.setattr("lightning.Trainer.save_checkpoint", full)
    outcome = toile(*FIT)
    assert outcome.status == 2
    assert outcome.err.splitlines()[-1] == (
        f"error: No space left on device: {tmp_path}/run/checkpoints/last.ckpt"
    )


@pytest.mark.usefixtures("swaying")
def test_a_full_disk_under_hydra(toile: Toile, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the command begins, and without a file name."""

    def full(*_: Any, **__: Any) -> None:
        raise FULL

    monkeypatch.setattr("hydra.core.utils._save_config", full)
    outcome = toile(*FIT)
    assert (outcome.status, outcome.err) == (2, "error: No space left on device\n")


def test_a_full_disk_in_a_thread(
    toile: Toile, run_folder: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TensorBoard writes in the background, and nobody may ever ask it how that went."""

    def in_background(cfg: Any) -> None:
        def full() -> None:
            raise OSError(errno.ENOSPC, "No space left on device", "events.out")

        thread = threading.Thread(target=full)
        thread.start()
        thread.join()

    monkeypatch.setattr("toile.cli.evaluate.run", in_background)
    outcome = toile("evaluate", "run=run")
    assert (outcome.status, outcome.err) == (2, "error: No space left on device: events.out\n")


def test_other_failures_of_threads_are_shown(
    run_folder: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from toile.cli.threads import disk_failures_of_threads

    shown = []
    monkeypatch.setattr(threading, "excepthook", shown.append)
    with disk_failures_of_threads() as failures:
        thread = threading.Thread(target=lambda: 1 / 0)
        thread.start()
        thread.join()
    assert [type(s.exc_value) for s in shown] == [ZeroDivisionError]
    assert failures == []


def test_a_video_that_the_disk_has_cut_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The encoder is a process of its own, and its failure reaches nobody."""
    import imageio.v3 as iio

    pictures = [np.full((32, 32, 3), 10 * k, np.uint8) for k in range(5)]
    video = write_video(pictures, tmp_path / "a.mp4", 25.0)
    before = video.read_bytes()
    write = iio.imwrite

    def cut(path: Path, *arguments: Any, **options: Any) -> None:
        write(path, *arguments, **options)
        path.write_bytes(path.read_bytes()[:-200])

    monkeypatch.setattr(iio, "imwrite", cut)
    with pytest.raises(OSError, match=r"a\.mp4"):
        write_video(pictures, video, 25.0)
    assert video.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


# -- checkpoints -----------------------------------------------------------------------------------------


def torn(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


def text(path: Path) -> None:
    path.write_text("no checkpoint")


def empty(path: Path) -> None:
    path.write_bytes(b"")


def another_dictionary(path: Path) -> None:
    torch.save({"state_dict": {}, "epoch": 1}, path)


def no_dictionary(path: Path) -> None:
    torch.save([1, 2], path)


def of_another_scene(path: Path) -> None:
    content = torch.load(path, weights_only=True)
    content["state_dict"]["parameters.turbulence"] = torch.zeros(3, 9, 3)
    torch.save(content, path)


def of_another_recipe(path: Path) -> None:
    content = torch.load(path, weights_only=True)
    content["toile_fit"]["recipe"] = {"positions": None}
    torch.save(content, path)


@pytest.mark.parametrize(
    "broken", [torn, text, empty, another_dictionary, no_dictionary, of_another_scene, of_another_recipe]
)
def test_a_broken_checkpoint_is_refused_and_kept(
    broken: Callable[[Path], None], stopped: Path, toile: Toile
) -> None:
    checkpoint = stopped / "last.ckpt"
    whole = checkpoint.read_bytes()
    broken(checkpoint)
    content = checkpoint.read_bytes()
    for arguments in (("fit", "resume=run"), FIT):
        outcome = toile(*arguments)
        assert outcome.status == 2
        assert "checkpoint" in outcome.err
        assert "last.ckpt" in outcome.err
        # Before it stand warnings of the scene.
        assert len(outcome.err.partition("error: ")[2].splitlines()) <= 5
        assert checkpoint.read_bytes() == content
    checkpoint.write_bytes(whole)
    assert toile("fit", "resume=run").status == 0


def test_a_checkpoint_of_a_fit_is_none_of_a_training(stopped: Path, toile: Toile, tmp_path: Path) -> None:
    assert toile(*TRAIN[:-1], "hydra.run.dir=other", "max_minutes=0").status == 0
    shutil.copy(stopped / "last.ckpt", tmp_path / "other" / "checkpoints" / "last.ckpt")
    outcome = toile("train", "resume=other", "max_minutes=1")
    assert outcome.status == 2
    assert "training cannot be continued from this checkpoint" in outcome.err
    assert "toile_training" in outcome.err


# -- terminals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variables", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0"}])
def test_a_terminal_that_knows_ascii_only(
    run_folder: RunFolder, tmp_path: Path, variables: dict[str, str]
) -> None:
    """The table has m² and –, the message of a failure an umlaut."""
    environment = {**os.environ, **variables, "PYTHONCOERCECLOCALE": "0"}
    environment.pop("TOILE_DATA", None)  # the scene is in the folder of the test
    main = [sys.executable, "-c", "import sys; from toile.cli.main import main; sys.exit(main())"]

    def toile(*arguments: str) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run(
            [*main, *arguments], cwd=tmp_path, env=environment, capture_output=True, check=False, timeout=120
        )

    done = toile("evaluate", "run=run", "~renderer")
    assert done.returncode == 0, done.stderr.decode()
    assert b"Vertex error" in done.stdout
    assert max(done.stdout) < 128
    done = toile("evaluate", "run='Stoffhülle'")
    assert done.returncode == 2
    assert b"Not a run folder" in done.stderr
    assert b"Traceback" not in done.stderr


def test_the_log_is_utf8_whatever_the_locale(swaying: Path) -> None:
    from hydra import compose, initialize_config_dir

    from toile.cli.configuration import CONF

    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("fit", ["scene.name=x"], return_hydra_config=True)
    assert cfg.hydra.job_logging.handlers.file.encoding == "utf-8"


@pytest.mark.parametrize("name", ["config.yaml", "overrides.yaml"])
@pytest.mark.parametrize("content", [b"a: [", b"\xff\xfe", b"[[[[", b"- 1\n- 2: {"])
def test_records_of_a_run_that_are_no_yaml(stopped: Path, toile: Toile, name: str, content: bytes) -> None:
    record = stopped.parent / name
    whole = record.read_bytes()
    record.write_bytes(content)
    outcome = toile("fit", "resume=run")
    assert outcome.status == 2
    assert name in outcome.err
    record.write_bytes(whole)
