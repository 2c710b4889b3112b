"""The page of a diagnosis: opens with what the gap is, then shows where it lies and what closes it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from markupsafe import Markup
from PIL import Image

from toile.atomic_file import write_text
from toile.diagnosis.record import (
    AMBIGUOUS,
    NONE,
    UNKNOWN,
    Estimate,
    GapReport,
)
from toile.effects.catalogue import CATALOGUE
from toile.reports import diagnosis_wording
from toile.reports.cloth_fields import ClothField, Upright
from toile.reports.diagnosis_arrays import DiagnosisArrays, gap_field
from toile.reports.diagnosis_wording import (
    STAGES,
    beats_placebo,
    certainty,
    change,
    frame_ranges,
    mark,
    percent,
    plain_name,
)
from toile.reports.page.charts import field_maps
from toile.reports.page.diagnosis_charts import alias_matrix, held_out, mean_map, over_time
from toile.reports.page.document import number, render
from toile.reports.page.viewer import Video, Viewer
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
        report, arrays, where = self.report, self.arrays, self.report.where
        effects = sorted(report.effects, key=lambda effect: -effect.probability)
        # What was refitted is worth a look, however improbable: its held-out error may tell another story.
        shown = [
            e for e in effects if e.probability >= LIKELY or e.name in self._chosen or e.shrink is not None
        ]
        followed = self._motion is not None and len(self._motion) == len(where.frames)
        return render(
            "diagnosis.html.j2",
            title=self.name if self.scene is None else self.scene.name,
            report=report,
            found=report.effect(report.verdict.effect),
            lead=_around_percentage(certainty(report)),
            next_recording=_sentence(report.verdict.next_recording),
            cards=self._cards(),
            ladder=self._ladder(),
            chosen=self._chosen,
            shown=shown or effects[:3],
            others=[e for e in effects if e not in (shown or effects[:3])],
            without_effect=self._without_effect(),
            likely=LIKELY,
            estimates={e.name: [*e.amounts.items(), *_telling(e.parameters)] for e in effects},
            max_estimates=MAX_ESTIMATES,
            bounds=_bounds,
            in_unit=_in_unit,
            wording=diagnosis_wording,
            held_out=held_out(effects, self._chosen),
            **self._on_the_cloth(),
            over_time=over_time(
                where.frames, report.protocol.frames_held_out, cursor=followed, clips=self._clips()
            ),
            followed=followed,
            regimes=sorted(where.regimes.items(), key=lambda item: -item[1]),
            alias_matrix=alias_matrix(report.alias, self._chosen),
            # Cells that a number fits into; on a narrow screen the matrix is moved sideways.
            alias_width=CELL_WIDTH * len(report.alias.names) + 120,
            alike=[
                ([plain_name(n) for n in group], diagnosis_wording.told_apart(report, group))
                for group in self._alike
                if len(group) > 1
            ],
            limits=self._limits(),
            facts=self._facts(),
            config=arrays.config,
        )

    @property
    def _chosen(self) -> tuple[str, ...]:
        """Names that the answer is about."""
        verdict = self.report.verdict
        if verdict.effect == AMBIGUOUS:
            return verdict.candidates
        return (verdict.effect, *([verdict.also] if verdict.also else []))

    @property
    def _alike(self) -> Sequence[Sequence[str]]:
        """Names that leave the same trace."""
        session = self.report.session
        return self.report.alias.classes(ALIKE) if session is None else session.equivalence_classes

    @property
    def _motion(self) -> npt.NDArray[np.float64] | None:
        """Tracked positions (F, H, W, 3) [m]; None where they, or the grid they are on, are not known."""
        positions, scene = self.arrays.positions, self.scene
        if scene is None or positions is None or positions.size != len(positions) * scene.template.numel():
            return None
        return positions.reshape(len(positions), *scene.grid, 3)

    def _cards(self) -> list[tuple[str, str, str]]:
        """Values with their units and what they are."""
        report, verdict = self.report, self.report.verdict
        if verdict.effect == AMBIGUOUS:
            likely = [e for e in report.effects if e.name in verdict.candidates][:4]
            cards = [(percent(e.probability), "", f"{plain_name(e.name)}{mark(report)}") for e in likely]
        else:
            cards = [(percent(verdict.probability), "", f"probability of this answer{mark(report)}")]
        if verdict.stage in STAGES:
            cards.append((verdict.stage, "", f"stage: {STAGES[verdict.stage]}"))
        found = report.effect(verdict.effect)
        if found is not None:
            if found.shrink is not None:
                claim = "" if beats_placebo(found.shrink) else ", no more than a placebo"
                cards.append((change(found.shrink.estimate), "", f"error on {found.shrink.held_out}{claim}"))
            for name, e in found.amounts.items() or _telling(found.parameters)[:1]:
                unit = "" if e.unit == "1" else e.unit
                cards.append((_in_unit(e, e.estimate), unit, Markup("{}, {}").format(name, _bounds(e))))
        if self.arrays.vertices is not None:
            mean = 1e3 * float(self.arrays.vertices.mean())
            what = "mean distance of the base model, left to itself for a few frames, from the tracked cloth"
            cards.append((number(mean), "mm", f"{what}; errors of tracking are part of it"))
        return cards[:5]

    def _clips(self) -> dict[str, int] | None:
        """Numbers of frames of several clips, by name; None where scores are not of these frames."""
        session = self.report.session
        clips = {} if session is None else dict(zip(session.clips, session.frames, strict=False))
        return clips if sum(clips.values()) == len(self.report.where.frames) else None

    def _ladder(self) -> list[tuple[str, float | None, str]]:
        """Stages from forces to pixels with their shares, and whether the answer lies there."""
        shares = self.report.where.stages
        also = self.report.effect(self.report.verdict.also or "")
        here = {self.report.verdict.stage, *([] if also is None else [also.stage])}
        names = [*STAGES, *(name for name in shares if name not in STAGES)] if shares else []
        return [
            (name, shares.get(name), "here" if name in here else "absent" if name not in shares else "")
            for name in names
        ]

    def _without_effect(self) -> list[tuple[str, float, bool]]:
        """The hypotheses that are no effects: name, probability as far as known, whether the answer."""
        verdict, session = self.report.verdict, self.report.session
        if session is not None and session.probabilities and verdict.effect in (NONE, UNKNOWN):
            names = (verdict.effect, UNKNOWN if verdict.effect == NONE else NONE)
            return [
                (plain_name(name), session.probabilities.get(name, 0.0), name == verdict.effect)
                for name in names
            ]
        rest = max(0.0, 1 - sum(e.probability for e in self.report.effects))
        if verdict.effect not in (NONE, UNKNOWN):
            return [("nothing missing, or outside the catalogue", rest, False)]
        other = UNKNOWN if verdict.effect == NONE else NONE
        return [
            (plain_name(verdict.effect), verdict.probability, True),
            (plain_name(other), max(0.0, rest - verdict.probability), False),
        ]

    def _on_the_cloth(self) -> dict[str, Any]:
        """Playback and maps, or the map alone where nothing is known of the motion."""
        motion, scene, mean = self._motion, self.scene, self.arrays.vertices
        if scene is None or motion is None:
            field = None if mean is None else ClothField("gap", "Distance", "mm", "", 1e3 * mean[None])
            chart = None if field is None else mean_map(field, None)
            return {"viewer": None, "gap": field, "gap_map": chart, "acts_map": self._acts_map(None)}
        gap = gap_field(self.arrays, scene.grid, self.report.protocol.frames_held_out)
        if gap is not None and len(gap.values) != len(motion):
            gap = None
        upright = Upright.of(motion[0])
        shown = Viewer.of(
            motion,
            scene.fps,
            video=_video(scene, len(motion)),
            shade=gap,
            ground_truth=None,
            fields=[] if gap is None else [gap],
            upright=upright,
        )
        chart = None if gap is None else field_maps(gap, upright, pinned_vertices(scene))
        return {"viewer": shown, "gap": gap, "gap_map": chart, "acts_map": self._acts_map(upright)}

    def _acts_map(self, upright: Upright | None) -> go.Figure | None:
        """How strongly the effect that is named acts, where it does not act everywhere alike."""
        acts_on = self.arrays.acts_on
        if acts_on is None:
            return None
        return mean_map(ClothField("acts", "Strength", "of its most", "", acts_on[None]), upright)

    def _limits(self) -> list[tuple[str, str, float | None, str]]:
        """Effect, its parameter, the smallest value that would show (None: none within its bounds), unit."""
        found = []
        for name, limit in sorted(self.report.alias.detection_limits.items()):
            parameter = CATALOGUE[name].PARAMETERS[0] if name in CATALOGUE else None
            what, unit = ("", "") if parameter is None else (parameter.name.replace("_", " "), parameter.unit)
            found.append((plain_name(name), what, limit, unit))
        return found

    def _frames(self) -> dict[str, str]:
        """What was fitted, and what was not."""
        protocol, session = self.report.protocol, self.report.session
        if session is None:
            return {
                "frames used": frame_ranges(protocol.frames_used),
                "frames held out": frame_ranges(protocol.frames_held_out),
            }
        clips = [f"{name} ({n} frames)" for name, n in zip(session.clips, session.frames, strict=True)]
        material = [f"{name.replace('_', ' ')} {value:.3g}" for name, value in session.material.items()]
        return {
            "clips": ", ".join(clips),
            "held out": "the last clip, for the prediction of it alone" if len(clips) > 1 else "",
            "material of the base model [SI]": ", ".join(material),
        }

    def _facts(self) -> dict[str, str]:
        report, screening = self.report, self.arrays.screening
        facts = {
            "reason": report.verdict.reason,
            "90 % confidence set": ", ".join(report.verdict.candidates),
            **self._frames(),
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
        return {name: value for name, value in facts.items() if value}


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
    if report.session is not None:
        return "; ".join(use.differences)
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


def _telling(parameters: dict[str, Estimate]) -> list[tuple[str, Estimate]]:
    """Parameters with readable names; those whose interval leaves out 0 come first.

    Of more than are shown at once, dozens of coefficients of gusts, the surest of them come first.
    """
    known = [(name.replace("_", " "), e) for name, e in parameters.items()]
    if len(known) > MAX_ESTIMATES:
        known.sort(key=lambda item: -abs(item[1].estimate) / max(item[1].high - item[1].low, 1e-300))
    return sorted(known, key=lambda item: item[1].low <= 0 <= item[1].high)


def _bounds(estimate: Estimate) -> Markup:
    """The 90 % interval as HTML."""
    if estimate.low == estimate.high:
        # Pinned there by the sign that it must have: no interval was estimated.
        return Markup("at its bound")
    low, high = (_in_unit(estimate, end) for end in (estimate.low, estimate.high))
    return low + " to " + high if low != high else "± " + number(0.5 * (estimate.high - estimate.low))


def _in_unit(estimate: Estimate, value: float) -> Markup:
    """An estimate or an end of its interval as HTML; percentages are changes, and have a sign."""
    return Markup(f"{value:+.0f}".replace("-", "−")) if estimate.unit == "%" else number(value)


def _around_percentage(text: str) -> tuple[str, str, str]:
    """A text before its first percentage, that percentage, and after it."""
    found = re.search(r"(?:[<>] )?\S+ %", text)
    return (text, "", "") if found is None else (text[: found.start()], found[0], text[found.end() :])


def _sentence(text: str) -> str:
    text = text.strip()
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith(('.', '!', '?')) else '.'}"
