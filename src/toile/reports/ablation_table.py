"""Tables of a sweep over ablations: rows ablations, columns scenes, mean ± deviation over the seeds.

Written as CSV (one line per cell, with the run folders its number comes from), Markdown and LaTeX. Seeds are
those of several fits, or, of fits that draw no random numbers, those of the metrics' samples.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
PROCESSOR_SECONDS = "processor_seconds"
"""Key of the same time of the processor: stands beside the other where runs have noted it."""
PUBLISHED_SEEDS = 0
"""Seeds of a cell that has nothing but a published value."""
PUBLISHED = ", published"
"""Follows the name of a scene whose column holds published values."""
_OTHERS = "Columns with “published”: other recordings, whole clips"
_TIMES = {SECONDS: "Time of the fit", PROCESSOR_SECONDS: "Processor time of the fit"}
_BASE = "none"
_DIGITS = 3  # significant ones of a mean
_NO_DEVIATION = 1e-6  # relative to the mean: what draws no samples differs by rounding


def read_published() -> pd.DataFrame:
    """Published values: columns metric, scene, ablation, method, value, source."""
    with (files("toile.reports.published") / "ablations.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)


def ablation_cells(
    sweep: Sweep, metrics: Sequence[str], published: pd.DataFrame, beside: Sequence[str] = ()
) -> pd.DataFrame:
    """One row per metric, ablation and scene.

    Args:
        sweep: runs that differ in ablation, scene and seed.
        metrics: keys of metrics.json, or SECONDS for the time of the fit, which brings PROCESSOR_SECONDS.
        published: see read_published.
        beside: scenes whose published values follow as rows of their own, also of ablations that no run has.

    Returns:
        Columns metric, title, unit, higher_is_better, ablation, scene, seeds (how many; PUBLISHED_SEEDS where
        nothing was measured), mean, deviation (NaN for one seed), published (NaN where there is none, and
        where only first frames were fitted: published values are of whole clips), source, and runs (paths
        below the sweep's folder).
        A metric that the ground truth of no scene allows has no rows.

    Raises:
        InputError: the runs differ in something else, no run has one of the metrics though it might, or there
            are several fits in a cell and several seeds of their metrics.
    """
    _check_factors(sweep)
    metrics = _with_processor(sweep, metrics)
    rows = []
    for metric in metrics:
        values = [_values(run, metric) for run in sweep.runs]
        if not any(values) and all(_skipped(run, metric) for run in sweep.runs):
            continue
        if not any(values):
            raise InputError(
                "No run has this metric", where=str(sweep.folder), expected=_known(sweep), got=metric
            )
        for run, found in zip(sweep.runs, values, strict=True):
            for value in found:
                title, unit = _title(run, metric)
                higher = metric not in _TIMES and run.evaluation.metrics[metric].higher_is_better
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
    if not rows:
        raise InputError(
            "No run has any of these metrics",
            where=str(sweep.folder),
            expected=_known(sweep),
            got=", ".join(metrics),
        )
    keys = ["metric", "title", "unit", "higher_is_better", "ablation", "scene"]
    cells = (
        pd.DataFrame(rows)
        .groupby(keys, sort=False)
        .agg(
            seeds=("value", "size"),
            mean=("value", "mean"),
            deviation=("value", "std"),
            runs=("run", lambda names: " ".join(dict.fromkeys(names))),
        )
        .reset_index()
    )
    known = published.rename(columns={"value": "published"})[
        ["metric", "scene", "ablation", "published", "source"]
    ]
    cut = {run.evaluation.scene for run in sweep.runs if _setting(run, "scene.n_frames") is not None}
    cells = cells.merge(known[~known.scene.isin(cut)], how="left", on=["metric", "scene", "ablation"])
    cells = pd.concat([cells, *_published_rows(cells, known, beside)], ignore_index=True)
    return cells[[*keys, "seeds", "mean", "deviation", "published", "source", "runs"]]


def _with_processor(sweep: Sweep, metrics: Sequence[str]) -> list[str]:
    noted = any(run.processor_seconds is not None for run in sweep.runs)
    asked = [m for m in metrics if m != PROCESSOR_SECONDS or SECONDS not in metrics]
    return [k for m in asked for k in ((m, PROCESSOR_SECONDS) if m == SECONDS and noted else (m,))]


def _published_rows(cells: pd.DataFrame, known: pd.DataFrame, beside: Sequence[str]) -> list[pd.DataFrame]:
    """Rows of what others have published on scenes that were not measured here."""
    found = []
    for metric, own in cells.groupby("metric", sort=False):
        others = [scene for scene in beside if scene not in set(own.scene)]
        rows = known[(known.metric == metric) & known.scene.isin(others)]
        if len(rows):
            same = {name: own[name].iloc[0] for name in ("title", "unit", "higher_is_better")}
            order = rows.scene.map(list(beside).index)
            rows = rows.iloc[order.argsort(kind="stable")]
            nan = math.nan
            found.append(rows.assign(**same, seeds=PUBLISHED_SEEDS, mean=nan, deviation=nan, runs=""))
    return found


def formatted(cells: pd.DataFrame, metric: str, order: Sequence[str], bold: str, pm: str) -> pd.DataFrame:
    """One metric as a table of text: rows ablations, columns scenes.

    Times are on the clock / of the processor where the latter is known; then the latter decides which is
    best.

    Args:
        cells: of ablation_cells.
        metric: which.
        order: ablations in the order of the rows; others follow.
        bold: format of the best cell of a column, with {} for its text.
        pm: what stands between mean and deviation.
    """
    own = cells[cells.metric == metric].copy()
    measured = own.seeds != PUBLISHED_SEEDS
    own["text"] = [_cell(row, pm) for row in own.itertuples(index=False)]
    own["rank"] = own["mean"]
    if metric == SECONDS:
        _put_processor_beside(own, cells, pm)
    by_scene = own[measured].groupby("scene")["rank"]
    best = by_scene.transform("max" if own.higher_is_better.any() else "min").reindex(own.index)
    own.loc[own["rank"] == best, "text"] = own.text[own["rank"] == best].map(bold.format)
    own["text"] += [_in_brackets(row) for row in own.itertuples(index=False)]
    own["column"] = own.scene.where(measured, own.scene + PUBLISHED)
    return _arranged(own, order)


def relative(cells: pd.DataFrame, metric: str, order: Sequence[str]) -> pd.DataFrame:
    """One metric over that of the row with nothing removed, as text; published rows over their own.

    Args:
        cells: of ablation_cells.
        metric: which.
        order: see formatted.
    """
    own = cells[cells.metric == metric].copy()
    measured = own.seeds != PUBLISHED_SEEDS
    own["value"] = own["mean"].where(measured, own.published)
    whole = own[own.ablation == _BASE].set_index("scene")["value"]
    own["text"] = [
        f"{v / w:.3g}" if w else "–" for v, w in zip(own.value, own.scene.map(whole).fillna(0), strict=True)
    ]
    own["column"] = own.scene.where(measured, own.scene + PUBLISHED)
    return _arranged(own[own.ablation != _BASE], order)


def _put_processor_beside(own: pd.DataFrame, cells: pd.DataFrame, pm: str) -> None:
    """Append the processor's times to the text of times on the clock, and let them decide."""
    times = cells[cells.metric == PROCESSOR_SECONDS].set_index(["ablation", "scene"])
    keys = pd.MultiIndex.from_frame(own[["ablation", "scene"]])
    texts = pd.Series([_cell(row, pm) for row in times.itertuples()], index=times.index, dtype=object)
    beside = texts.reindex(keys).to_numpy()
    own["text"] = [a if pd.isna(b) else f"{a} / {b}" for a, b in zip(own.text, beside, strict=True)]
    known = times["mean"].reindex(keys).to_numpy()
    measured = own.seeds != PUBLISHED_SEEDS
    if not pd.isna(known[measured]).any():
        own["rank"] = known


def _arranged(own: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Column ``text`` with a row per ablation and a column per ``column``; a dash where there is none."""
    columns = list(dict.fromkeys(own.column))
    names = list(dict.fromkeys([*(a for a in order if a in set(own.ablation)), *own.ablation]))
    table = own.pivot_table(index="ablation", columns="column", values="text", aggfunc="first", sort=False)
    return table.reindex(index=names, columns=columns).rename_axis(columns="scene").fillna("–")


def caption(sweep: Sweep, cells: pd.DataFrame, metric: str) -> str:
    """What the numbers are, how they were measured, on what, and where the published ones come from."""
    own = cells[cells.metric == metric]
    title, unit = own.title.iloc[0], own.unit.iloc[0]
    recipes = sorted({_recipe(run) for run in sweep.runs})
    unit = f" [{unit}]" if unit else ""
    parts = [
        f"{title}{unit}{_beside(cells, metric)}, {_spread_over(sweep)}; the best of a column in bold; "
        f"recipe {', '.join(recipes)}{_protocol_of_fits(sweep)}.",
        *(f"Protocol{scenes}: {protocol}." for protocol, scenes in _protocols(sweep, metric).items()),
    ]
    for rows, words in (
        (own[own.seeds != PUBLISHED_SEEDS], "In brackets the published value of the same cell"),
        (own[own.seeds == PUBLISHED_SEEDS], _OTHERS),
    ):
        sources = sorted(set(rows.source.dropna()))
        if sources:
            parts.append(f"{words} ({'; '.join(sources)}).")
    machines = sorted({machine_name(r) for r in sweep.runs})
    revisions = sorted(
        {read_git_revision(r.folder)[:12] for r in sweep.runs if r.folder.git_revision.is_file()}
    )
    parts.append(f"Measured on {'; '.join(machines)}. Code: {', '.join(revisions) or 'unknown'}.")
    return " ".join(parts)


def _recipe(run: Run) -> str:
    return _name_of(_setting(run, "optimization")) or "unknown"


def _setting(run: Run, path: str) -> Any:
    """A setting of a run, None where there is none."""
    node: Any = run.settings
    for key in path.split("."):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node


def _name_of(node: Any) -> str:
    """Name of the class that a part of the configuration makes."""
    return str(node.get("_target_", "")).rpartition(".")[2] if isinstance(node, Mapping) else ""


def _spread_over(sweep: Sweep) -> str:
    if any(run.other_seeds for run in sweep.runs):
        return (
            "one fit a cell, which draws no random numbers; mean ± standard deviation over seeds of the "
            "metric's samples, where it has any"
        )
    return "mean ± standard deviation over the seeds where there are several"


def _beside(cells: pd.DataFrame, metric: str) -> str:
    known = metric == SECONDS and (cells.metric == PROCESSOR_SECONDS).any()
    return ", on the clock / of the processor" if known else ""


_LENGTH = {
    "scene.n_frames": "first {} frames",
    "optimization.cycles": "{} cycles",
    "optimization.cycles_per_frame": "one more frame every {}",
}
"""Settings that say how much of a clip is fitted for how long, where all runs share them."""
_SIMULATOR = ("simulator.build", "simulator.build.gradient")


def _protocol_of_fits(sweep: Sweep) -> str:
    """What all fits share of how long they are and what simulates, e.g. ": first 20 frames, 60 cycles"."""
    words = []
    for path, text in _LENGTH.items():
        found = {_setting(run, path) for run in sweep.runs}
        if len(found) == 1 and None not in found:
            words.append(text.format(*found))
    simulators = {
        " with ".join(filter(None, (_name_of(_setting(run, part)) for part in _SIMULATOR)))
        for run in sweep.runs
    }
    if len(simulators) == 1:
        words += [name for name in simulators if name]
    return f": {', '.join(words)}" if words else ""


def _protocols(sweep: Sweep, metric: str) -> dict[str, str]:
    """How a metric was measured, and for which scenes, said only where they differ."""
    if metric in _TIMES:
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
    sweep: Sweep,
    metrics: Sequence[str],
    order: Sequence[str],
    folder: Path,
    name: str,
    note: str,
    beside: Sequence[str] = (),
) -> list[Path]:
    """Write <name>.csv, <name>.md and <name>.tex; returns their paths.

    Args:
        sweep: runs that differ in ablation, scene and seed.
        metrics: which tables, in this order.
        order: of the rows.
        folder: where to, made if need be.
        name: of the files without suffix.
        note: a sentence above the tables, e.g. the command.
        beside: scenes whose published values have columns of their own; then what was measured is also shown
            relative to the row with nothing removed.

    Raises:
        InputError: see ablation_cells.
    """
    cells = ablation_cells(sweep, metrics, read_published(), beside)
    metrics = [metric for metric in metrics if (cells.metric == metric).any()]
    markdown, latex = [note] if note else [], []
    for metric in metrics:
        words = caption(sweep, cells, metric)
        shown = formatted(cells, metric, order, "**{}**", " ± ")
        title = cells.title[cells.metric == metric].iloc[0]
        markdown += [f"## {title}", words, _markdown_table(shown)]
        plain = formatted(cells, metric, order, r"\textbf{{{}}}", r" $\pm$ ")
        latex.append(_latex_table(plain, words, f"{name}_{metric}"))
        if (cells.seeds[cells.metric == metric] == PUBLISHED_SEEDS).any() and metric not in _TIMES:
            words = f"{title}, relative to {_BASE} of the same column."
            shown = relative(cells, metric, order)
            markdown += [words, _markdown_table(shown)]
            latex.append(_latex_table(shown, words, f"{name}_{metric}_relative"))
    markdown += ["## Runs", _runs_table(cells, metrics[0]), *_missing(sweep)]
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write_text(folder / f"{name}.csv", cells.to_csv(index=False)),
        write_text(folder / f"{name}.md", "\n\n".join(markdown) + "\n"),
        write_text(folder / f"{name}.tex", "\n".join(latex)),
    ]


def _markdown_table(table: pd.DataFrame) -> str:
    """With names that have a bar in them."""
    names = {
        axis: [str(x).replace("|", r"\|") for x in getattr(table, axis)] for axis in ("index", "columns")
    }
    titles = {axis: getattr(table, axis).name for axis in names}
    plain = table.set_axis(names["index"], axis=0).set_axis(names["columns"], axis=1)
    return str(plain.rename_axis(index=titles["index"], columns=titles["columns"]).to_markdown())


def _latex_table(table: pd.DataFrame, words: str, label: str) -> str:
    plain = table.replace("–", "--").rename_axis(index=None, columns=None)
    plain.index, plain.columns = (pd.Index([_latex(str(x)) for x in i]) for i in (plain.index, plain.columns))
    return str(plain.style.to_latex(hrules=True, caption=_latex(words), label=f"tab:{label}", position="t"))


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
    if any(run.other_seeds for run in sweep.runs) and len(seen) > len({key[:2] for key in seen}):
        raise InputError(
            "Fits with several seeds, and several seeds of their metrics",
            where=str(sweep.folder),
            expected="one fit a cell where its motion is measured with several seeds",
            got=f"{len(seen)} fits in {len({key[:2] for key in seen})} cells",
        )
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


def _values(run: Run, metric: str) -> list[float]:
    """Of the run, then with other seeds of the samples; empty where it was not measured."""
    if metric in _TIMES:
        seconds = run.seconds if metric == SECONDS else run.processor_seconds
        return [] if seconds is None else [seconds]
    found = [e.metrics.get(metric) for e in (run.evaluation, *run.other_seeds)]
    return [m.mean for m in found if m is not None and not math.isnan(m.mean)]


def _skipped(run: Run, metric: str) -> bool:
    """Whether the run's scene does not allow the metric, or the one that it is another unit of."""
    return any(metric == key or metric.startswith(f"{key}_") for key in run.evaluation.skipped)


def _title(run: Run, metric: str) -> tuple[str, str]:
    if metric in _TIMES:
        return _TIMES[metric], "s"
    found = run.evaluation.metrics.get(metric)
    return (metric, "") if found is None else (found.title, found.unit)


def _known(sweep: Sweep) -> str:
    keys = {key for run in sweep.runs for key, m in run.evaluation.metrics.items() if not math.isnan(m.mean)}
    return ", ".join(sorted({*keys, SECONDS}))


def _cell(row: Any, pm: str) -> str:
    """Mean and deviation; a published value where nothing was measured."""
    if row.seeds == PUBLISHED_SEEDS:
        return f"{row.published:g}"
    digits = max(0, _DIGITS - 1 - math.floor(math.log10(abs(row.mean)))) if row.mean else 0
    if math.isnan(row.deviation) or row.deviation <= _NO_DEVIATION * abs(row.mean):
        return f"{row.mean:.{digits}f}"
    digits = max(digits, -math.floor(math.log10(row.deviation)))
    return f"{row.mean:.{digits}f}{pm}{row.deviation:.{digits}f}"


def _in_brackets(row: Any) -> str:
    return "" if math.isnan(row.published) or row.seeds == PUBLISHED_SEEDS else f" ({row.published:g})"


def _runs_table(cells: pd.DataFrame, metric: str) -> str:
    measured = (cells.metric == metric) & (cells.seeds != PUBLISHED_SEEDS)
    own = cells[measured][["ablation", "scene", "seeds", "runs"]]
    return str(own.to_markdown(index=False))


def _missing(sweep: Sweep) -> list[str]:
    if not sweep.unfinished:
        return []
    lines = [f"- `{run.name}`: {run.reason.splitlines()[0]}" for run in sweep.unfinished]
    return ["## Runs without a result", "\n".join(lines)]


def _latex(text: str) -> str:
    """Escaped, and in characters that every LaTeX engine has."""
    special = {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "$": r"\$",
        "#": r"\#",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"$<$",
        "|": r"\textbar{}",
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
        "“": "``",
        "”": "''",
    }
    return "".join(special.get(c, c) for c in text)
