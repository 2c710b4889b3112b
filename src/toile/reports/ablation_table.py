"""Tables of a sweep over ablations: rows ablations, columns scenes, mean ± deviation over the seeds.

Written as CSV (one line per cell, with the run folders its number comes from), Markdown and LaTeX.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.reports.run_folder import read_git_revision, read_metrics
from toile.reports.run_settings import differences
from toile.reports.sweep import Run, Sweep

SECONDS = "seconds"
"""Key of the time of the fit among the metrics."""
_BASE = "none"
_DIGITS = 3  # significant ones of a mean


def read_published() -> pd.DataFrame:
    """Published values: columns metric, scene, ablation, method, value, source."""
    with (files("toile.reports.published") / "ablations.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)


def ablation_cells(sweep: Sweep, metrics: Sequence[str], published: pd.DataFrame) -> pd.DataFrame:
    """One row per metric, ablation and scene.

    Args:
        sweep: runs that differ in ablation, scene and seed.
        metrics: keys of metrics.json, or SECONDS for the time of the fit.
        published: see read_published.

    Returns:
        Columns metric, title, unit, higher_is_better, ablation, scene, seeds (how many), mean, deviation
        (NaN for one seed), published (NaN where there is none), source, and runs (paths below the sweep's
        folder).

    Raises:
        InputError: the runs differ in something else, or no run has one of the metrics.
    """
    _check_factors(sweep)
    rows = []
    for metric in metrics:
        values = [_value(run, metric) for run in sweep.runs]
        if all(math.isnan(v) for v in values):
            raise InputError(
                "No run has this metric", where=str(sweep.folder), expected=_known(sweep), got=metric
            )
        for run, value in zip(sweep.runs, values, strict=True):
            if not math.isnan(value):
                title, unit = _title(run, metric)
                higher = metric != SECONDS and run.evaluation.metrics[metric].higher_is_better
                cell = {"ablation": _ablation(run), "scene": run.evaluation.scene, "run": run.name}
                rows.append(
                    {
                        "metric": metric,
                        "title": title,
                        "unit": unit,
                        "higher_is_better": higher,
                        **cell,
                        "value": value,
                    }
                )
    keys = ["metric", "title", "unit", "higher_is_better", "ablation", "scene"]
    cells = (
        pd.DataFrame(rows)
        .groupby(keys, sort=False)
        .agg(
            seeds=("value", "size"),
            mean=("value", "mean"),
            deviation=("value", "std"),
            runs=("run", " ".join),
        )
        .reset_index()
    )
    beside = published.rename(columns={"value": "published"})[
        ["metric", "scene", "ablation", "published", "source"]
    ]
    cells = cells.merge(beside, how="left", on=["metric", "scene", "ablation"])
    return cells[[*keys, "seeds", "mean", "deviation", "published", "source", "runs"]]


def formatted(cells: pd.DataFrame, metric: str, order: Sequence[str], bold: str, pm: str) -> pd.DataFrame:
    """One metric as a table of text: rows ablations, columns scenes.

    Args:
        cells: of ablation_cells.
        metric: which.
        order: ablations in the order of the rows; others follow.
        bold: format of the best cell of a column, with {} for its text.
        pm: what stands between mean and deviation.
    """
    own = cells[cells.metric == metric].copy()
    best = own.groupby("scene")["mean"].transform("max" if own.higher_is_better.any() else "min")
    own["text"] = [
        _cell(row, bold if row.mean == winner else "{}", pm)
        for row, winner in zip(own.itertuples(index=False), best, strict=True)
    ]
    scenes = list(dict.fromkeys(own.scene))
    names = list(dict.fromkeys([*(a for a in order if a in set(own.ablation)), *own.ablation]))
    table = own.pivot_table(index="ablation", columns="scene", values="text", aggfunc="first", sort=False)
    return table.reindex(index=names, columns=scenes).fillna("–")


def caption(sweep: Sweep, cells: pd.DataFrame, metric: str) -> str:
    """What the numbers are, how they were measured, on what, and where the published ones come from."""
    own = cells[cells.metric == metric]
    title, unit = own.title.iloc[0], own.unit.iloc[0]
    recipes = sorted({_recipe(run) for run in sweep.runs})
    parts = [
        f"{title}{f' [{unit}]' if unit else ''}, mean ± standard deviation over the seeds where there are "
        f"several; the best of a column in bold; recipe {', '.join(recipes)}.",
        *(f"Protocol{scenes}: {protocol}." for protocol, scenes in _protocols(sweep, metric).items()),
    ]
    sources = sorted(set(own.source.dropna()))
    if sources:
        parts.append(f"In brackets the published value of the same cell ({'; '.join(sources)}).")
    machines = sorted({machine_name(r) for r in sweep.runs})
    revisions = sorted(
        {read_git_revision(r.folder)[:12] for r in sweep.runs if r.folder.git_revision.is_file()}
    )
    parts.append(f"Measured on {'; '.join(machines)}. Code: {', '.join(revisions) or 'unknown'}.")
    return " ".join(parts)


def _recipe(run: Run) -> str:
    optimization = run.settings.get("optimization")
    target = optimization.get("_target_", "") if isinstance(optimization, dict) else ""
    return str(target).rpartition(".")[2] or "unknown"


def _protocols(sweep: Sweep, metric: str) -> dict[str, str]:
    """How a metric was measured, and for which scenes, said only where they differ."""
    if metric == SECONDS:
        return {"time of the optimisation, without loading, evaluation and report": ""}
    scenes: dict[str, dict[str, None]] = {}
    for run in sweep.runs:
        found = run.evaluation.metrics.get(metric)
        if found is not None and not math.isnan(found.mean):
            scenes.setdefault(found.protocol, {})[run.evaluation.scene] = None
    named = {protocol: f" ({', '.join(names)})" for protocol, names in scenes.items()}
    return named if len(named) > 1 else dict.fromkeys(named, "")


def machine_name(run: Run) -> str:
    """Processor, cores and threads that a run notes."""
    machine: Any = read_metrics(run.folder).get("machine")
    if not isinstance(machine, dict):
        return "unknown"
    cores, threads = machine.get("processors"), machine.get("threads")
    return f"{machine.get('processor')}, {cores} cores, {threads} thread(s) a fit"


def write_tables(
    sweep: Sweep, metrics: Sequence[str], order: Sequence[str], folder: Path, name: str, note: str
) -> list[Path]:
    """Write <name>.csv, <name>.md and <name>.tex; returns their paths.

    Args:
        sweep: runs that differ in ablation, scene and seed.
        metrics: which tables, in this order.
        order: of the rows.
        folder: where to, made if need be.
        name: of the files without suffix.
        note: a sentence above the tables, e.g. the command.

    Raises:
        InputError: see ablation_cells.
    """
    cells = ablation_cells(sweep, metrics, read_published())
    markdown, latex = [note] if note else [], []
    for metric in metrics:
        words = caption(sweep, cells, metric)
        shown = formatted(cells, metric, order, "**{}**", " ± ")
        title = cells.title[cells.metric == metric].iloc[0]
        markdown += [f"## {title}", words, shown.to_markdown()]
        plain = formatted(cells, metric, order, r"\textbf{{{}}}", r" $\pm$ ").replace("–", "--")
        plain.index = plain.index.str.replace("_", r"\_")
        plain.columns = plain.columns.str.replace("_", r"\_")
        styler = plain.rename_axis(index=None, columns=None).style
        text = styler.to_latex(hrules=True, caption=_latex(words), label=f"tab:{name}_{metric}", position="t")
        latex.append(text)
    markdown += ["## Runs", _runs_table(cells, metrics[0]), *_missing(sweep)]
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_text(folder / f"{name}.csv", cells.to_csv(index=False)),
        write_text(folder / f"{name}.md", "\n\n".join(markdown) + "\n"),
        write_text(folder / f"{name}.tex", "\n".join(latex)),
    ]


def _check_factors(sweep: Sweep) -> None:
    """Every cell must be one set of settings: seeds aside, nothing but ablation and scene may differ."""
    if not sweep.runs:
        raise InputError(
            "No run has a result",
            where=str(sweep.folder),
            expected="runs with metrics.json",
            got=f"{len(sweep.unfinished)} unfinished ones",
        )
    seen: dict[tuple[str, str, str], str] = {}
    for run in sweep.runs:
        key = _ablation(run), run.evaluation.scene, run.seed
        if key in seen:
            raise InputError(
                "Two runs claim one cell of the table",
                where=f"{run.name} and {seen[key]}",
                expected="runs that differ in ablation, scene or seed",
                got=f"ablation {key[0]}, scene {key[1]}, seed {key[2]} twice",
            )
        seen[key] = run.name
    for ablation in {key[0] for key in seen}:
        runs = [run for run in sweep.runs if _ablation(run) == ablation]
        other = [d for d in differences([r.settings for r in runs]) if not _may_differ(d.paths[0])]
        if other:
            raise InputError(
                "Runs of one row of the table differ in more than scene and seed",
                where=str(sweep.folder),
                expected=f"the same settings in all runs with ablation {ablation}",
                got="; ".join(f"{d.name}: {', '.join(dict.fromkeys(d.values))}" for d in other),
            )


def _may_differ(path: str) -> bool:
    return path.partition(".")[0] in ("scene", "seed")


def _ablation(run: Run) -> str:
    return str(run.settings.get("ablation", _BASE))


def _value(run: Run, metric: str) -> float:
    if metric == SECONDS:
        return math.nan if run.seconds is None else run.seconds
    found = run.evaluation.metrics.get(metric)
    return math.nan if found is None else found.mean


def _title(run: Run, metric: str) -> tuple[str, str]:
    if metric == SECONDS:
        return "Time of the fit", "s"
    found = run.evaluation.metrics.get(metric)
    return (metric, "") if found is None else (found.title, found.unit)


def _known(sweep: Sweep) -> str:
    keys = {key for run in sweep.runs for key, m in run.evaluation.metrics.items() if not math.isnan(m.mean)}
    return ", ".join(sorted({*keys, SECONDS}))


def _cell(row: Any, bold: str, pm: str) -> str:
    digits = max(0, _DIGITS - 1 - math.floor(math.log10(abs(row.mean)))) if row.mean else 0
    text = f"{row.mean:.{digits}f}"
    if not math.isnan(row.deviation):
        text += f"{pm}{row.deviation:.{digits}f}"
    text = bold.format(text)
    return text if math.isnan(row.published) else f"{text} ({row.published:g})"


def _runs_table(cells: pd.DataFrame, metric: str) -> str:
    own = cells[cells.metric == metric][["ablation", "scene", "seeds", "runs"]]
    return str(own.to_markdown(index=False))


def _missing(sweep: Sweep) -> list[str]:
    if not sweep.unfinished:
        return []
    lines = [f"- `{run.name}`: {run.reason.splitlines()[0]}" for run in sweep.unfinished]
    return ["## Runs without a result", "\n".join(lines)]


def _latex(text: str) -> str:
    """Escaped, and in characters that every LaTeX engine has."""
    special = {
        "_": r"\_",
        "%": r"\%",
        "&": r"\&",
        ">": r"$>$",
        "±": r"$\pm$",
        "×": r"$\times$",
        "²": r"\textsuperscript{2}",
        "⁻": r"\textsuperscript{--}",
        "⁴": r"\textsuperscript{4}",
        "½": "1/2",
        "−": "--",
    }
    return "".join(special.get(c, c) for c in text)
