"""Time of a whole fit, from the command to the finished run folder, on the embedded demo scene.

python benchmarks/bench_fit.py [--repeats 3]
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    repeats = parser.parse_args().repeats
    toile = str(Path(sys.executable).parent / "toile")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = f"{folder}/scene"
        subprocess.run([toile, "generate", "preset=demo", f"folder={scene}"], check=True, capture_output=True)
        for repeat in range(repeats):
            run = f"{folder}/run{repeat}"
            started = time.perf_counter()
            subprocess.run(
                [toile, "fit", f"scene.name={scene}", f"hydra.run.dir={run}"], check=True, capture_output=True
            )
            seconds = time.perf_counter() - started
            metrics = json.loads(Path(run, "metrics.json").read_text())
            rows.append(
                {
                    "cycles": metrics["fit"]["cycles"],
                    "fit [s]": metrics["fit"]["seconds of the fit"],
                    "whole command [s]": seconds,
                    "vertex error [% of width]": metrics["metrics"]["vertex_error_percent"]["mean"],
                }
            )
    table = pd.DataFrame(rows).agg(["min", "median", "max"])
    print(f"Whole fit, 16×16 cloth, 24 frames of 240×240 px; {platform.processor() or platform.machine()}")
    print(table.to_markdown(floatfmt=".3g"))


if __name__ == "__main__":
    main()
