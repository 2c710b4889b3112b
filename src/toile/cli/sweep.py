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
from toile.cli.alone import FolderInUseError, OtherSettingsError
from toile.cli.failures import explain

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

    hydra = HydraConfig.get()
    swept = hydra.mode is RunMode.MULTIRUN
    if hydra.output_subdir is None and not swept:
        # A command without a folder of its own: what lies where it is called is not its business.
        yield
        return
    note = RunFolder(Path(hydra.runtime.output_dir)).failure
    # A run of a sweep may be finished by itself.
    before = note.read_text(encoding="utf-8", errors="replace") if note.is_file() else None
    note.unlink(missing_ok=True)
    try:
        yield
    except FolderInUseError:
        raise  # it is the other process that says how the run in there ends
    except OtherSettingsError:
        # Nothing has been done to the run that is there.
        if before is not None:
            write_text(note, before)
        raise
    except Exception as error:
        if not swept:
            raise
        failure = explain(error)
        text = "".join(traceback.format_exception(error)) if failure is None else failure.message
        write_text(note, text + "\n")
        raise


def print_summary() -> None:
    """Say how many runs of the sweep have a result, and why the others have none."""
    if not _started:
        return
    # Here, because it loads PyTorch, which every command would wait for.
    from toile.reports.sweep import outcomes

    folder = _started.pop()
    finished, unfinished = outcomes(folder)
    total = finished + len(unfinished)
    if not total:
        return  # nothing was begun; why has been said
    lines = [f"{finished} of {total} runs in {os.path.relpath(folder)} have a result"]
    lines += [f"{run.name}: {run.reason}" for run in unfinished]
    if unfinished:
        lines.append(f"The same command with hydra.sweep.dir={os.path.relpath(folder)} runs what is missing.")
    print("\n".join(lines), file=sys.stderr)
