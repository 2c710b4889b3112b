"""The README's results: every number from a run of the command line, with the folder it came from.

    python benchmarks/results.py                      # everything the data folder allows
    python benchmarks/results.py --only R1 --seeds 0  # a part
    python benchmarks/results.py --only --no-identification --variants "backward Euler"  # one variant anew

Runs one fit after the other (two at a time would compete for the cores), skips runs that have finished, and
writes docs/results/results.csv, results.md, identification.md and, with --variants, variants.csv and .md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

ROOT = Path(__file__).resolve().parent.parent
INDEPENDENT = ("a1cb40", "23a8be", "69da5d", "dbab90", "f6e34f")
PARAMETERS = ("stretching", "shearing", "bending")
# Identification starts from these values, whatever the truth is; network units.
START = {"stretching": 3000.0, "shearing": 8.0, "bending": 0.5}

_ALONE = "optimization.stages.calibrate=null"
_TRACK = "optimization.stages.track"
# One factor at a time, on R1, against the second stage alone: what it brings, and what it costs to leave out.
VARIANTS = {
    "second stage alone": [_ALONE],
    "shear 8 instead of 20": [_ALONE, "parameters.shearing=8"],
    "shear 50": [_ALONE, "parameters.shearing=50"],
    "ten times the mask weight": [_ALONE, f"{_TRACK}.term.mask_weight=576"],
    "colours as they are": [_ALONE, f"{_TRACK}.term.neighbourhood=null"],
    "weaker and smoother forces": [
        _ALONE,
        f"{_TRACK}.priors.turbulence=3",
        f"{_TRACK}.priors.turbulence_time=2",
        f"{_TRACK}.priors.turbulence_space=4",
    ],
    "backward Euler": [_ALONE, "simulator/integrator=backward_euler"],
    "one step per frame": [_ALONE, "simulator.substeps=1"],
    "equal rest lengths": [_ALONE, "cloth/rest_lengths=uniform"],
    "the paper's recipe, exact solver": ["experiment=paper"],
}
# Fits of half an hour that another command makes: rows of docs/results/paper_recipe.csv.
OF_PAPER_RECIPE = {"the paper's recipe, exact solver": "solver"}

# As re-evaluated in 2025 on R1 without alignment (nsft), and the papers' own times.
PUBLISHED = (
    ("image-guided SfT (nsft, 2025)", "0.66", "2–3 min", "V100"),
    ("PgSfT (CVPR 2024)", "6.05", "about 2.7 min", "A100"),
    ("φ-SfT (CVPR 2022)", "9.36", "about 1200 min", "GPU"),
)
EFFECTS = {
    "a1cb40": "none",
    "23a8be": "air drag",
    "69da5d": "internal damping",
    "dbab90": "moving light",
    "f6e34f": "vortex of air",
}


def toile(*arguments: str) -> None:
    """Run one command; its failure is reported and does not stop the rest."""
    command = [str(Path(sys.executable).parent / "toile"), *arguments]
    print("$", " ".join(command), flush=True)
    status = subprocess.run(command, cwd=ROOT, check=False).returncode
    if status:
        print(f"failed with exit status {status}", flush=True)


def fit(scene: list[str], folder: Path, seed: int, *extra: str) -> dict[str, Any] | None:
    """Fit once; an existing result is read."""
    metrics = folder / "metrics.json"
    if not metrics.exists():
        toile("fit", *scene, f"seed={seed}", f"hydra.run.dir={folder}", "report.video=false", *extra)
    return json.loads(metrics.read_text()) if metrics.exists() else None


def mean_of(metrics: dict[str, Any], key: str) -> float:
    """Mean over the frames of one metric, nan where the scene does not allow it."""
    return float(metrics.get("metrics", {}).get(key, {}).get("mean", float("nan")))


def reconstruction_table(only: list[str] | None, seeds: list[int], outputs: Path) -> pd.DataFrame:
    """One row per scene, recipe and seed."""
    rows = []
    cases = [("R1", ["scene=R1"], seeds)] + [(n, [f"scene.name={n}"], seeds[:1]) for n in INDEPENDENT]
    for name, scene, its_seeds in cases:
        if only is not None and name not in only:
            continue
        for seed in its_seeds:
            folder = outputs / f"{name}_seed{seed}"
            metrics = fit(scene, folder, seed)
            if metrics is None:
                continue
            rows.append(
                {
                    "scene": name,
                    "seed": seed,
                    "chamfer x1e4 [m²]": mean_of(metrics, "chamfer"),
                    "vertex error [% of width]": mean_of(metrics, "vertex_error_percent"),
                    "point to surface [mm]": mean_of(metrics, "point_to_surface"),
                    "normal error [deg]": mean_of(metrics, "normal_error"),
                    "silhouette IoU": mean_of(metrics, "silhouette_iou"),
                    "fit [s]": metrics["fit"]["seconds of the fit"],
                    "total [s]": metrics["fit"]["seconds in total"],
                    "run": str(folder.relative_to(ROOT)),
                }
            )
    return pd.DataFrame(rows)


def variants_table(outputs: Path, names: Sequence[str], stored: Path) -> pd.DataFrame:
    """R1 with one factor changed at a time; the paper's recipe as ``make paper-recipe`` has it.

    Args:
        outputs: folder of the runs.
        names: of the variants to run; none for all. Rows of the others are as they were.
        stored: table of an earlier call, if there is one.
    """
    before = pd.read_csv(stored).set_index("variant") if stored.exists() else pd.DataFrame()
    rows = []
    for name, overrides in VARIANTS.items():
        if names and name not in names:
            if name in before.index:
                rows.append({"variant": name, **before.loc[name]})
            continue
        if name in OF_PAPER_RECIPE:
            rows += paper_recipe_row(name, stored.parent / "paper_recipe.csv")
            continue
        folder = outputs / ("variant_" + name.replace(" ", "_").replace(",", "").replace("'", ""))
        metrics = fit(["scene=R1"], folder, 0, *overrides)
        if metrics is None:
            continue
        rows.append(
            {
                "variant": name,
                "chamfer x1e4 [m²]": mean_of(metrics, "chamfer"),
                "point to surface [mm]": mean_of(metrics, "point_to_surface"),
                "silhouette IoU": mean_of(metrics, "silhouette_iou"),
                "fit [s]": metrics["fit"]["seconds of the fit"],
                "processor [s]": metrics["fit"].get("processor seconds of the fit"),
                "overrides": " ".join(f"`{o}`" for o in overrides),
            }
        )
    return pd.DataFrame(rows)


def paper_recipe_row(name: str, table: Path) -> list[dict[str, Any]]:
    """The row of a variant that ``make paper-recipe`` has measured; none if it has not."""
    found = pd.read_csv(table) if table.exists() else pd.DataFrame(columns=["part", "case", "seed"])
    found = found[(found.part == "fits") & (found.case == OF_PAPER_RECIPE[name])].sort_values("seed")
    same = ("chamfer x1e4 [m²]", "point to surface [mm]", "silhouette IoU")
    return [
        {
            "variant": name,
            **{key: row.get(key) for key in same},
            "fit [s]": row["wall [s]"],
            "processor [s]": row["cpu [s]"],
            "overrides": " ".join(f"`{o}`" for o in VARIANTS[name]),
        }
        for _, row in found.head(1).iterrows()
    ]


def identification_table(outputs: Path) -> pd.DataFrame:
    """Truth, start and estimate of every parameter of a generated scene."""
    scene = outputs / "identification_scene"
    if not (scene / "scene.json").exists():
        toile("generate", f"folder={scene}", "settings.name=identification_scene")
    start = [f"parameters.{name}={value}" for name, value in START.items()]
    folder = outputs / "identification_fit"
    metrics = fit(
        [f"scene.name={scene}"],
        folder,
        0,
        "optimization=identification",
        "cloth/rest_lengths=uniform",
        *start,
    )
    if metrics is None:
        return pd.DataFrame()
    truth = json.loads((scene / "ground_truth" / "truth.json").read_text())
    history = pd.read_csv(folder / "history.csv").iloc[-1]
    rows = []
    for name in PARAMETERS:
        true, found = truth["network_units"][name], float(history[f"{name} [network units]"])
        rows.append((name, "network units", START[name], true, found, f"{100 * (found / true - 1):+.1f} %"))
    for axis, true in zip("xz", (truth["wind"][0], truth["wind"][2]), strict=True):
        found = float(history[f"wind {axis} [m/s²]"])
        rows.append((f"wind {axis}", "m/s²", 0.0, true, found, f"{found - true:+.3f}"))
    error = mean_of(metrics, "vertex_error_percent")
    rows.append(("mean vertex error", "% of width", float("nan"), 0.0, error, f"{error:.3f}"))
    return pd.DataFrame(rows, columns=["parameter", "unit", "start", "truth", "found", "error"])


def spread(values: pd.Series, digits: int) -> str:
    """Mean ± standard deviation, or the mean where there is one value."""
    mean = f"{values.mean():.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {values.std():.{digits}f}"


def machine(metrics: Path) -> str:
    """What a run says about the machine that it ran on."""
    m = json.loads(metrics.read_text())["machine"]
    return f"{m['processor']}, {m['processors']} cores, {m['threads']} thread"


def readme_section(table: pd.DataFrame, identification: str) -> str:
    """The results as the README shows them."""
    r1 = table[table.scene == "R1"]
    where = machine(ROOT / r1.run.iloc[0] / "metrics.json")
    head = "| R1, real video | Chamfer ×10⁴ [m²], unaligned | time of the fit | on |\n|---|---|---|---|"
    ours = f"| **toile** ({len(r1)} seeds) | **{spread(r1['chamfer x1e4 [m²]'], 3)}** "
    ours += f"| {spread(r1['fit [s]'], 0)} s | {where} |"
    rows = [f"| {' | '.join(cells)} |" for cells in PUBLISHED]
    others = table[table.scene != "R1"]
    second = (
        "| scenes of an independent engine | unmodelled effect | mean vertex error [% of width] | fit [s] |"
    )
    lines = [
        f"| {name} | {EFFECTS.get(name, '')} | {error:.2f} | {seconds:.0f} |"
        for name, error, seconds in zip(
            others.scene, others["vertex error [% of width]"], others["fit [s]"], strict=True
        )
    ]
    parts = ["\n".join((head, ours, *rows)), "\n".join((second, "|---|---|---|---|", *lines))]
    if identification:
        parts.append(
            "Stiffness and wind of a generated scene (simulated on a finer grid and step than the fit's):"
        )
        parts.append(identification.strip())
    return "\n\n".join(parts)


def markdown(table: pd.DataFrame, floatfmt: str) -> str:
    """A table for people: a dash where there is no number."""
    known = table.astype(object).where(table.notna(), None)
    return str(known.to_markdown(index=False, floatfmt=floatfmt, missingval="–"))


def insert(file: Path, marker: str, text: str) -> None:
    """Replace what stands between the two markers."""
    start, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    before, _, rest = file.read_text().partition(start)
    _, _, after = rest.partition(end)
    file.write_text(f"{before}{start}\n{text}\n{end}{after}")


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", help="scene names; nothing for no scene")
    parser.add_argument("--seeds", nargs="*", type=int, default=[0, 1, 2])
    parser.add_argument("--outputs", type=Path, default=ROOT / "outputs" / "results")
    parser.add_argument("--no-identification", action="store_true")
    parser.add_argument(
        "--variants",
        nargs="*",
        choices=list(VARIANTS),
        metavar="NAME",
        help="also vary one factor at a time (half an hour), or these factors alone",
    )
    options = parser.parse_args()
    options.outputs.mkdir(parents=True, exist_ok=True)
    docs = ROOT / "docs" / "results"
    docs.mkdir(parents=True, exist_ok=True)
    table = reconstruction_table(options.only, options.seeds, options.outputs.resolve())
    if len(table):
        table.to_csv(docs / "results.csv", index=False)
        numbers = (
            table.drop(columns=["run", "seed"]).groupby("scene", sort=False).agg(["mean", "std", "count"])
        )
        lines = []
        for scene, row in numbers.iterrows():
            cells = {"scene": scene, "seeds": int(row[("fit [s]", "count")])}
            for column in numbers.columns.levels[0]:
                mean, deviation = row[(column, "mean")], row[(column, "std")]
                if pd.isna(mean):
                    cells[column] = "–"
                else:
                    cells[column] = f"{mean:.3g}" + ("" if pd.isna(deviation) else f" ± {deviation:.2g}")
            lines.append(cells)
        text = pd.DataFrame(lines).to_markdown(index=False)
        (docs / "results.md").write_text(text + "\n")
        print(text)
    if not options.no_identification:
        found = identification_table(options.outputs.resolve())
        if len(found):
            text = markdown(found, ".4g")
            (docs / "identification.md").write_text(text + "\n")
            print(text)
    if options.variants is not None:
        stored = docs / "variants.csv"
        varied = variants_table(options.outputs.resolve(), options.variants, stored)
        if len(varied):
            varied.to_csv(stored, index=False, float_format="%.5g")
            text = markdown(varied, ".3g")
            (docs / "variants.md").write_text(text + "\n")
            print(text)
    identification = docs / "identification.md"
    if len(table) and "R1" in set(table.scene):
        text = readme_section(table, identification.read_text() if identification.exists() else "")
        insert(ROOT / "README.md", "results", text)
    parts = [("Every scene", "results.md"), ("Stiffness and wind", "identification.md")]
    parts.append(("R1, one factor at a time", "variants.md"))
    tables = [f"## {title}\n\n{(docs / name).read_text()}" for title, name in parts if (docs / name).exists()]
    insert(ROOT / "docs" / "results.md", "tables", "\n".join(tables))


if __name__ == "__main__":
    main()
