"""Time and memory of a diagnosis of a session, by one process and by more.

    python benchmarks/session_time.py  # a session of one clip, by one process and by two
    python benchmarks/session_time.py --clips 3
    python benchmarks/session_time.py --session blender-none:0:301 --workers 2

Commands as a user gives them, one after the other; whatever else the machine does counts. Lines that have not
been measured now stay in docs/results/session_time.csv.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import psutil
from session_ladder import folder_of, made

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.diagnosis.record import DIAGNOSIS_FILE
from toile.diagnosis.stage_times import TIMES_FILE, read_times
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.reports.run_folder import current_git_revision

OUT = Path("outputs") / "session_time"
TABLE = Path("docs") / "results" / "session_time.csv"
WHICH = ["session", "clips", "processes"]


def measured(folder: Path, workers: int, out: Path) -> dict[str, object]:
    """One diagnosis, from the command to the page.

    Args:
        folder: of the session.
        workers: processes.
        out: folder of the run, which is made anew.
    """
    shutil.rmtree(out, ignore_errors=True)
    said = [f"session={folder}", "diagnosis=quick", f"workers={workers}", f"hydra.run.dir={out}"]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with subprocess.Popen([Path(sys.executable).parent / "toile", "diagnose", *said]) as run:
        peak = 0.0
        while run.poll() is None:
            peak = max(peak, _memory(psutil.Process(run.pid)))
            time.sleep(1)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode:
        raise SystemExit(f"toile diagnose {' '.join(said)} failed")
    stages = read_times(out / TIMES_FILE)
    return {
        "minutes": wall / 60,
        "of the processor": (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / 60,
        "of them refining": (stages["refined motion"].wall or 0.0) / 60,
        "memory [GB]": peak / 1e9,
    }


def _memory(process: psutil.Process) -> float:
    """Of a process and those that it has started [bytes]; what they share counts once."""
    total = 0.0
    try:
        for one in (process, *process.children(recursive=True)):
            total += one.memory_full_info().pss
    except psutil.Error:
        # One of them has just ended.
        return 0.0
    return total


def text(table: pd.DataFrame) -> str:
    """The page."""
    shown = table.sort_values(WHICH).round({"memory [GB]": 1})
    return (
        "# Time of a diagnosis of a session\n\n"
        "Made by `make session-time` (`--clips 3` of `benchmarks/session_time.py` for three clips). From the "
        "command to the page, `diagnosis=quick`, "
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; refining is one of "
        "the longest stages; memory of all processes together. `same answer`: whether diagnosis.json has the "
        "bytes of the run by one process. One run each.\n\n"
        + str(shown.to_markdown(index=False, floatfmt=".2f"))
        + "\n"
    )


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--session", default="air_drag:3:1", help="as session_ladder names them")
    parser.add_argument("--clips", type=int, default=1, choices=range(1, len(DEFAULT_CLIPS) + 1))
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    given = parser.parse_args()
    register_resolvers()
    within = OUT / f"{given.clips}_clips"
    folder = made(given.session, within, DEFAULT_CLIPS[: given.clips])
    rows: list[dict[str, object]] = []
    for workers in given.workers:
        run = within / f"{folder_of(given.session).name}_{workers}"
        found = measured(folder, workers, run)
        alone = within / f"{folder_of(given.session).name}_1" / DIAGNOSIS_FILE
        same = "–"
        if alone.is_file():
            same = "yes" if alone.read_bytes() == (run / DIAGNOSIS_FILE).read_bytes() else "no"
        which = dict(zip(WHICH, (given.session, given.clips, workers), strict=True))
        revision = str(current_git_revision())[:7]
        rows.append({**which, "revision": revision, **found, "same answer": same})
    table = pd.DataFrame(rows)
    if TABLE.is_file():
        table = pd.concat([pd.read_csv(TABLE), table]).drop_duplicates(WHICH, keep="last")
    write_text(TABLE, table.sort_values(WHICH).to_csv(index=False, float_format="%.4g"))
    write_text(TABLE.with_suffix(".md"), text(table))
    print(text(table))


if __name__ == "__main__":
    main()
