"""Measured tables on disk, with where and how they were measured; nothing is measured twice."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from bench_solver import machine

from toile.atomic_file import write_text


@dataclass(frozen=True)
class Record:
    """Tables of one part.

    Attributes:
        table: the measurements.
        about: machine, command, time and the settings that the part was measured with.
    """

    table: pd.DataFrame
    about: dict[str, Any]


class Records:
    """The folder of the tables.

    Args:
        folder: of the CSV files; each begins with a comment that says how it was made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, part: str) -> Record | None:
        """A part as measured last, whatever the settings; None if there is none."""
        path = self.folder / f"{part}.csv"
        if not path.exists():
            return None
        first, _, rest = path.read_text(encoding="utf-8").partition("\n")
        return Record(pd.read_csv(StringIO(rest)), json.loads(first.removeprefix("#")))

    def measure(self, part: str, settings: Mapping[str, Any], make: Callable[[], pd.DataFrame]) -> None:
        """Measure a part unless it is there with the same settings: all that its numbers depend on."""
        wanted = json.loads(json.dumps(settings))
        before = self.read(part)
        if before is not None and before.about["settings"] == wanted:
            print(f"{part}: measured already", flush=True)
            return
        print(f"{part}: being measured", flush=True)
        load, started = os.getloadavg()[0], time.perf_counter()
        date = time.strftime("%Y-%m-%d %H:%M")
        table = make()
        about = {
            "command": command(),
            "date": date,
            "seconds": round(time.perf_counter() - started, 1),
            "machine": machine(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "load before": round(load, 1),
            "settings": wanted,
        }
        text = f"# {json.dumps(about, ensure_ascii=False)}\n{table.to_csv(index=False, float_format='%.6g')}"
        write_text(self.folder / f"{part}.csv", text)
        print(f"{part}: {about['seconds']:.0f} s", flush=True)


def command() -> str:
    """The command line; of a path its last name only, which is the same on every machine."""
    arguments = [Path(a).name if Path(a).is_absolute() else a for a in sys.argv[1:]]
    return " ".join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *arguments])


def fingerprint(path: Path) -> str:
    """Of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]
