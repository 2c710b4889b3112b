"""The model card of the neural surrogate: docs/surrogate.md, every number of it measured here.

    python benchmarks/surrogate_card.py                           # whatever is missing (hours)
    python benchmarks/surrogate_card.py --only speed              # a part
    python benchmarks/surrogate_card.py --quick --weights FILE    # minutes, tiny, into outputs/

Each part writes its table to docs/results/surrogate/ and is not measured again with the same weights and
settings. The solver's motions, which take longest, are kept in outputs/surrogate_card/. The text of the card
is benchmarks/surrogate/card.md.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# Sets the number of BLAS threads before NumPy is loaded.
import toile.cli  # noqa: F401

# isort: split
import pandas as pd
import torch
from surrogate import figures, tables
from surrogate.accuracy import STRIDE, accuracy
from surrogate.cases import REGIMES, make_cases
from surrogate.contenders import (
    CONVERGED,
    FLOOR,
    HYBRID_CORRECTIONS,
    ONE_NEWTON_STEP,
    contenders,
    hybrid_label,
    surrogate_label,
    usual,
)
from surrogate.gradients import LAST_FRAMES, TARGET, gradients
from surrogate.records import Records, fingerprint
from surrogate.speed import STEPS as SPEED_STEPS
from surrogate.speed import speed
from surrogate.stability import (
    GRAVITY_NUMBER,
    LEAN,
    REST,
    SOLVER_SECONDS,
    WINDOW,
    StabilitySettings,
    stability,
    stability_solver,
)

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.physics.surrogate.surrogate import STEP
from toile.physics.surrogate.weights import describe_weights, load_weights, packaged_weights

ROOT = Path(__file__).resolve().parent.parent
# A window of the default recipe: six frames of two sub-steps.
WINDOW_STEPS = 12
PARTS = ("accuracy", "stability", "gradients", "speed")
TEMPLATE = Path(__file__).parent / "surrogate" / "card.md"
MISSING = "*Not measured yet with these weights.*"


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Attributes:
        grid: (H, W) of everything but stability.
        steps: of the motions whose errors and gradients are measured.
        cases: cloths by regime.
        stability: see there.
        seeds: of the gradients.
        batches: of the speed.
        repeats: of the speed.
    """

    grid: tuple[int, int]
    steps: int
    cases: dict[str, int]
    stability: StabilitySettings
    seeds: int
    batches: tuple[int, ...]
    repeats: int


FULL = Extent(
    grid=(32, 32),
    steps=50,
    cases={"fits": 8, "box": 14, "corners": 8},
    stability=StabilitySettings(),
    seeds=3,
    batches=(1, 8, 32),
    repeats=3,
)
QUICK = Extent(
    grid=(8, 8),
    steps=6,
    cases={"fits": 2, "box": 3, "corners": 2},
    stability=StabilitySettings(grid=(8, 8), steps=20, solver_steps=10, every=5, levels=2),
    seeds=1,
    batches=(1, 2),
    repeats=1,
)


class Measurements:
    """What is measured of some weights, part by part."""

    def __init__(
        self, weights: Path, passes: list[int], extent: Extent, records: Records, cache: Path
    ) -> None:
        self.weights, self.passes, self.extent = weights, passes, extent
        self.records, self.cache = records, cache
        self.contenders = contenders(weights, passes)
        self.about = {
            "weights": weights.name,
            "sha256": fingerprint(weights),
            "step": STEP,
            "passes": passes,
        }

    def accuracy(self) -> None:
        """One table per regime."""
        for regime in REGIMES:
            e = self.extent
            settings = {
                "grid": e.grid,
                "steps": e.steps,
                "cases": e.cases[regime],
                "newton": asdict(CONVERGED),
            }

            def make(regime: str = regime, e: Extent = e) -> pd.DataFrame:
                cases = make_cases(regime, e.cases[regime], e.grid, e.steps)
                return accuracy(cases, self.contenders, self.cache)

            self.records.measure(f"accuracy_{regime}", self.about | settings, make)

    def stability(self) -> None:
        """The fewest passes, which leave the largest errors, and the solver."""
        settings = self.extent.stability
        for n in self.passes[:1]:
            chosen = {surrogate_label(n): self.contenders[surrogate_label(n)]}
            self.records.measure(
                f"stability_{n}",
                self.about | {"passes": [n], **asdict(settings)},
                lambda chosen=chosen: stability(chosen, settings),  # type: ignore[misc]
            )
        self.records.measure(
            "stability_solver",
            {**asdict(settings), "newton": asdict(CONVERGED), "seconds": SOLVER_SECONDS},
            lambda: stability_solver(settings),
        )

    def gradients(self) -> None:
        """Of everything that can be differentiated."""
        e = self.extent
        self.records.measure(
            "gradients",
            self.about | {"grid": e.grid, "steps": e.steps, "seeds": e.seeds},
            lambda: gradients(self.contenders, e.seeds, e.grid, e.steps),
        )
        self.records.measure(
            "gradients_window",
            self.about | {"grid": e.grid, "steps": WINDOW_STEPS, "seeds": e.seeds},
            lambda: gradients(self.contenders, e.seeds, e.grid, WINDOW_STEPS),
        )

    def speed(self) -> None:
        """One table per size of the batch."""
        e = self.extent
        # How long a pass takes hangs on the network's size alone.
        widths = list(load_weights(self.weights).network.widths)
        about = {"widths": widths, "step": STEP, "passes": self.passes}
        for size in e.batches:
            self.records.measure(
                f"speed_{size}",
                about | {"grid": e.grid, "batch": size, "repeats": e.repeats},
                lambda size=size: speed(self.contenders, size, e.grid, e.repeats),  # type: ignore[misc]
            )


def write_card(docs: Path, records: Records, weights: Path, passes: list[int], extent: Extent) -> None:
    """Fill the template with whatever is measured."""
    own = fingerprint(weights)
    names = sorted(path.stem for path in records.folder.glob("*.csv"))
    # Other pages keep their tables there too.
    measured = {name: records.read(name) for name in names if name.partition("_")[0] in PARTS}
    # What was measured of other weights does not belong here.
    known = {
        name: record
        for name, record in measured.items()
        if record is not None and record.about["settings"].get("sha256", own) == own
    }
    made = {f"made_{name}": _made([record.about]) for name, record in known.items()}
    words: dict[str, str] = {
        **made,
        "weights": _weights(weights),
        "stride": str(STRIDE),
        "window": str(WINDOW),
        "rest": f"{REST:g}",
        "protocol": f"Motions of {extent.steps} steps, grids of {extent.grid[0]}×{extent.grid[1]} vertices.",
    }
    pictures = docs / "images" / "surrogate"
    middle, most = surrogate_label(usual(passes)), surrogate_label(max(passes))
    shown = list(
        dict.fromkeys((middle, most, hybrid_label(passes, HYBRID_CORRECTIONS[0]), ONE_NEWTON_STEP, FLOOR))
    )
    accuracies = {r: tables.usable(known[f"accuracy_{r}"].table) for r in REGIMES if f"accuracy_{r}" in known}
    for regime, table in accuracies.items():
        words[f"accuracy_{regime}"] = tables.accuracy_summary(table)
        words[f"failures_{regime}"] = tables.failures(table)
        if regime in tables.BINS:
            words[f"breakdown_{regime}"] = tables.breakdown(table, regime, shown)
    if accuracies:
        words["verdicts"] = "\n".join(
            f"- *{regime}*, {tables.verdict(table, name)}"
            for regime, table in accuracies.items()
            for name in dict.fromkeys((middle, most))
        )
        figures.save(figures.error_distributions(accuracies), pictures / "errors.png")
    if "box" in accuracies:
        figures.save(figures.error_by_number(accuracies["box"], [middle, FLOOR]), pictures / "box.png")
    if "corners" in accuracies:
        words["corner_table"] = tables.corner_table(accuracies["corners"], shown)
    runs = [known[f"stability_{n}"] for n in passes if f"stability_{n}" in known]
    if runs:
        table = pd.concat([run.table for run in runs], ignore_index=True)
        solver = known["stability_solver"].table if "stability_solver" in known else None
        words["stability_counts"] = tables.stability_counts(table)
        words["stability"] = tables.stability_summary(table, solver)
        words["stability_protocol"] = _stability_protocol(runs[0].about["settings"])
        alone = [known["stability_solver"]] if "stability_solver" in known else []
        words["made_stability"] = _made([run.about for run in (*runs, *alone)])
        figures.save(figures.energies(table), pictures / "energies.png")
    if "gradients_window" in known:
        words["gradients_window"] = tables.gradient_table(known["gradients_window"].table)
        words["made_gradients_window"] = _made([known["gradients_window"].about])
    if "gradients" in known:
        settings = known["gradients"].about["settings"]
        words["gradients"] = tables.gradient_table(known["gradients"].table)
        words["gradient_protocol"] = (
            f"Motions of {settings['steps']} steps as fits have them, {settings['seeds']} seeds; squared "
            f"distance of the last {min(LAST_FRAMES, settings['steps'] + 1)} frames to a target that "
            f"deviates smoothly from the solver's motion by about {100 * TARGET:g} % of the width."
        )
    runs = [known[f"speed_{size}"] for size in extent.batches if f"speed_{size}" in known]
    if runs:
        abouts = [run.about for run in runs]
        words["speed"] = tables.speed_table(pd.concat([run.table for run in runs], ignore_index=True))
        words["made_speed"] = _made(abouts)
        words["speed_conditions"] = (
            f"Median of {abouts[0]['settings']['repeats']} rounds of {SPEED_STEPS} steps, all in turn. "
            + _busy(max(about["load before"] for about in abouts))
        )
    text = re.sub(r"\{\{(\w+)\}\}", lambda m: words.get(m[1], MISSING), TEMPLATE.read_text(encoding="utf-8"))
    text = re.sub(r"!\[.*\]\((.*)\)", lambda m: m[0] if (docs / m[1]).exists() else MISSING, text)
    print(f"written: {write_text(docs / 'surrogate.md', text)}")


def _made(abouts: list[dict[str, Any]]) -> str:
    """How tables were made; those of one command on one machine together."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for about in abouts:
        words = (
            f"`{about['command']}` on {about['machine']}, {about['threads']} thread, torch {about['torch']}"
        )
        groups.setdefault(words, []).append(about)
    lines = []
    for words, group in groups.items():
        first, settings = group[0], group[0]["settings"]
        seconds = " + ".join(f"{about['seconds']:.0f}" for about in group)
        of = f"; {settings['weights']}, sha256 {settings['sha256']}…" if "weights" in settings else ""
        size = f"{settings['grid'][0]}×{settings['grid'][1]} vertices"
        lines.append(
            f"{words}: {seconds} s from {first['date']}, load {first['load before']} before{of}; {size}."
        )
    return "\n\n".join(lines)


def _busy(load: float) -> str:
    """The load of the machine while times were taken, in words."""
    if load < 0.5:
        return "The machine was idle otherwise."
    return (
        f"Other programs kept the machine busy (load {load} before): caches and memory were shared, so that "
        "the ratios mean more than the times."
    )


def _stability_protocol(settings: dict[str, Any]) -> str:
    height, width = settings["grid"]
    return (
        f"{settings['levels'] ** 3} materials, the corners of the training box and the geometric means "
        f"between them, as one batch; {settings['steps']:,} steps of backward Euler on {height}×{width} "
        f"vertices, gravity {GRAVITY_NUMBER:g} network units, upper corners held still, from a flat sheet "
        f"that leans by {LEAN:g}°. Energy is kinetic, internal and that of gravity, above the start, in "
        f"units of weight × side. The solver does the first {settings['solver_steps']:,} steps, "
        f"{SOLVER_SECONDS:g} s for each material at most."
    )


def _weights(path: Path) -> str:
    """What the file of the weights says about itself."""
    rows = [{"": key, "value": value} for key, value in describe_weights(path).items()]
    rows.insert(0, {"": "file", "value": f"{path.name}, sha256 {fingerprint(path)}…"})
    return tables.frame(pd.DataFrame(rows))


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--weights", type=Path, help="file written by toile train; default: the package's")
    parser.add_argument("--passes", type=int, nargs="+", default=[1, 2, 4], help="per step")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--quick", action="store_true", help="tiny, to see whether everything works")
    parser.add_argument(
        "--docs", type=Path, help="folder of the card; default: docs, with --quick in outputs"
    )
    options = parser.parse_args()
    if min(options.passes) < 1:
        parser.error(f"--passes: expected numbers of at least 1, got {min(options.passes)}")
    options.passes = sorted(set(options.passes))
    return options


def main() -> None:
    """See the module's text."""
    options = arguments()
    torch.set_num_threads(1)
    outputs = ROOT / "outputs" / "surrogate_card"
    weights = options.weights or packaged_weights()
    extent = QUICK if options.quick else FULL
    docs = options.docs or (outputs / "quick" if options.quick else ROOT / "docs")
    records = Records(docs / "results" / "surrogate")
    try:
        describe_weights(weights)
    except InputError as error:
        sys.exit(f"error: {error}")
    measurements = Measurements(weights, options.passes, extent, records, outputs / "solver")
    for part in PARTS:
        if part in options.only:
            getattr(measurements, part)()
    write_card(docs, records, weights, options.passes, extent)


if __name__ == "__main__":
    main()
