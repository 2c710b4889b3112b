"""The page of a diagnosis: opens with what the gap is, then shows where it lies and what closes it."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from toile.atomic_file import write_text
from toile.diagnosis.record import (
    AMBIGUOUS,
    NONE,
    UNKNOWN,
    EffectReport,
    Estimate,
    GapReport,
)
from toile.effects.catalogue import CATALOGUE
from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.diagnosis_arrays import DiagnosisArrays, gap_field
from toile.reports.diagnosis_wording import (
    STAGES,
    answer,
    beats_placebo,
    calibration_caveat,
    certainty,
    change,
    change_between,
    frame_ranges,
    listed,
    mark,
    percent,
    plain_name,
    shrinkage,
)
from toile.reports.page.charts import field_maps
from toile.reports.page.diagnosis_charts import alias_matrix, held_out, mean_map, over_time
from toile.reports.page.document import document, figure, number, section, table, warning_box, with_unit
from toile.reports.page.viewer import Video, viewer
from toile.reports.run_report import OBSERVED_SIZE, pinned_vertices
from toile.scenes.scene import Scene

LIKELY = 0.01
"""Probability from which an effect has a row of its own in the ranking."""
ALIKE = 0.9
"""|cosine| from which two traces count as the same."""
CELL_WIDTH = 20
"""Of the matrix of effects, at least [px]."""
MAX_ESTIMATES = 5
"""Parameters of an effect that the ranking shows at once."""


@dataclass(frozen=True)
class DiagnosisPage:
    """What the page of a diagnosis shows; parts that there are no data for are left out.

    Attributes:
        report: contents of diagnosis.json.
        arrays: what was written beside it.
        scene: for video, grid and frame rate; None leaves video and playback out.
        name: of the scene, where there is none.
    """

    report: GapReport
    arrays: DiagnosisArrays
    scene: Scene | None = None
    name: str = "diagnosis"

    def render(self) -> str:
        """The page as HTML text, self-contained."""
        title = self.name if self.scene is None else self.scene.name
        style = files(__package__).joinpath("diagnosis.css").read_text(encoding="utf-8")
        body = [
            f"<style>{style}</style>",
            self._answer(title),
            _pair(
                section("Where it lies", self._ladder(), note=_LADDER_NOTE),
                section("How far it shrinks", self._held_out(), note=_HELD_OUT_NOTE),
            ),
            section("Which effect", self._ranking(), note=_RANKING_NOTE),
            *self._on_the_cloth(),
            self._over_time(),
            self._alias(),
            section("How it was made", self._details()),
        ]
        return document(f"{title} diagnosed – toile", body)

    @property
    def _chosen(self) -> tuple[str, ...]:
        """Names that the answer is about."""
        verdict = self.report.verdict
        if verdict.effect == AMBIGUOUS:
            return verdict.candidates
        return (verdict.effect, *([verdict.also] if verdict.also else []))

    @property
    def _motion(self) -> npt.NDArray[np.float64] | None:
        """Tracked positions (F, H, W, 3) [m]; None where they, or the grid they are on, are not known."""
        positions, scene = self.arrays.positions, self.scene
        if scene is None or positions is None or positions.size != len(positions) * scene.template.numel():
            return None
        return positions.reshape(len(positions), *scene.grid, 3)

    def _answer(self, title: str) -> str:
        verdict = self.report.verdict
        found = self.report.effect(verdict.effect)
        proof = f" {shrinkage(found.shrink)}" if found is not None and found.shrink is not None else ""
        lead = f"{_bold(certainty(self.report))}{escape(proof)}"
        advice = (
            f'<p class="next"><b>Record next</b>{escape(_sentence(verdict.next_recording))}</p>'
            if verdict.next_recording
            else ""
        )
        # Caveats stand there: what is not explained, frames that do not count.
        reason = f'<p class="note">{escape(verdict.reason)}</p>' if verdict.reason else ""
        caveat = calibration_caveat(self.report)
        reason += f'<p class="note">{escape(caveat)}</p>' if caveat else ""
        shown = self._cards()
        cards = "".join(
            f'<div class="card"><span class="value">{value}</span>{escape(caption)}</div>'
            for value, caption in shown
        )
        return (
            f'<header><p class="eyebrow">toile · diagnosis of {escape(title)}</p>'
            f'<h1 class="answer">{escape(answer(self.report))}</h1>{warning_box(self.report.warnings)}'
            f'<p class="lead">{lead}</p>{reason}{advice}'
            f'<div class="cards" style="max-width: {260 * len(shown)}px">{cards}</div></header>'
        )

    def _cards(self) -> list[tuple[str, str]]:
        """Values (HTML) with what they are."""
        report, verdict = self.report, self.report.verdict
        if verdict.effect == AMBIGUOUS:
            likely = {e.name: e.probability for e in report.effects if e.name in verdict.candidates}
            cards = [
                (escape(percent(p)), f"{plain_name(name)}{mark(report)}")
                for name, p in list(likely.items())[:4]
            ]
        else:
            cards = [(escape(percent(verdict.probability)), f"probability of this answer{mark(report)}")]
        if verdict.stage in STAGES:
            cards.append((escape(verdict.stage), f"stage: {STAGES[verdict.stage]}"))
        found = report.effect(verdict.effect)
        if found is not None:
            if found.shrink is not None:
                claim = "" if beats_placebo(found.shrink) else ", no more than a placebo"
                cards.append((change(found.shrink.estimate), f"error on {found.shrink.held_out}{claim}"))
            for name, e in _telling(found.parameters)[:1]:
                cards.append((_large(e), f"{name}, {_bounds(e)}"))
        if self.arrays.vertices is not None and len(cards) < 5:
            mean = 1e3 * float(self.arrays.vertices.mean())
            what = "mean distance of the base model, left to itself for a few frames, from the tracked cloth"
            cards.append((f"{number(mean)}<small> mm</small>", f"{what}; errors of tracking are part of it"))
        return cards[:5]

    def _ladder(self) -> str:
        shares = self.report.where.stages
        here = {self.report.verdict.stage}
        also = self.report.effect(self.report.verdict.also or "")
        if also is not None:
            here.add(also.stage)
        rungs = []
        names = [*STAGES, *(name for name in shares if name not in STAGES)]
        for name in names:
            share = shares.get(name)
            kind = "here" if name in here else "absent" if share is None else ""
            width = 0.0 if share is None else 100 * min(max(share, 0.0), 1.0)
            value = "–" if share is None else percent(share)
            rungs.append(
                f'<li class="{kind}"><span><b>{escape(name)}</b><small>{escape(STAGES.get(name, ""))}</small>'
                f'</span><span class="bar"><i style="width: {width:.1f}%"></i></span>'
                f"<output>{escape(value)}</output></li>"
            )
        return f'<ol class="ladder">{"".join(rungs)}</ol>' if shares else ""

    def _held_out(self) -> str:
        return figure(held_out(self._ordered(), self._chosen), "held-out")

    def _ordered(self) -> list[EffectReport]:
        return sorted(self.report.effects, key=lambda effect: -effect.probability)

    def _ranking(self) -> str:
        effects = self._ordered()
        # What was refitted is worth a look, however improbable: its held-out error may tell another story.
        shown = [
            e for e in effects if e.probability >= LIKELY or e.name in self._chosen or e.shrink is not None
        ]
        shown = shown or effects[:3]
        others = [e for e in effects if e not in shown]
        if not effects:
            return ""
        head = (
            f"<tr><th>effect</th><th class='left'>probability{mark(self.report)}</th>"
            "<th class='left'>estimates, 90 % intervals</th><th>held-out error</th></tr>"
        )
        rows = [self._row(e) for e in shown]
        rest = max(0.0, 1 - sum(e.probability for e in effects))
        rows += self._without_effect(rest)
        ranking = f'<div class="ranking">{table(head, rows)}</div>'
        if not others:
            return ranking
        more = table(head, [self._row(e) for e in others])
        count = f"{len(others)} other{'s' if len(others) > 1 else ''} below {percent(LIKELY)}"
        return f'{ranking}<details class="ranking"><summary>{count}</summary>{more}</details>'

    def _row(self, effect: EffectReport) -> str:
        verdict = self.report.verdict
        chosen = effect.name in self._chosen
        tags = []
        if effect.name in (verdict.effect, verdict.also):
            tags.append('<span class="tag chosen">the answer</span>')
        elif effect.name in verdict.candidates:
            tags.append('<span class="tag chosen">in the 90 % set</span>')
        if effect.name == self.report.protocol.naive:
            tags.append('<span class="tag">naive answer</span>')
        shrink = "–"
        if effect.shrink is not None:
            s = effect.shrink
            doubt = "" if beats_placebo(s) else '<br><span class="tag doubt">within placebo</span>'
            between = change_between(s.low, s.high)
            shrink = change(s.estimate) + (f"<br><i>{between}</i>" if between else "") + doubt
        return (
            f"<tr{' class=best' if chosen else ''}>"
            f"<th>{escape(plain_name(effect.name))}<small>{escape(effect.stage)}</small>{' '.join(tags)}</th>"
            f'<td class="share">{escape(percent(effect.probability))}{_bar(effect.probability, chosen)}</td>'
            f"<td class='left'>{_estimates(effect.parameters)}</td>"
            f"<td data-label='held-out error'>{shrink}</td></tr>"
        )

    def _without_effect(self, rest: float) -> list[str]:
        """Rows of the two hypotheses that are no effects, as far as the report says how probable they are."""
        verdict = self.report.verdict
        known = {name: plain_name(name) for name in (NONE, UNKNOWN)}
        if verdict.effect in known:
            other = UNKNOWN if verdict.effect == NONE else NONE
            parts = [(verdict.effect, verdict.probability), (other, max(0.0, rest - verdict.probability))]
        else:
            parts = [("", rest)]
        rows = []
        for name, probability in parts:
            chosen = name == verdict.effect
            tag = ' <span class="tag chosen">the answer</span>' if chosen else ""
            label = known.get(name, "nothing missing, or outside the catalogue")
            rows.append(
                f'<tr class="{"best" if chosen else "rest"}"><th>{label}{tag}</th>'
                f'<td class="share">{escape(percent(probability))}{_bar(probability, chosen)}</td>'
                "<td></td><td></td></tr>"
            )
        return rows

    def _on_the_cloth(self) -> list[str]:
        """Playback and maps, or the map alone where nothing is known of the motion."""
        motion, scene = self._motion, self.scene
        if scene is None or motion is None:
            mean = self.arrays.vertices
            if mean is None:
                return []
            field = ClothField("gap", "Distance", "mm", "", 1e3 * mean[None])
            return [section("Where on the cloth", figure(mean_map(field, None), "map-gap"), note=_GAP_NOTE)]
        gap = gap_field(self.arrays, scene.grid, self.report.protocol.frames_held_out)
        if gap is not None and len(gap.values) != len(motion):
            gap = None
        upright = Upright.of(motion[0])
        shown = viewer(
            motion,
            scene.fps,
            video=_video(scene, len(motion)),
            shade=gap,
            ground_truth=None,
            fields=[] if gap is None else [gap],
            upright=upright,
        )
        heading = section("Where on the cloth", shown.replace("reconstructed grid", "tracked grid"))
        if gap is None:
            return [heading]
        chart = field_maps(gap, upright, pinned_vertices(scene))
        note = f"{escape(gap.note)} Seen as the cloth lies in frame 0; circles are pinned vertices."
        maps = figure(chart, "map-gap", {"cursors": "1", "field": "gap"})
        return [heading, section("How far the base model strays", maps, note=note)]

    def _over_time(self) -> str:
        where, protocol = self.report.where, self.report.protocol
        followed = self._motion is not None and len(self._motion) == len(where.frames)
        chart = over_time(where.frames, protocol.frames_held_out, cursor=followed)
        largest = max(where.regimes.values(), default=0.0)
        rows = "".join(
            f'<tr><th>{escape(name)}</th><td>{number(score)}</td><td style="width: 60%">'
            f"{_bar(score / largest if largest > 0 else 0.0, score == largest)}</td></tr>"
            for name, score in sorted(where.regimes.items(), key=lambda item: -item[1])
        )
        regimes = f'<div class="ranking"><table><tbody>{rows}</tbody></table></div>' if where.regimes else ""
        return _pair(
            section(
                "When",
                figure(chart, "over-time", {"cursors": "1"} if followed else None),
                note="Mean distance of every frame over the median of all, the dotted line.",
            ),
            section("In which regime", regimes, note="The same, over parts of the motion."),
            kind="pair even",
        )

    def _alias(self) -> str:
        alias = self.report.alias
        chart = figure(alias_matrix(alias, self._chosen), "alias")
        if chart:
            # Cells that a number fits into; on a narrow screen the matrix is moved sideways.
            width = CELL_WIDTH * len(alias.names) + 120
            chart = f'<div class="scroll"><div style="min-width: {width}px">{chart}</div></div>'
        groups = [group for group in alias.classes(ALIKE) if len(group) > 1]
        if len(alias.names) < 2:
            told = ""
        elif groups:
            items = "".join(
                f"<li>{escape(listed([plain_name(n) for n in group], 'and'))}</li>" for group in groups
            )
            told = f'<ul class="groups">{items}</ul>'
        else:
            told = '<p class="groups">None: every pair leaves traces that differ.</p>'
        heading = "<h3>Cannot be told apart on this clip</h3>" if told else ""
        limits = self._limits()
        return _pair(
            section("What this clip can tell apart", chart, note=_ALIAS_NOTE),
            f"<section>{heading}{told}{limits}</section>" if told or limits else "",
            kind="pair even",
        )

    def _limits(self) -> str:
        limits = self.report.alias.detection_limits
        if not limits:
            return ""
        rows = []
        for name, limit in sorted(limits.items()):
            parameter = CATALOGUE[name].PARAMETERS[0] if name in CATALOGUE else None
            what = "" if parameter is None else f" <i>{escape(parameter.name.replace('_', ' '))}</i>"
            unit = "" if parameter is None else parameter.unit
            value = "<i>not within its bounds</i>" if limit is None else _value(limit, unit)
            rows.append(f"<tr><th>{escape(plain_name(name))}{what}</th><td>{value}</td></tr>")
        head = "<tr><th>effect</th><th>smallest that would show</th></tr>"
        return f'<h3>Detection limits</h3><div class="limits">{table(head, rows)}</div>'

    def _details(self) -> str:
        report, screening = self.report, self.arrays.screening
        facts = {
            "reason": report.verdict.reason,
            "90 % confidence set": ", ".join(report.verdict.candidates),
            "frames used": frame_ranges(report.protocol.frames_used),
            "frames held out": frame_ranges(report.protocol.frames_held_out),
            "naive answer": f"{plain_name(report.protocol.naive)} (the largest drop of the training loss)"
            if report.protocol.naive
            else "",
            "seed": str(report.protocol.seed),
            "version": report.protocol.version,
            "calibration": _calibration(report),
        }
        if screening is not None:
            internal, external = screening.discrepancy
            facts["forces that the base model needs"] = (
                f"{internal:.3g} m/s² per smooth mode, {external:.3g} m/s² where the torques show it"
            )
            if len(screening.costs) > 1:
                passes = f"{screening.costs[0]:.4g} to {screening.costs[-1]:.4g}"
                facts["cost of the base fit"] = f"{passes} in {len(screening.costs) - 1} passes"
        items = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts.items() if v)
        config = self.arrays.config
        whole = f"<details><summary>Configuration</summary><pre>{escape(config)}</pre></details>"
        return f"<dl>{items}</dl>{whole if config else ''}"


def write_diagnosis_page(
    path: Path,
    report: GapReport,
    arrays: DiagnosisArrays | None = None,
    scene: Scene | None = None,
    name: str = "diagnosis",
) -> Path:
    """Write the page as one HTML file that needs no network; returns ``path``.

    Args:
        path: of the file.
        report: contents of diagnosis.json.
        arrays: what was written beside it, see ``DiagnosisArrays.read``; None for nothing.
        scene: for video and playback, or None.
        name: of the scene, where there is none.
    """
    return write_text(path, DiagnosisPage(report, arrays or DiagnosisArrays(), scene, name).render())


def _calibration(report: GapReport) -> str:
    use = report.calibration
    if use is None:
        return ""
    name = use.file or "the package's own"
    if use.calibrated:
        return f"{name}, made with the same settings ({use.settings})"
    return f"{name}; not for these settings ({use.settings or 'unknown'}): {'; '.join(use.differences)}"


def _video(scene: Scene, n_frames: int) -> Video:
    """The observed frames, small; the last one stands for any that are missing."""
    pictures: list[npt.NDArray[np.uint8]] = []
    for frame in scene.frames[:n_frames]:
        pixels = (frame.detach().cpu().float().clamp(0, 1) * 255).round().byte().numpy()
        picture = Image.fromarray(pixels)
        picture.thumbnail((OBSERVED_SIZE, OBSERVED_SIZE), Image.Resampling.LANCZOS)
        pictures.append(np.asarray(picture))
    return Video(scene.camera, {"observed": [*pictures, *pictures[-1:] * (n_frames - len(pictures))]})


def _pair(left: str, right: str, kind: str = "pair") -> str:
    """Two sections side by side, or the one that there is."""
    return f'<div class="{kind}">{left}{right}</div>' if left and right else left + right


def _telling(parameters: dict[str, Estimate]) -> list[tuple[str, Estimate]]:
    """Parameters with readable names; those whose interval leaves out 0 come first."""
    known = [(name.replace("_", " "), e) for name, e in parameters.items()]
    return sorted(known, key=lambda item: item[1].low <= 0 <= item[1].high)


def _estimates(parameters: dict[str, Estimate]) -> str:
    cells = [
        f"<span>{escape(name)}</span><span>{_value(e.estimate, e.unit)}</span><span>{_bounds(e)}</span>"
        for name, e in _telling(parameters)
    ]
    shown = f'<div class="estimates">{"".join(cells[:MAX_ESTIMATES])}</div>' if cells else ""
    if len(cells) <= MAX_ESTIMATES:
        return shown
    rest = f'<div class="estimates">{"".join(cells[MAX_ESTIMATES:])}</div>'
    return f"{shown}<details><summary>{len(cells) - MAX_ESTIMATES} more</summary>{rest}</details>"


def _bounds(estimate: Estimate) -> str:
    if estimate.low == estimate.high:
        # Pinned there by the sign that it must have: no interval was estimated.
        return "at its bound"
    low, high = number(estimate.low), number(estimate.high)
    return f"{low} to {high}" if low != high else f"± {number(0.5 * (estimate.high - estimate.low))}"


def _large(estimate: Estimate) -> str:
    """For a card."""
    unit = "" if estimate.unit == "1" else f"<small> {escape(estimate.unit)}</small>"
    return number(estimate.estimate) + unit


def _value(value: float, unit: str) -> str:
    return with_unit(value, "" if unit == "1" else unit)


def _bar(share: float, chosen: bool) -> str:
    width = 100 * min(max(share, 0.0), 1.0)
    return f'<span class="bar{" chosen" if chosen else ""}"><i style="width: {width:.1f}%"></i></span>'


def _bold(text: str) -> str:
    """Escaped, with the first percentage in the colour of results."""
    before, sign, after = text.partition(" %")
    head, space, value = before.rpartition(" ")
    if head.endswith((" >", " <")):
        head, value = head[:-2], f"{head[-1]} {value}"
    if not sign:
        return escape(text)
    return f'{escape(head + space)}<strong class="value">{escape(value)} %</strong>{escape(after)}'


def _sentence(text: str) -> str:
    text = text.strip()
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '!', '?')) else '.'}"


_LADDER_NOTE = (
    "From forces to pixels. Numerics: what a shorter time step changes, over the base model's distance from "
    "the tracked cloth. The share of another "
    "stage is that of its strongest effect in the evidence for a gap; "
    "a hatched one was not measured."
)
_HELD_OUT_NOTE = (
    "One open simulation over frames that nothing was fitted to. Placebos carry the last residual force on, "
    "as it is or shuffled over the cloth; only what goes beyond the best of them counts."
)
_RANKING_NOTE = (
    "Probability that the effect is what the model lacks. Beside it, what the effect's numbers would be, "
    "each with its 90 % interval."
)
_GAP_NOTE = (
    "Distance between the tracked cloth and the base model, left to itself for a few frames. Errors of "
    "tracking are part of it: it is never zero, whatever the answer."
)
_ALIAS_NOTE = (
    "How alike the traces of two effects are once stiffness, wind and smooth forces have taken their part: "
    "1 means that this clip cannot tell them apart."
)
