"""Diagnose the real scene R1 and measure its held-out frames against what the depth camera saw.

    make r1-diagnosis

35 frames are fitted, and up to eight of the others predicted by open rollouts: by the base model, with each
of the most probable effects, and by the best placebo. Chamfer distances to the clouds have no part in the
diagnosis. Writes ``docs/results/r1_diagnosis.md``, ``.csv`` and ``r1_diagnosis.json``, the answer.
"""

from __future__ import annotations

import os
from pathlib import Path

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import numpy as np
import pandas as pd
import torch

from toile.atomic_file import write_text
from toile.cli.main import main as toile_main
from toile.diagnosis.arrays import HELD_OUT_FILE
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport
from toile.diagnosis.stages import TRACKED_FILE
from toile.evaluation.evaluate import evaluate
from toile.rendering import WarpRenderer
from toile.scenes.registry import load_scene

OUTPUT = Path("outputs/r1_diagnosis")
RESULTS = Path("docs/results")
COLUMNS = {
    "chamfer": "Chamfer ×1e4 [m²]",
    "chamfer_l1": "L1 Chamfer [mm]",
    "silhouette_iou": "silhouette IoU",
}


def main() -> None:
    """See the module."""
    data = Path(os.environ.get("TOILE_DATA", "data"))
    if not (OUTPUT / DIAGNOSIS_FILE).is_file():
        status = toile_main(("diagnose", "scene=R1", "diagnosis.held_out=0.3", f"hydra.run.dir={OUTPUT}"))
        if status != 0:
            raise SystemExit(status)
    report = GapReport.read(OUTPUT / DIAGNOSIS_FILE)
    scene = load_scene("R1", data)
    with np.load(OUTPUT / TRACKED_FILE) as stored:
        tracked = stored["positions"]
    with np.load(OUTPUT / HELD_OUT_FILE) as stored:
        frames = stored["frames"]
        predicted = {name: stored[name] for name in stored.files if name != "frames"}
    n = int(frames[-1]) + 1
    rows = []
    for name, positions in {**predicted, "tracked with free forces": tracked[frames]}.items():
        motion = tracked[:n].copy()
        motion[frames] = positions
        trajectory = torch.from_numpy(motion).reshape(n, *scene.grid, 3)
        found = evaluate(trajectory, scene, WarpRenderer(), n_frames=n)
        values = {title: found.metrics[key].per_frame[frames].mean() for key, title in COLUMNS.items()}
        away = np.sqrt(((positions - tracked[frames]) ** 2).sum(-1).mean(-1)).mean() * 1e3
        rows.append({"model": name, "to tracked motion [mm]": away, **values})
    table = pd.DataFrame(rows)
    write_text(RESULTS / "r1_diagnosis.csv", table.to_csv(index=False))
    write_text(RESULTS / "r1_diagnosis.json", (OUTPUT / DIAGNOSIS_FILE).read_text())
    verdict = report.verdict
    text = (
        "# The gap on R1\n"
        "Made by `make r1-diagnosis`: 35 frames fitted, "
        f"frames {frames[0]} to {frames[-1]} predicted by open rollouts with nothing refitted. The last row "
        "has seen those frames through free forces.\n\n"
        f"Answer: **{verdict.effect}**{f' and **{verdict.also}**' if verdict.also else ''} "
        f"(probability {verdict.probability:.2f}; 90 % set: {', '.join(verdict.candidates)}). "
        f"{verdict.reason}\n\n" + table.to_markdown(index=False, floatfmt=".3g") + "\n"
    )
    write_text(RESULTS / "r1_diagnosis.md", text)
    print(text)


if __name__ == "__main__":
    main()
