"""The same fits with the solver, the hybrid and the surrogate: accuracy and time side by side.

    python benchmarks/simulators.py                    # R1 and a generated scene, seed 0
    python benchmarks/simulators.py --seeds 0 1 2
    python benchmarks/simulators.py --track-only       # without the stage that calibrates the stiffness

One fit after the other on one machine, so that the ratios mean something; finished runs are not run again.
Writes docs/results/simulators.csv, simulators.md and the table in the README.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import pandas as pd
from results import ROOT, fit, insert, machine, markdown, mean_of, toile

# Name in the table and what selects it; the solver comes first, ratios are to it.
CONTENDERS = {
    "implicit (solver)": ["simulator=implicit"],
    "surrogate, 2 passes": ["simulator=surrogate"],
    "hybrid, 1 pass and up to 2 Newton steps": ["simulator=hybrid"],
    "no network, up to 2 Newton steps": ["simulator=hybrid", "simulator.build.predictor=null"],
}
# Of the generated scene; R1 is taken whole.
GENERATED_FRAMES = 25


def row(scene: str, name: str, seed: int, folder: Path, metrics: dict[str, Any]) -> dict[str, Any]:
    """One line of the table."""
    return {
        "scene": scene,
        "simulator": name,
        "seed": seed,
        "chamfer x1e4 [m²]": mean_of(metrics, "chamfer"),
        "vertex error [% of width]": mean_of(metrics, "vertex_error_percent"),
        "silhouette IoU": mean_of(metrics, "silhouette_iou"),
        "fit [s]": metrics["fit"]["seconds of the fit"],
        "cpu [s]": metrics["fit"]["processor seconds of the fit"],
        "run": str(folder.relative_to(ROOT)),
    }


def measure(seeds: list[int], only: list[str] | None, extra: list[str], outputs: Path) -> pd.DataFrame:
    """Every scene with every simulator and seed."""
    generated = outputs / "generated_scene"
    if not (generated / "scene.json").exists():
        toile("generate", f"folder={generated}", "settings.name=generated_scene")
    scenes = {
        "R1": ["scene=R1"],
        "generated": [
            f"scene.name={generated}",
            "cloth/rest_lengths=uniform",
            f"scene.n_frames={GENERATED_FRAMES}",
        ],
    }
    rows = []
    for scene, selection in scenes.items():
        for name, overrides in CONTENDERS.items():
            if only and not any(word in name for word in only):
                continue
            for seed in seeds:
                words = [scene, name, f"seed{seed}", *(["track only"] if extra else [])]
                slug = "".join(c if c.isalnum() else "_" for c in "_".join(words))
                folder = outputs / slug
                metrics = fit(selection, folder, seed, *overrides, *extra)
                if metrics is not None:
                    rows.append(row(scene, name, seed, folder, metrics))
    return pd.DataFrame(rows)


def with_ratios(table: pd.DataFrame) -> pd.DataFrame:
    """Means over seeds, and how many times less of the processor than the solver on the same scene."""
    columns = ["chamfer x1e4 [m²]", "vertex error [% of width]", "silhouette IoU", "fit [s]", "cpu [s]"]
    means = table.groupby(["scene", "simulator"], sort=False)[columns].mean().reset_index()
    solver = means[means.simulator == next(iter(CONTENDERS))].set_index("scene")["cpu [s]"]
    means["times faster"] = means.scene.map(solver) / means["cpu [s]"]
    return means


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", nargs="*", type=int, default=[0])
    parser.add_argument("--only", nargs="*", help="words that a contender's name must contain one of")
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "simulators")
    parser.add_argument("--track-only", action="store_true", help="with the stiffness that fits start from")
    options = parser.parse_args()
    extra = ["optimization.stages.calibrate=null"] if options.track_only else []
    outputs = options.outputs.resolve()
    outputs.mkdir(parents=True, exist_ok=True)
    table = measure(options.seeds, options.only, extra, outputs)
    docs = ROOT / "docs" / "results"
    docs.mkdir(parents=True, exist_ok=True)
    table.to_csv(docs / "simulators.csv", index=False)
    text = markdown(with_ratios(table), ".3g")
    where = machine(ROOT / table.run.iloc[0] / "metrics.json")
    command = "`python benchmarks/simulators.py --seeds " + " ".join(map(str, options.seeds))
    command += " --track-only`" if options.track_only else "`"
    how = "one fit after the other; times faster by the processor's seconds"
    text = f"{command}, on {where}; {how}.\n\n{text}\n"
    (docs / "simulators.md").write_text(text)
    insert(ROOT / "README.md", "simulators", text.strip())
    print(text)


if __name__ == "__main__":
    main()
