"""Sweeps: a run that fails says why in its folder, and the end says what is missing."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.cli.alone import FolderInUseError
from toile.cli.failures import explain
from toile.errors import InputError

_started: list[Path] = []


class SweepFolder(Callback):
    """Remembers where a sweep writes to, for the summary in the process that started it."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Hydra calls this once, before the runs."""
        folder = Path(config.hydra.sweep.dir).absolute()
        # A sweeper may want to keep something there before the first run does.
        folder.mkdir(parents=True, exist_ok=True)
        _started.append(folder)


@contextmanager
def noting_failures() -> Iterator[None]:
    """Write why a run of a sweep failed into its folder; the failure itself goes on."""
    from toile.reports.run_folder import RunFolder

    note = RunFolder(Path(HydraConfig.get().runtime.output_dir)).failure
    # A run of a sweep may be finished by itself.
    note.unlink(missing_ok=True)
    if HydraConfig.get().mode is not RunMode.MULTIRUN:
        yield
        return
    try:
        yield
    except FolderInUseError:
        raise  # it is the other process that says how the run in there ends
    except Exception as error:
        failure = explain(error)
        text = "".join(traceback.format_exception(error)) if failure is None else failure.message
        write_text(note, text + "\n")
        raise


def print_summary() -> None:
    """Say how many runs of the sweep have a result, and why the others have none."""
    if not _started:
        return
    # Here, because it loads PyTorch, which every command would wait for.
    from toile.reports.sweep import read_sweep

    folder = _started.pop()
    try:
        sweep = read_sweep([folder])
    except InputError:
        return  # nothing was begun; why has been said
    total = len(sweep.runs) + len(sweep.unfinished)
    lines = [f"{len(sweep.runs)} of {total} runs in {os.path.relpath(folder)} have a result"]
    lines += [f"{run.name}: {run.reason}" for run in sweep.unfinished]
    if sweep.unfinished:
        lines.append(f"The same command with hydra.sweep.dir={os.path.relpath(folder)} runs what is missing.")
    print("\n".join(lines), file=sys.stderr)
