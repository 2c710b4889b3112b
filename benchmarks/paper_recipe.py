"""The paper's recipe on R1: what keeps it from the published accuracy, one factor at a time.

    python benchmarks/paper_recipe.py                       # everything (hours on one core)
    python benchmarks/paper_recipe.py --only factors        # the first frames, one factor at a time
    python benchmarks/paper_recipe.py --only fits --seeds 0 # the whole clip
    python benchmarks/paper_recipe.py --cases "as it is" solver  # some lines of the tables
    python benchmarks/paper_recipe.py --write               # the tables of what there is so far

One fit after the other. Every finished run leaves a JSON file in outputs/paper_recipe and is not run again;
an interrupted one goes on from its last checkpoint. Writes docs/results/paper_recipe.csv and paper_recipe.md,
in which lines stay that have not been run here; ``weights`` says which network a line is of, and which step
surrounds it.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from results import ROOT, machine, markdown, mean_of, toile
from surrogate.records import fingerprint

from toile import evaluate
from toile.physics.surrogate.surrogate import STEP
from toile.physics.surrogate.weights import packaged_weights

BASE = ("scene=R1", "experiment=paper")
# The first frames, with a window that grows faster than in the paper, so that a factor takes a minute.
FRAMES, CYCLES, FIRST, PER_FRAME = 14, 30, 8, 4
SHORT = (
    f"scene.n_frames={FRAMES}",
    f"optimization.cycles={CYCLES}",
    f"optimization.first_frames={FIRST}",
    f"optimization.cycles_per_frame={PER_FRAME}",
)
FIT_SEED = 0
NETWORK = "simulator=surrogate"
KEY = ["part", "case", "seed"]
_RATES = "optimization.learning_rates"


@dataclass(frozen=True)
class Case:
    """One line of a table, or one per seed.

    Attributes:
        part: which table.
        name: what is different.
        overrides: of ``toile fit scene=R1 experiment=paper``.
    """

    part: str
    name: str
    overrides: tuple[str, ...] = ()


def _factor(name: str, *overrides: str) -> Case:
    return Case("factors", name, (*SHORT, *overrides))


CASES = (
    Case("fits", "solver"),
    Case("fits", "network, backpropagation", (NETWORK, "simulator/gradient=backprop")),
    Case("fits", "network, implicit derivative", (NETWORK,)),
    Case("fits", "solver, Eq. 17 as printed", ("loss=paper",)),
    _factor("as it is"),
    _factor("Eq. 17 as printed", "loss=paper"),
    _factor("Eq. 17 with its weights, but means", "loss=paper", "loss.force_regularization.reduction=mean"),
    _factor("no force regularisation", "loss.force_regularization=null"),
    _factor(
        "texture coordinates projected",
        "scene.texture_coordinates._target_=toile.scenes.texture_coordinates.projected",
    ),
    _factor("texture coordinates fixed", f"{_RATES}.texture_offset=null"),
    _factor("rest lengths of the template", "cloth/rest_lengths=template"),
    _factor("no silhouette", "loss.silhouette=null"),
    _factor("image on three scales", "loss=pyramid"),
    _factor("forces learn 3 times faster", f"{_RATES}.turbulence=3e-3"),
    _factor(
        "stiffness fixed",
        *(f"{_RATES}.{name}=null" for name in ("stretching", "shearing", "bending")),
    ),
    _factor("all frames from the start", "optimization.first_frames=null"),
    _factor("three times the cycles", "optimization.cycles=90", "optimization.cycles_per_frame=12"),
)

PARTS = {
    "fits": (
        "The whole clip",
        "250 cycles, 50 frames. The recipe draws no random numbers; seeds move the samples of the metric.",
    ),
    "factors": (
        "One factor at a time",
        f"The first {FRAMES} frames, {CYCLES} cycles, begun with {FIRST} frames and one more every "
        f"{PER_FRAME} cycles; exact solver. Every line changes one thing of `experiment=paper`.",
    ),
}
HEAD = (
    "# The paper's recipe\n\n`make paper-recipe` on {machine}. `toile fit scene=R1 experiment=paper` and "
    "what is in the column of overrides. Chamfer unaligned; Y, S, B in network units; losses of the last "
    "cycle. What follows from it: [results](../results.md#the-papers-recipe)."
)


def slug(case: Case, seed: int) -> str:
    """Name of a run's folder and file."""
    words = f"{case.part}_{case.name}_seed{seed}"
    return "".join(c if c.isalnum() else "_" for c in words)


def measured(case: Case, seed: int, outputs: Path) -> dict[str, Any] | None:
    """Numbers of a run; it is made, or finished, if there are none yet. None where it failed.

    A fit is the same whatever its seed (tests/unit/reconstruction/test_adam.py), so it is made once and
    measured with every seed.
    """
    name = slug(case, seed)
    file, folder, spent = outputs / f"{name}.json", outputs / name, outputs / f"{name}.spent.json"
    if file.exists():
        return dict(json.loads(file.read_text()))
    if seed != FIT_SEED:
        fitted = measured(case, FIT_SEED, outputs)
        if fitted is None:
            return None
        metrics = evaluate(ROOT / fitted["run"], seed=seed).to_dict()
        row = fitted | {"seed": seed} | of_evaluation(metrics)
        file.write_text(json.dumps(row, indent=1))
        return row
    before = json.loads(spent.read_text()) if spent.exists() else {"cpu": 0.0, "wall": 0.0}
    wall, cpu = time.perf_counter(), _children()
    toile(
        "fit",
        *BASE,
        *case.overrides,
        f"seed={seed}",
        f"hydra.run.dir={folder}",
        "report.page=false",
        "report.video=false",
        "logger=none",
        "callbacks.pictures=null",
        "callbacks.layout=null",
    )
    before = {"cpu": before["cpu"] + _children() - cpu, "wall": before["wall"] + time.perf_counter() - wall}
    if not (folder / "metrics.json").exists():
        outputs.mkdir(parents=True, exist_ok=True)
        spent.write_text(json.dumps(before))
        return None
    row = numbers(case, seed, folder) | {"cpu [s]": before["cpu"], "wall [s]": before["wall"]}
    file.write_text(json.dumps(row, indent=1))
    spent.unlink(missing_ok=True)
    return row


def _children() -> float:
    """Processor seconds of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def of_evaluation(metrics: dict[str, Any]) -> dict[str, float]:
    """Numbers that need the ground truth."""
    per_frame = pd.Series(metrics["metrics"]["chamfer"]["per_frame"], dtype=float)
    return {
        "chamfer x1e4 [m²]": mean_of(metrics, "chamfer"),
        "chamfer, last fifth of the frames": float(per_frame[-max(1, len(per_frame) // 5) :].mean()),
        "point to surface [mm]": mean_of(metrics, "point_to_surface"),
        "silhouette IoU": mean_of(metrics, "silhouette_iou"),
    }


def numbers(case: Case, seed: int, folder: Path) -> dict[str, Any]:
    """What a finished run has come to."""
    metrics = json.loads((folder / "metrics.json").read_text())
    last = pd.read_csv(folder / "history.csv").iloc[-1]
    log = folder / "fit.log"
    return {
        "part": case.part,
        "case": case.name,
        "seed": seed,
        **of_evaluation(metrics),
        "image loss": float(last.get("loss image", float("nan"))),
        "silhouette loss": float(last.get("loss silhouette", float("nan"))),
        "Y": float(last["stretching [network units]"]),
        "S": float(last["shearing [network units]"]),
        "B": float(last["bending [network units]"]),
        "turbulence rms [m/s²]": float(last["turbulence rms [m/s²]"]),
        "cycles": int(last["cycle"]) + 1,
        "updates halved": log.read_text().count("the last update was") if log.exists() else 0,
        "overrides": " ".join(case.overrides),
        "weights": f"{fingerprint(packaged_weights())}, {STEP}" if NETWORK in case.overrides else "",
        "run": str(folder.relative_to(ROOT)),
    }


def table(cases: Sequence[Case], seeds: Sequence[int], outputs: Path, *, run: bool) -> pd.DataFrame:
    """All runs that there are, one line each; with ``run``, those that are missing are made."""
    rows = []
    for case in cases:
        for seed in seeds:
            file = outputs / f"{slug(case, seed)}.json"
            if run or file.exists():
                row = measured(case, seed, outputs)
                if row is not None:
                    rows.append(row)
    return pd.DataFrame(rows)


def write(found: pd.DataFrame, outputs: Path) -> None:
    """docs/results/paper_recipe.csv and .md."""
    docs = ROOT / "docs" / "results"
    found.to_csv(docs / "paper_recipe.csv", index=False, float_format="%.5g")
    here = next(outputs.glob("*/metrics.json"), None)
    where = "another machine" if here is None else machine(here)
    parts = [HEAD.format(machine=where)]
    for part, (title, text) in PARTS.items():
        rows = found[found.part == part]
        if len(rows):
            shown = rows.drop(columns=["part", "run", *(["seed"] if rows.seed.nunique() < 2 else [])])
            shown = shown.assign(overrides=[f"`{o}`" if o else "" for o in rows.overrides.fillna("")])
            parts += [f"## {title}", text, markdown(shown, ".3g")]
    (docs / "paper_recipe.md").write_text("\n\n".join(parts) + "\n")


def with_known(found: pd.DataFrame, known: Path) -> pd.DataFrame:
    """Lines of the table that is there and that have not been run here, beside those that have."""
    if not known.is_file():
        return found
    before = pd.read_csv(known)
    order = {case.name: k for k, case in reversed(list(enumerate(CASES)))}
    both = pd.concat([one for one in (found, before) if len(one)]).drop_duplicates(KEY)
    both = both.fillna({"overrides": "", "weights": ""})
    return both.sort_values(["case", "seed"], key=lambda c: c.map(order) if c.name == "case" else c)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=list(PARTS), default=list(PARTS))
    parser.add_argument(
        "--seeds", nargs="*", type=int, default=[0, 1, 2], help="of the fits of the whole clip"
    )
    parser.add_argument("--cases", nargs="*", choices=[c.name for c in CASES], help="run no others")
    parser.add_argument("--write", action="store_true", help="run nothing")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "paper_recipe")
    options = parser.parse_args()
    outputs = options.outputs.resolve()
    outputs.mkdir(parents=True, exist_ok=True)
    tables = []
    for part in PARTS:
        cases = [case for case in CASES if case.part == part and case.name in (options.cases or [case.name])]
        seeds = options.seeds if part == "fits" else [FIT_SEED]
        tables.append(table(cases, seeds, outputs, run=not options.write and part in options.only))
    found = with_known(pd.concat(tables), ROOT / "docs" / "results" / "paper_recipe.csv")
    if len(found):
        write(found, outputs)
        print(markdown(found.drop(columns=["run", "overrides"]), ".3g"))


if __name__ == "__main__":
    main()
