"""The page of several runs: which is best, how much that depends on the seed, and what differs."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup

from toile.atomic_file import write_text
from toile.evaluation.evaluate import Metric
from toile.reports.page.charts import Curve, DotPanel, dots, overlaid
from toile.reports.page.document import NARROW_NO_BREAK_SPACE, number, render, with_unit
from toile.reports.page.run_page import CARD_METRICS, headline_metrics
from toile.reports.run_settings import Difference
from toile.reports.stiffness_note import stiffness_note
from toile.reports.sweep import Group, Run, Sweep

Quantity = tuple[str, str, Callable[[Run], float]]
"""Title, unit and value of a run."""
MAX_COLUMNS = 6
"""Settings up to which each has a column of its own in the table of runs.

Where more differ, those that were asked for by name still have one; the others are listed below the table.
"""
MAX_PANELS = 3
"""Metrics drawn side by side."""
MAX_LABEL = 160
"""Characters of a group's label; figures break it into lines."""


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation of a few values.

    Attributes:
        mean: of the values; NaN where there are none.
        deviation: with n − 1 in the denominator; NaN for fewer than two values.
        n: number of values.
    """

    mean: float
    deviation: float
    n: int

    @staticmethod
    def of(values: Iterable[float]) -> Spread:
        """Of the values that are finite."""
        known = np.array([v for v in values if math.isfinite(v)])
        mean = float(known.mean()) if known.size else math.nan
        return Spread(mean, float(known.std(ddof=1)) if known.size > 1 else math.nan, known.size)

    def text(self, unit: str) -> Markup:
        """As HTML, e.g. "0.498 ± 0.013 m"."""
        if self.n < 2:
            return with_unit(self.mean, unit)
        # No more decimals than the mean has.
        shown = number(self.mean)
        decimals = len(shown.partition(".")[2])
        deviation = f"{self.deviation:.{decimals}f}" if shown.replace(".", "").isdigit() else None
        if deviation is None or float(deviation) == 0:
            return shown + " ± " + with_unit(self.deviation, unit)
        return shown + f" ± {deviation}{NARROW_NO_BREAK_SPACE + unit if unit else ''}"


@dataclass(frozen=True)
class SweepPage:
    """The page of a sweep.

    Attributes:
        sweep: what it shows.
        path: the file it will be, from which links are relative.
    """

    sweep: Sweep
    path: Path

    def render(self) -> str:
        """The page as HTML text, self-contained."""
        sweep, metric = self.sweep, self._metric()
        notes = [stiffness_note(r.settings) for r in sweep.runs if r.parameters]
        return render(
            "sweep.html.j2",
            sweep=sweep,
            metric=metric,
            best=[] if metric is None else [self._best(scene, metric) for scene in sweep.scenes],
            cards=self._cards(),
            warnings=self._warnings(),
            dots={scene: self._dots(scene) for scene in sweep.scenes},
            curves={scene: self._curves(scene) for scene in sweep.scenes},
            runs=self._runs(),
            groups=[(_short(g.label), sweep.runs.index(g.runs[0])) for g in self._ordered()],
            too_many=len(sweep.all_differences) > MAX_COLUMNS,
            parameters=self._parameters(),
            notes=list(filter(None, dict.fromkeys(notes))),
            unfinished=self._unfinished(),
            protocols=self._protocols(),
        )

    def _metric(self) -> Metric | None:
        """The metric that the comparison is about: the most telling one that most runs have."""
        having = {k: [r.evaluation.metrics[k] for r in self.sweep.runs if _has(r, k)] for k in CARD_METRICS}
        most = max(map(len, having.values()), default=0)
        return next((found[0] for found in having.values() if found and len(found) == most), None)

    def _ordered(self) -> list[Group]:
        """Groups from the best to the worst, every scene counting the same."""
        metric = self._metric()
        if metric is None:
            return list(self.sweep.groups)
        key = metric.key
        usual = {s: Spread.of(_values(_in_scene(self.sweep.runs, s), key)).mean for s in self.sweep.scenes}

        def standing(group: Group) -> float:
            # Where all runs have lost the cloth (an overlap of 0) nothing stands out.
            means = {scene: mean or math.nan for scene, mean in usual.items()}
            relative = Spread.of(_value(r, key) / means[r.evaluation.scene] for r in group.runs).mean
            if math.isnan(relative):
                return math.inf
            return -relative if metric.higher_is_better else relative

        return sorted(self.sweep.groups, key=standing)

    def _cards(self) -> list[tuple[str, str, str]]:
        """Values with their units and what they are."""
        sweep = self.sweep
        n = len(sweep.runs)
        cards = [
            (str(n), "", f"of {n + len(sweep.unfinished)} runs have a result"),
            (str(len(sweep.groups)), "", "settings, apart from scene and seed"),
            (str(len({r.seed for r in sweep.runs})), "", "seeds"),
        ]
        seconds = [r.seconds for r in sweep.runs if r.seconds is not None]
        if seconds:
            cards.append((number(float(np.median(seconds))), "s", "median time of a fit"))
        return cards

    def _best(self, scene: str, metric: Metric) -> dict[str, Any] | None:
        """Label and spread of the best group on a scene, and of the worst where there are several."""
        found = [
            (_short(g.label), Spread.of(_values(_in_scene(g.runs, scene), metric.key)))
            for g in self.sweep.groups
        ]
        found = [(label, spread) for label, spread in found if spread.n]
        if not found:
            return None
        sign = -1 if metric.higher_is_better else 1
        best, worst = (extreme(found, key=lambda x: sign * x[1].mean) for extreme in (min, max))
        return {"scene": scene, "best": best, "worst": worst if len(found) > 1 else None}

    def _warnings(self) -> list[str]:
        lines = []
        metric = self._metric()
        if metric is not None:
            for scene in self.sweep.scenes:
                runs = [r for r in _in_scene(self.sweep.runs, scene) if _has(r, metric.key)]
                frames = sorted({r.evaluation.n_frames for r in runs})
                if len(frames) > 1:
                    listed = ", ".join(map(str, frames))
                    lines.append(
                        f"Runs of {scene} have different lengths ({listed} frames): "
                        "their means cannot be compared."
                    )
                elif len({r.evaluation.metrics[metric.key].protocol for r in runs}) > 1:
                    lines.append(f"Runs of {scene} were measured in different ways, see the end of the page.")
        if self.sweep.unfinished:
            n = len(self.sweep.unfinished)
            lines.append(f"{n} run{'s have' if n > 1 else ' has'} no result, see below.")
        return lines

    def _dots(self, scene: str) -> go.Figure | None:
        runs = _in_scene(self.sweep.runs, scene)
        metrics = [m for r in runs[:1] for m in headline_metrics(r.evaluation)][:MAX_PANELS]
        if not metrics:
            return None
        quantities: list[Quantity] = [(m.title, m.unit, partial(_value, key=m.key)) for m in metrics]
        sign = -1 if metrics[0].higher_is_better else 1

        def standing(group: Group) -> float:
            mean = Spread.of(_value(r, metrics[0].key) for r in group.runs if r in runs).mean
            return math.inf if math.isnan(mean) else sign * mean

        groups = sorted(self.sweep.groups, key=standing)
        return self._dot_chart(groups, runs, quantities)

    def _dot_chart(
        self, groups: Sequence[Group], runs: Sequence[Run], quantities: Sequence[Quantity]
    ) -> go.Figure:
        groups = [g for g in groups if any(r in runs for r in g.runs)]
        members = [[r for r in g.runs if r in runs] for g in groups]
        panels = [DotPanel(t, u, [[value(r) for r in m] for m in members]) for t, u, value in quantities]
        return dots([_short(g.label) for g in groups], [[r.name for r in m] for m in members], panels)

    def _runs(self) -> dict[str, Any]:
        """Columns (title, class, unit) and rows of the table of runs."""
        sweep = self.sweep
        differences = self._columns()
        scene = len(sweep.scenes) > 1
        setting = len(sweep.all_differences) > MAX_COLUMNS and len(sweep.groups) > 1
        metrics = {m.key: m for r in sweep.runs for m in headline_metrics(r.evaluation)}
        label = {id(r): g.label for g in sweep.groups for r in g.runs}
        best = {id(r) for r in self._best_runs()}
        columns = [
            *([("scene", "left", "")] if scene else []),
            *((d.name, "left", "") for d in differences),
            *([("setting", "left wrap", "")] if setting else []),
            ("seed", "", ""),
            *((m.title, "", m.unit) for m in metrics.values()),
            ("time", "", "s"),
        ]
        rows = [
            {
                "name": run.name,
                "link": self._link(run),
                "best": id(run) in best,
                "cells": [
                    *([run.evaluation.scene] if scene else []),
                    *(d.values[k] for d in differences),
                    *([label[id(run)]] if setting else []),
                    run.seed,
                    *(_value(run, key) for key in metrics),
                    math.nan if run.seconds is None else run.seconds,
                ],
            }
            for k, run in enumerate(sweep.runs)
        ]
        return {"columns": columns, "rows": rows}

    def _columns(self) -> list[Difference]:
        """Settings with a column of their own."""
        sweep = self.sweep
        if len(sweep.all_differences) <= MAX_COLUMNS:
            return list(sweep.all_differences)
        given = [o for run in sweep.runs for o in run.overrides]
        given += [o for run in sweep.unfinished for o in run.overrides]
        asked = {o.lstrip("+~").partition("=")[0] for o in given}
        return [d for d in sweep.all_differences if asked.intersection(d.paths)]

    def _best_runs(self) -> list[Run]:
        """The best run of every scene that has several."""
        metric = self._metric()
        found = []
        for scene in self.sweep.scenes if metric is not None else ():
            assert metric is not None
            runs = [r for r in _in_scene(self.sweep.runs, scene) if _has(r, metric.key)]
            sign = -1 if metric.higher_is_better else 1
            if len(runs) > 1:
                found.append(min(runs, key=lambda r: sign * _value(r, metric.key)))
        return found

    def _link(self, run: Run) -> str | None:
        """Address of a run's own page, where it has one."""
        if not run.folder.page.is_file():
            return None
        return quote(Path(os.path.relpath(run.folder.page, self.path.resolve().parent)).as_posix())

    def _curves(self, scene: str) -> go.Figure | None:
        metric = self._metric()
        if metric is None:
            return None
        groups = self._ordered()
        curves = [
            Curve(run.name, k, run.evaluation.metrics[metric.key].per_frame)
            for k, group in enumerate(groups)
            for run in _in_scene(group.runs, scene)
            if _has(run, metric.key)
        ]
        if not curves:
            return None
        title = f"{metric.title} [{metric.unit}]" if metric.unit else metric.title
        labels = [_short(g.label) for g in groups]
        return overlaid(curves, labels, "frame", title)

    def _parameters(self) -> go.Figure | None:
        names = list(dict.fromkeys(name for r in self.sweep.runs for name in r.parameters))

        def quantity(name: str) -> Quantity:
            title, _, unit = name.rstrip("]").partition(" [")
            return title, unit, lambda run: run.parameters.get(name, math.nan)

        quantities = [quantity(name) for name in names]
        return self._dot_chart(self._ordered(), self.sweep.runs, quantities) if names else None

    def _unfinished(self) -> dict[str, Any]:
        """Names of the columns, and rows, of the table of runs without a result."""
        sweep = self.sweep
        columns = self._columns()
        # Of a run that failed before its configuration was stored, only this is known.
        bare = any(not u.settings and u.asked_for for u in sweep.unfinished)
        several = len({*sweep.scenes, *(u.scene for u in sweep.unfinished if u.scene)}) > 1
        names = [*(["scene"] if several else []), *(d.name for d in columns)]
        names += [*(["asked for"] if bare else []), "seed"]
        rows = []
        for k, u in enumerate(sweep.unfinished, start=len(sweep.runs)):
            values = [*([u.scene] if several else []), *(d.values[k] for d in columns)]
            values += [*([u.asked_for] if bare else []), str(u.settings.get("seed", ""))]
            rows.append((u.name, list(zip(names, values, strict=True)), u.reason))
        return {"names": names, "rows": rows}

    def _protocols(self) -> list[tuple[str, str, str]]:
        """Every metric's title, its scenes where they were measured in different ways, and the protocol."""
        ways: dict[tuple[str, str], dict[str, None]] = {}
        for run in self.sweep.runs:
            for metric in headline_metrics(run.evaluation):
                ways.setdefault((metric.title, metric.protocol), {})[run.evaluation.scene] = None
        titles = [title for title, _ in ways]
        return [
            (title, ", ".join(scenes) if titles.count(title) > 1 else "", protocol)
            for (title, protocol), scenes in ways.items()
        ]


def write_sweep_page(page: SweepPage) -> Path:
    """Write the page as one HTML file; returns its path."""
    return write_text(page.path, page.render())


def _in_scene(runs: Sequence[Run], scene: str) -> list[Run]:
    return [r for r in runs if r.evaluation.scene == scene]


def _has(run: Run, key: str) -> bool:
    return math.isfinite(_value(run, key))


def _value(run: Run, key: str) -> float:
    metric = run.evaluation.metrics.get(key)
    return math.nan if metric is None else metric.mean


def _values(runs: Iterable[Run], key: str) -> list[float]:
    return [_value(r, key) for r in runs]


def _short(label: str) -> str:
    return label if len(label) <= MAX_LABEL else label[: MAX_LABEL - 1] + "…"
