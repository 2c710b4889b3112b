"""Stability (paper, section 4.3 and Fig. 8): fits 40 times longer than usual, Chamfer distance on the way.

    python benchmarks/stability.py                # a generated scene, small enough for one CPU core
    python benchmarks/stability.py --scene R1     # a scene of the data folder: half a day
    python benchmarks/stability.py --only paper   # a part
    python benchmarks/stability.py --draw         # what there is so far, without running anything

Finished runs are not run again, interrupted ones go on. Writes docs/results/stability.csv, stability.md and
docs/images/stability.png; for another scene than the generated one, the same files beside its runs.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from results import ROOT, fit, machine, markdown, toile

from toile.learning.fit.callbacks.chamfer import CHAMFER, COVERED, CYCLE
from toile.reports.figures import save_figure, stability_curves
from toile.scenes.registry import load_scene

LONGER = 40
GENERATED = "generated"
# So small that ten thousand cycles take minutes.
SETTINGS = (
    "preset=demo",
    "pinned_motion=shake",
    "settings.name=stability",
    "settings.grid=[12,12]",
    "settings.n_frames=16",
    "settings.image_size=[96,96]",
    "settings.focal_length=140",
    "texture.height=256",
    "texture.width=256",
)


@dataclass(frozen=True)
class Case:
    """One curve.

    Attributes:
        name: in the table and the figure.
        overrides: what selects it.
        usual: cycles of the usual fit; None: two passes over the clip.
        every: cycles between two evaluations; None: one pass over the clip.
    """

    name: str
    overrides: tuple[str, ...]
    usual: int | None
    every: int | None


CASES = {
    "tracking": Case(
        "default recipe: calibration once, then 79 passes of tracking",
        ("experiment=stability_tracking",),
        None,
        None,
    ),
    "calibration": Case(
        "79 passes of calibration, then tracking once",
        (
            "experiment=stability_tracking",
            "optimization.stages.calibrate.windows.repeats=79",
            "optimization.stages.track.windows.repeats=1",
        ),
        None,
        None,
    ),
    "paper": Case("the paper's recipe, exact solver", ("experiment=stability",), 250, 50),
}
# Columns of a history that say whether a fit has run away.
WATCHED = {
    "Y": "stretching [network units]",
    "S": "shearing [network units]",
    "B": "bending [network units]",
    "turbulence rms [m/s²]": "turbulence rms [m/s²]",
    "boundary motion rms [mm]": "boundary motion rms [mm]",
}


def run(scene: list[str], one_pass: int, outputs: Path, only: list[str] | None) -> None:
    """Fit every case, one after the other."""
    for key, case in CASES.items():
        if only and key not in only:
            continue
        every = f"callbacks.chamfer.every={case.every or one_pass}"
        fit(scene, outputs / key, 0, *case.overrides, every)


def curve(case: Case, folder: Path, one_pass: int) -> pd.DataFrame | None:
    """Chamfer distance after the cycles that have seen every frame; None where there is nothing yet."""
    file = folder / "chamfer.csv"
    if not file.exists():
        return None
    table = pd.read_csv(file)
    table = table[table[COVERED] == one_pass + 1].copy()
    table["times"] = (table[CYCLE] + 1) / (case.usual or 2 * one_pass)
    return table if len(table) else None


def rows(case: Case, curve: pd.DataFrame, folder: Path, one_pass: int) -> list[dict[str, object]]:
    """One line for the usual length and one for where the run has come to."""
    file = folder / "history.csv"
    history = pd.read_csv(file) if file.exists() else None
    after = curve[curve["times"] >= 1]
    found = []
    for at in (after.iloc[0], after.iloc[-1]) if len(after) else ():
        cycle = int(at[CYCLE])
        line: dict[str, object] = {
            "recipe": case.name,
            "length": f"{at['times']:.3g}×",
            "cycles": cycle + 1,
            "chamfer x1e4 [m²]": at[CHAMFER],
            "worst since the usual length": after[after[CYCLE] <= cycle][CHAMFER].max(),
        }
        # An interrupted run has written its history, and gone on since.
        if history is not None and cycle < len(history):
            line |= {name: history[column].iloc[cycle] for name, column in WATCHED.items()}
            line["seconds"] = history["seconds"].iloc[: cycle + 1].sum()
        found.append(line)
    return found


def write(
    curves: Mapping[str, pd.DataFrame], scene: str, one_pass: int, outputs: Path, docs: Path, image: Path
) -> None:
    """Table, CSV and figure of whatever curves there are."""
    lines = [line for key, c in curves.items() for line in rows(CASES[key], c, outputs / key, one_pass)]
    table = pd.concat([c.assign(run=key) for key, c in curves.items()])
    docs.mkdir(parents=True, exist_ok=True)
    table.to_csv(docs / "stability.csv", index=False)
    finished = [outputs / key / "metrics.json" for key in curves if (outputs / key / "metrics.json").exists()]
    where = machine(finished[0]) if finished else "an unfinished run"
    text = markdown(pd.DataFrame(lines), ".3g")
    head = (
        f"`make stability`, {scene}, on {where}. Chamfer unaligned, of all frames; Y, S, B in network units."
    )
    (docs / "stability.md").write_text(f"{head}\n\n{text}\n")
    labelled = {CASES[key].name: (c["times"].to_numpy(), c[CHAMFER].to_numpy()) for key, c in curves.items()}
    save_figure(stability_curves(labelled, f"{scene}: fits {LONGER} times longer than usual"), image)
    print(text)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default=GENERATED, help="a scene of the data folder, e.g. R1")
    parser.add_argument("--only", nargs="*", choices=list(CASES))
    parser.add_argument("--draw", action="store_true", help="run nothing")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "stability")
    options = parser.parse_args()
    outputs = options.outputs.resolve() / options.scene
    outputs.mkdir(parents=True, exist_ok=True)
    docs, image = outputs, outputs / "stability.png"
    scene, title = [f"scene={options.scene}"], options.scene
    if options.scene == GENERATED:
        folder = outputs / "scene"
        if not (folder / "scene.json").exists():
            toile("generate", f"folder={folder}", *SETTINGS)
        scene = [f"scene={folder}", "cloth/rest_lengths=uniform"]
        title = "generated scene, 12×12 vertices, 16 frames"
        docs, image = ROOT / "docs" / "results", ROOT / "docs" / "images" / "stability.png"
    name = str(scene[0]).partition("=")[2]
    one_pass = load_scene(name, os.environ.get("TOILE_DATA", "data")).n_frames - 1
    if not options.draw:
        run(scene, one_pass, outputs, options.only)
    found = {key: curve(case, outputs / key, one_pass) for key, case in CASES.items()}
    curves = {key: c for key, c in found.items() if c is not None}
    if curves:
        write(curves, title, one_pass, outputs, docs, image)


if __name__ == "__main__":
    main()
