"""What commands cost before they have anything to compute: processor and wall time of --help and the like.

``python benchmarks/bench_startup.py`` prints the table; ``--source <src of another version>`` measures that
one beside it, and ``--scene R1`` adds ``toile doctor``.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd

from toile.cli.commands import COMMANDS
from toile.cli.machine import machine


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--source", type=Path, help="src/ of another version, measured first")
    options.add_argument("--scene", help="a scene that doctor is measured on")
    options.add_argument("--repeats", type=int, default=3, help="the fastest of so many calls counts")
    given = options.parse_args()
    calls = [("--help",), ("--version",), *((command, "--help") for command in COMMANDS)]
    calls += [("fit", "scene=R1", "--cfg", "job"), ("fit", "scnee=R1")]
    calls += [("doctor", f"scene={given.scene}")] if given.scene else []
    versions = {"": None} if given.source is None else {"before": given.source, "after": None}
    rows = []
    for call in calls:
        row: dict[str, object] = {"command": f"`toile {' '.join(call)}`"}
        for version, source in versions.items():
            cpu, wall = min(measure(call, source) for _ in range(given.repeats))
            row |= {f"{version} CPU [s]".strip(): cpu, f"{version} wall [s]".strip(): wall}
        rows.append(row)
    # What completion asks at a press of the tab key; the version before may not have it.
    for words in (("fit", ""), ("fit", "optimization=")):
        cpu, wall = min(measure(("completion", "words", *words), None) for _ in range(given.repeats))
        last = list(versions)[-1]
        rows.append(
            {
                "command": f"`toile {' '.join(words)}`, tab key",
                f"{last} CPU [s]".strip(): cpu,
                f"{last} wall [s]".strip(): wall,
            }
        )
    print("{processor}, {processors} cores, 1 thread; Python {python}, PyTorch {torch}".format(**machine()))
    table = pd.DataFrame(rows).map(lambda cell: f"{cell:.2f}" if isinstance(cell, float) else cell)
    print()
    print(table.replace("nan", "–").to_markdown(index=False, disable_numparse=True))


def measure(call: tuple[str, ...], source: Path | None) -> tuple[float, float]:
    """Processor and wall time [s] of one call, in a process of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if source is not None:
        environment["PYTHONPATH"] = str(source.resolve())
    used, started = _children(), time.perf_counter()
    command = [sys.executable, "-m", "toile.cli.main", *call]
    subprocess.run(command, env=environment, capture_output=True, check=False)
    return _children() - used, time.perf_counter() - started


def _children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
