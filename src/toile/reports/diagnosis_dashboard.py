"""What TensorBoard shows of a diagnosis: the answer, its ranking, maps, and how the base fit went."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from toile.diagnosis.record import Alias, EffectReport, Estimate, GapReport
from toile.reports.cloth_fields import Upright
from toile.reports.dashboard import table
from toile.reports.diagnosis_arrays import DiagnosisArrays
from toile.reports.diagnosis_wording import (
    answer,
    calibration_caveat,
    certainty,
    change,
    frame_ranges,
    mark,
    percent,
    plain_name,
    shrinkage,
)
from toile.reports.figures import STYLE
from toile.reports.page.diagnosis_charts import alias_order
from toile.reports.palette import ERROR_SCALE, FORCE_SCALE, INK, MUTED


def write_diagnosis_dashboard(
    folder: Path, report: GapReport, arrays: DiagnosisArrays | None = None, upright: Upright | None = None
) -> None:
    """Add a diagnosis to a folder of TensorBoard events.

    Scalars are ``verdict/probability``, ``probability/<effect>``, ``log evidence/<effect>``,
    ``shrink/<effect>``, ``stage/<stage>``; over frames the distance of base model and tracked cloth,
    ``distance/over its median`` and ``distance/mean [mm]``; over passes ``base fit/cost``.

    Args:
        folder: of the events.
        report: contents of diagnosis.json.
        arrays: what was written beside it, or None.
        upright: how the cloth lies in the image, where that is known.
    """
    arrays = arrays or DiagnosisArrays()
    with SummaryWriter(str(folder), filename_suffix=".diagnosis") as writer:
        writer.add_text("answer", answer_text(report))
        writer.add_text("ranking", ranking_table(report))
        if report.alias.detection_limits:
            writer.add_text("detection limits", limits_table(report.alias))
        if arrays.config:
            writer.add_text("configuration", f"```yaml\n{arrays.config.strip()}\n```")
        writer.add_scalar("verdict/probability", report.verdict.probability)
        for effect in report.effects:
            writer.add_scalar(f"probability/{effect.name}", effect.probability)
            if effect.shrink is not None:
                writer.add_scalar(f"shrink/{effect.name}", effect.shrink.estimate)
        for stage, share in report.where.stages.items():
            writer.add_scalar(f"stage/{stage}", share)
        # A distance of exactly 0 in a frame that was held out was not measured.
        unmeasured = set(report.protocol.frames_held_out)
        for frame, score in enumerate(report.where.frames):
            if score != 0 or frame not in unmeasured:
                writer.add_scalar("distance/over its median", score, frame)
        for frame, gap in enumerate([] if arrays.frames_vertices is None else arrays.frames_vertices):
            if gap.any() or frame not in unmeasured:
                writer.add_scalar("distance/mean [mm]", 1e3 * float(gap.mean()), frame)
        if arrays.screening is not None:
            for name, value in arrays.screening.log_evidence.items():
                if math.isfinite(value):
                    writer.add_scalar(f"log evidence/{name}", value)
            for step, cost in enumerate(arrays.screening.costs):
                writer.add_scalar("base fit/cost", float(cost), step)
        if len(report.alias.names) > 1:
            writer.add_figure("alias matrix", alias_figure(report.alias), close=False)
        if arrays.vertices is not None:
            writer.add_figure("distance on the cloth", gap_figure(arrays.vertices, upright), close=False)


def answer_text(report: GapReport) -> str:
    """The answer in Markdown."""
    verdict = report.verdict
    found = report.effect(verdict.effect)
    parts = [f"## {_plain(answer(report))}", _plain(certainty(report))]
    if found is not None and found.shrink is not None:
        parts.append(_plain(shrinkage(found.shrink, found.name)))
    if verdict.next_recording:
        parts.append(f"**Record next:** {_plain(verdict.next_recording)}")
    if verdict.reason:
        parts.append(f"*{_plain(verdict.reason)}*")
    if caveat := calibration_caveat(report):
        parts.append(f"*{_plain(caveat)}*")
    naive = plain_name(report.protocol.naive) if report.protocol.naive else "unknown"
    rows = [
        ("frames used", frame_ranges(report.protocol.frames_used)),
        ("frames held out", frame_ranges(report.protocol.frames_held_out)),
        ("naive answer", naive),
        ("seed", report.protocol.seed),
        ("version", report.protocol.version),
    ]
    return "\n\n".join([*parts, table(("", ""), rows)])


def ranking_table(report: GapReport) -> str:
    """All effects in Markdown, most probable first."""
    rows = [
        (plain_name(e.name), e.stage, percent(e.probability), _estimates(e), _shrink(e))
        for e in sorted(report.effects, key=lambda e: -e.probability)
    ]
    return table(("effect", "stage", f"probability{mark(report)}", "estimates", "held-out error"), rows)


def limits_table(alias: Alias) -> str:
    """Detection limits in Markdown, in the unit of each effect's first parameter."""
    rows = [
        (plain_name(name), "not within its bounds" if limit is None else f"{limit:.3g}")
        for name, limit in sorted(alias.detection_limits.items())
    ]
    return table(("effect", "smallest that would show"), rows)


def alias_figure(alias: Alias) -> Figure:
    """|cosine| between the traces of every pair, names with the same trace beside each other."""
    order = alias_order(alias)
    matrix = np.array(alias.matrix)[np.ix_(order, order)]
    names = [plain_name(alias.names[i]) for i in order]
    size = 2.4 + 0.32 * len(names)
    with mpl.rc_context(STYLE):
        figure = _figure(size + 0.8, size)
        axis = figure.add_subplot()
        image = axis.imshow(matrix, cmap=_colours(FORCE_SCALE), vmin=0, vmax=1)
        axis.grid(visible=False)
        axis.set_xticks(range(len(names)), names, rotation=40, ha="right", color=INK)
        axis.set_yticks(range(len(names)), names, color=INK)
        for (i, j), value in np.ndenumerate(matrix):
            if i != j and value >= 0.5:
                colour = "white" if value > 0.6 else INK
                axis.text(
                    j, i, f"{value:.2f}".lstrip("0"), ha="center", va="center", fontsize=7, color=colour
                )
        figure.colorbar(image, ax=axis, label="|cosine|", shrink=0.6).outline.set_visible(False)
    return figure


def gap_figure(gap: npt.NDArray[np.float64], upright: Upright | None) -> Figure:
    """Mean distance of base model and tracked cloth (h, w) [m], in millimetres."""
    shown = 1e3 * (gap if upright is None else upright(gap))
    with mpl.rc_context(STYLE):
        figure = _figure(4.6, 3.8)
        axis = figure.add_subplot()
        image = axis.imshow(shown, cmap=_colours(ERROR_SCALE), vmin=0)
        axis.set_axis_off()
        axis.set_title(f"mean {shown.mean():.3g} mm, at most {shown.max():.3g} mm", color=MUTED)
        figure.colorbar(image, ax=axis, label="distance [mm]").outline.set_visible(False)
    return figure


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=140)
    FigureCanvasAgg(figure)
    return figure


def _colours(stops: tuple[tuple[float, str], ...]) -> LinearSegmentedColormap:
    return LinearSegmentedColormap.from_list("stops", list(stops))


def _estimates(effect: EffectReport) -> str:
    # Dozens of modes fill a table and say nothing where it is known what they come to.
    return "; ".join(f"{name} {_text(e)}" for name, e in (effect.amounts or effect.parameters).items())


def _text(e: Estimate) -> str:
    unit = "" if e.unit == "1" else f" {e.unit}"
    return f"{e.estimate:.3g} [{e.low:.3g}, {e.high:.3g}]{unit}"


def _shrink(effect: EffectReport) -> str:
    s = effect.shrink
    if s is None:
        return "–"
    placebo = "" if s.best_placebo is None else f", placebo {change(s.best_placebo)}"
    return f"{s.base:.3g} to {s.with_effect:.3g}, {change(s.estimate)}{placebo}"


def _plain(text: str) -> str:
    """Markdown shows it as it is."""
    return text.replace("_", "\\_").replace("*", "\\*").replace("<", "&lt;")
