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

from toile.cli.failures import explain
from toile.reports.atomic_file import write_text
from toile.reports.run_folder import RunFolder

_started: list[Path] = []


class SweepFolder(Callback):
    """Remembers where a sweep writes to, for the summary in the process that started it."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Hydra calls this once, before the runs."""
        _started.append(Path(config.hydra.sweep.dir).absolute())


@contextmanager
def noting_failures() -> Iterator[None]:
    """Write why a run of a sweep failed into its folder; the failure itself goes on."""
    if HydraConfig.get().mode is not RunMode.MULTIRUN:
        yield
        return
    note = RunFolder(Path(HydraConfig.get().runtime.output_dir)).failure
    note.unlink(missing_ok=True)
    try:
        yield
    except Exception as error:
        failure = explain(error)
        text = "".join(traceback.format_exception(error)) if failure is None else failure.message
        write_text(note, text + "\n")
        raise


def print_summary() -> None:
    """Say how many runs of the sweep have a result, and why the others have none."""
    if not _started:
        return
    folder = _started.pop()
    runs = [RunFolder(path.parent) for path in sorted(folder.rglob("config.yaml")) if _is_run(path)]
    failures = {run.path: run.failure.read_text().strip() for run in runs if run.failure.is_file()}
    finished = sum(run.metrics.is_file() and run.path not in failures for run in runs)
    lines = [f"{finished} of {len(runs)} runs in {os.path.relpath(folder)} have a result"]
    for path, text in failures.items():
        # Of a traceback, its last line; the rest is in the file.
        reason = text.splitlines()[-1] if text.startswith("Traceback") else text
        lines.append(f"failed: {os.path.relpath(path)}\n  {reason}")
    if finished < len(runs):
        lines.append("The same command runs what is missing.")
    print("\n".join(lines), file=sys.stderr)


def _is_run(config: Path) -> bool:
    return config.parent.name != ".hydra"
