"""The page of several runs: which is best, how much that depends on the seed, and what differs."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from toile.atomic_file import write_text
from toile.evaluation.evaluate import Metric
from toile.reports.page.charts import Curve, DotPanel, dots, overlaid
from toile.reports.page.document import (
    NARROW_NO_BREAK_SPACE,
    document,
    figure,
    in_sentence,
    number,
    section,
    table,
    with_unit,
)
from toile.reports.page.run_page import CARD_METRICS, headline_metrics
from toile.reports.run_settings import Difference
from toile.reports.stiffness_note import stiffness_note
from toile.reports.sweep import Group, Run, Sweep

Quantity = tuple[str, str, Callable[[Run], float]]
"""Title, unit and value of a run."""
SceneChart = Callable[[str, int], str]
"""Draws the runs of a scene; the number makes names unique."""

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

    def text(self, unit: str) -> str:
        """As HTML, e.g. "0.498 ± 0.013 m"."""
        if self.n < 2:
            return with_unit(self.mean, unit)
        # No more decimals than the mean has.
        shown = number(self.mean)
        decimals = len(shown.partition(".")[2])
        deviation = f"{self.deviation:.{decimals}f}" if shown.replace(".", "").isdigit() else None
        if deviation is None or float(deviation) == 0:
            return f"{shown} ± {with_unit(self.deviation, unit)}"
        return f"{shown} ± {deviation}{NARROW_NO_BREAK_SPACE + escape(unit) if unit else ''}"


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
        title = self.sweep.folder.name or "runs"
        body = [
            self._answer(title),
            *self._by_scene("Settings side by side", self._dots, _DOTS_NOTE),
            section("Runs", self._runs(), self._differences()),
            *self._by_scene(f"{self._title()} over time", self._curves, "One line per run."),
            section("Stiffness found", self._parameters(), note=self._stiffness_note()),
            section("Without a result", self._unfinished()),
            section("How it was measured", self._protocols()),
        ]
        return document(f"{title} – toile", body)

    def _metric(self) -> Metric | None:
        """The metric that the comparison is about: the most telling one that most runs have."""
        having = {k: [r.evaluation.metrics[k] for r in self.sweep.runs if _has(r, k)] for k in CARD_METRICS}
        most = max(map(len, having.values()), default=0)
        return next((found[0] for found in having.values() if found and len(found) == most), None)

    def _title(self) -> str:
        metric = self._metric()
        return "Error" if metric is None else metric.title

    def _ordered(self) -> list[Group]:
        """Groups from the best to the worst, every scene counting the same."""
        metric = self._metric()
        if metric is None:
            return list(self.sweep.groups)
        key = metric.key
        usual = {s: Spread.of(_values(_in_scene(self.sweep.runs, s), key)).mean for s in self.sweep.scenes}

        def standing(group: Group) -> float:
            relative = Spread.of(_value(r, key) / usual[r.evaluation.scene] for r in group.runs).mean
            if math.isnan(relative):
                return math.inf
            return -relative if metric.higher_is_better else relative

        return sorted(self.sweep.groups, key=standing)

    def _answer(self, title: str) -> str:
        sweep, metric = self.sweep, self._metric()
        n = len(sweep.runs)
        scenes = sweep.scenes
        of = escape(scenes[0]) if len(scenes) == 1 else f"{len(scenes)} scenes"
        kinds = f" in {len(sweep.groups)} settings" if len(sweep.groups) > 1 else ""
        runs = f"{n} run{'s' if n != 1 else ''}"
        if not n:
            lead = "None of the runs has a result yet."
        elif metric is None:
            lead = f"{runs} of {of}{kinds}. None has a metric to compare."
        else:
            lead = f"{runs} of {of}{kinds}. {' '.join(self._best(s, metric) for s in scenes)}"
        cards = [
            (str(n), "", f"of {n + len(sweep.unfinished)} runs have a result"),
            (str(len(sweep.groups)), "", "settings, apart from scene and seed"),
            (str(len({r.seed for r in sweep.runs})), "", "seeds"),
        ]
        seconds = [r.seconds for r in sweep.runs if r.seconds is not None]
        if seconds:
            cards.append((number(float(np.median(seconds))), "s", "median time of a fit"))
        shown = "".join(
            f'<div class="card"><span class="value">{value}<small> {unit}</small></span>{label}</div>'
            for value, unit, label in cards
        )
        return (
            f'<header><p class="eyebrow">toile · comparison of runs</p><h1>{escape(title)}</h1>'
            f'<p class="lead">{lead}</p><div class="cards">{shown}</div>{self._warnings()}</header>'
        )

    def _best(self, scene: str, metric: Metric) -> str:
        """A sentence about the best group on a scene."""
        spreads = [(g, Spread.of(_values(_in_scene(g.runs, scene), metric.key))) for g in self.sweep.groups]
        spreads = [(g, s) for g, s in spreads if s.n]
        where = f" on {escape(scene)}" if len(self.sweep.scenes) > 1 else ""
        if not spreads:
            return ""
        sign = -1 if metric.higher_is_better else 1
        group, best = min(spreads, key=lambda x: sign * x[1].mean)
        seeds = f" over {best.n} runs" if best.n > 1 else ""
        value = f'<strong class="value">{best.text(metric.unit)}</strong>{seeds}'
        if len(spreads) == 1:
            return f"{escape(metric.title)}{where}: {value}."
        worst = max(spreads, key=lambda x: sign * x[1].mean)
        far = f"; {with_unit(worst[1].mean, metric.unit)} with {escape(_short(worst[0].label))}"
        return (
            f"Best {in_sentence(metric.title)}{where}: {value} with <strong>{escape(_short(group.label))}"
            f"</strong>{far}."
        )

    def _warnings(self) -> str:
        lines = []
        metric = self._metric()
        if metric is not None:
            for scene in self.sweep.scenes:
                runs = [r for r in _in_scene(self.sweep.runs, scene) if _has(r, metric.key)]
                frames = sorted({r.evaluation.n_frames for r in runs})
                if len(frames) > 1:
                    listed = ", ".join(map(str, frames))
                    lines.append(f"Runs of {escape(scene)} have different lengths ({listed} frames): ")
                    lines[-1] += "their means cannot be compared."
                elif len({r.evaluation.metrics[metric.key].protocol for r in runs}) > 1:
                    lines.append(
                        f"Runs of {escape(scene)} were measured in different ways, see the end of the page."
                    )
        if self.sweep.unfinished:
            n = len(self.sweep.unfinished)
            lines.append(f"{n} run{'s have' if n > 1 else ' has'} no result, see below.")
        return "".join(f'<p class="warning">{line}</p>' for line in lines)

    def _by_scene(self, title: str, draw: SceneChart, note: str) -> list[str]:
        """A section with a chart per scene."""
        scenes = self.sweep.scenes
        parts = []
        for k, scene in enumerate(scenes):
            chart = draw(scene, k)
            heading = f"<h3>{escape(scene)}</h3>" if len(scenes) > 1 and chart else ""
            parts.append(heading + chart)
        return [section(title, *parts, note=note)]

    def _dots(self, scene: str, index: int) -> str:
        runs = _in_scene(self.sweep.runs, scene)
        metrics = [m for r in runs[:1] for m in headline_metrics(r.evaluation)][:MAX_PANELS]
        if not metrics:
            return ""
        quantities: list[Quantity] = [(m.title, m.unit, partial(_value, key=m.key)) for m in metrics]
        sign = -1 if metrics[0].higher_is_better else 1

        def standing(group: Group) -> float:
            mean = Spread.of(_value(r, metrics[0].key) for r in group.runs if r in runs).mean
            return math.inf if math.isnan(mean) else sign * mean

        groups = sorted(self.sweep.groups, key=standing)
        return self._dot_chart(f"dots-{index}", groups, runs, quantities)

    def _dot_chart(
        self, name: str, groups: Sequence[Group], runs: Sequence[Run], quantities: Sequence[Quantity]
    ) -> str:
        groups = [g for g in groups if any(r in runs for r in g.runs)]
        members = [[r for r in g.runs if r in runs] for g in groups]
        panels = [DotPanel(t, u, [[value(r) for r in m] for m in members]) for t, u, value in quantities]
        chart = dots([_short(g.label) for g in groups], [[r.name for r in m] for m in members], panels)
        return figure(chart, name)

    def _runs(self) -> str:
        sweep = self.sweep
        if not sweep.runs:
            return ""
        several = len(sweep.scenes) > 1
        columns, few = self._columns(), len(sweep.all_differences) <= MAX_COLUMNS
        metrics = {m.key: m for r in sweep.runs for m in headline_metrics(r.evaluation)}
        heads = [_heading("run")]
        heads += [_heading("scene", "left")] if several else []
        heads += [_heading(d.name, "left") for d in columns]
        heads += [_heading("setting", "left")] if not few and len(sweep.groups) > 1 else []
        heads += [_heading("seed"), *(_heading(m.title, unit=m.unit) for m in metrics.values())]
        heads.append(_heading("time", unit="s"))
        label = {id(r): g.label for g in sweep.groups for r in g.runs}
        best = {id(r) for r in self._best_runs()}
        rows = []
        for k, run in enumerate(sweep.runs):
            cells = [f"<th>{self._link(run)}</th>"]
            cells += [f"<td class='left'>{escape(run.evaluation.scene)}</td>"] if several else []
            cells += [f"<td class='left'>{escape(d.values[k])}</td>" for d in columns]
            if not few and len(sweep.groups) > 1:
                cells.append(f"<td class='left wrap'>{escape(label[id(run)])}</td>")
            cells.append(f"<td>{escape(run.seed)}</td>")
            cells += [_cell(_value(run, key)) for key in metrics]
            cells.append(_cell(math.nan if run.seconds is None else run.seconds))
            kind = ' class="best"' if id(run) in best else ""
            rows.append(f"<tr{kind}>{''.join(cells)}</tr>")
        return table(f"<tr>{''.join(heads)}</tr>", rows, sortable=True)

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

    def _link(self, run: Run) -> str:
        if not run.folder.page.is_file():
            return escape(run.name)
        target = os.path.relpath(run.folder.page, self.path.resolve().parent)
        return f'<a href="{escape(quote(Path(target).as_posix()))}">{escape(run.name)}</a>'

    def _differences(self) -> str:
        """All settings that differ, one row each, one column per group."""
        sweep = self.sweep
        if len(sweep.all_differences) <= MAX_COLUMNS or not sweep.differences:
            return ""
        groups = self._ordered()
        first = [sweep.runs.index(g.runs[0]) for g in groups]
        rows = []
        for d in sweep.differences:
            values = "".join(f"<td class='left'>{escape(d.values[k])}</td>" for k in first)
            rows.append(f"<tr><th>{escape(d.name)}</th>{values}</tr>")
        heads = "".join(f"<th class='left'>{escape(_short(g.label))}</th>" for g in groups)
        content = table(f"<tr><th>setting</th>{heads}</tr>", rows)
        return f"<details><summary>All {len(rows)} settings that differ</summary>{content}</details>"

    def _curves(self, scene: str, index: int) -> str:
        metric = self._metric()
        if metric is None:
            return ""
        groups = self._ordered()
        curves = [
            Curve(run.name, k, run.evaluation.metrics[metric.key].per_frame)
            for k, group in enumerate(groups)
            for run in _in_scene(group.runs, scene)
            if _has(run, metric.key)
        ]
        if not curves:
            return ""
        title = f"{metric.title} [{metric.unit}]" if metric.unit else metric.title
        labels = [_short(g.label) for g in groups]
        return figure(overlaid(curves, labels, "frame", title), f"curves-{index}")

    def _parameters(self) -> str:
        names = list(dict.fromkeys(name for r in self.sweep.runs for name in r.parameters))
        if not names:
            return ""

        def quantity(name: str) -> Quantity:
            title, _, unit = name.rstrip("]").partition(" [")
            return title, unit, lambda run: run.parameters.get(name, math.nan)

        return self._dot_chart(
            "parameters", self._ordered(), self.sweep.runs, [quantity(name) for name in names]
        )

    def _stiffness_note(self) -> str:
        notes = dict.fromkeys(stiffness_note(r.settings) for r in self.sweep.runs if r.parameters)
        said = [f"<br>{escape(note)}" for note in notes if note]
        several = (
            "<br>The runs have different recipes, so not all of the following holds for each."
            if len(said) > 1
            else ""
        )
        return f"{_STIFFNESS_NOTE}{several}{''.join(said)}"

    def _unfinished(self) -> str:
        sweep = self.sweep
        if not sweep.unfinished:
            return ""
        columns = self._columns()
        # Of a run that failed before its configuration was stored, only this is known.
        bare = any(not u.settings and u.asked_for for u in sweep.unfinished)
        several = len({*sweep.scenes, *(u.scene for u in sweep.unfinished if u.scene)}) > 1
        names = [
            *(["scene"] if several else []),
            *(d.name for d in columns),
            *(["asked for"] if bare else []),
        ]
        rows = []
        for k, u in enumerate(sweep.unfinished, start=len(sweep.runs)):
            values = [*([u.scene] if several else []), *(d.values[k] for d in columns)]
            values += [u.asked_for] if bare else []
            values.append(str(u.settings.get("seed", "")))
            cells = [
                f"<td class='left' data-label='{escape(name)}'>{escape(value)}</td>"
                for name, value in zip([*names, "seed"], values, strict=True)
            ]
            reason = f"<td class='text'>{escape(u.reason)}</td>"
            rows.append(f"<tr><th>{escape(u.name)}</th>{''.join(cells)}{reason}</tr>")
        heads = "".join(f"<th class='left'>{escape(name)}</th>" for name in [*names, "seed"])
        return table(f"<tr><th>run</th>{heads}<th class='text'>reason</th></tr>", rows)

    def _protocols(self) -> str:
        ways: dict[tuple[str, str], list[str]] = {}
        for run in self.sweep.runs:
            for metric in headline_metrics(run.evaluation):
                ways.setdefault((metric.title, metric.protocol), []).append(run.evaluation.scene)
        titles = [title for title, _ in ways]
        rows = []
        for (title, protocol), scenes in ways.items():
            on = f" <i>({escape(', '.join(dict.fromkeys(scenes)))})</i>" if titles.count(title) > 1 else ""
            rows.append(f"<tr><th>{escape(title)}{on}</th><td class='text'>{escape(protocol)}</td></tr>")
        return table("<tr><th>metric</th><th class='text'>protocol</th></tr>", rows) if rows else ""


def write_sweep_page(page: SweepPage) -> Path:
    """Write the page as one HTML file; returns its path."""
    return write_text(page.path, page.render())


_DOTS_NOTE = "A dot per run, a bar at the mean of its setting; best setting on top."
_STIFFNESS_NOTE = (
    "At the end of the fit. A video tells stiffness only relative to mass: the values hold for the areal "
    "density of the configuration."
)


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


def _heading(title: str, kind: str = "", unit: str = "") -> str:
    attribute = f' class="{kind}"' if kind else ""
    below = f"<small>{escape(unit)}</small>" if unit else ""
    return f'<th{attribute} scope="col"><button type="button">{escape(title)}</button>{below}</th>'


def _cell(value: float) -> str:
    exact = f"{value!r}" if math.isfinite(value) else ""
    return f'<td data-value="{exact}">{number(value)}</td>'
