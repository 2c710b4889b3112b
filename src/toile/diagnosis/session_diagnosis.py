"""The diagnosis of several clips of one cloth, from their images to one verdict."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import chain
from pathlib import Path

import numpy as np
import psutil
import torch
from numpy.typing import NDArray

from toile.atomic_file import written_atomically
from toile.denormals import denormals_flushed
from toile.diagnosis.apparent_size import change_of_size
from toile.diagnosis.arrays import ACTS_ON_FILE, FRAMES_FILE, VERTICES_FILE
from toile.diagnosis.decision import UNKNOWN, Calibration
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.effect_map import effect_map
from toile.diagnosis.effect_sensitivities import FORCES
from toile.diagnosis.effect_size import Displacement, Displacements
from toile.diagnosis.findings import Finding, amounts, estimates, finding
from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.gap_maps import stage_chances
from toile.diagnosis.held_motion import held_motion
from toile.diagnosis.holder_slips import which_slips, with_slips
from toile.diagnosis.joint_fit import JointFit, JointFitting
from toile.diagnosis.learned.decision import WEIGHTS, LearnedDecision
from toile.diagnosis.learned.features import clip_features
from toile.diagnosis.learned.motion import long_enough
from toile.diagnosis.left_out import LeftOut, left_out_shrinks
from toile.diagnosis.next_clip import expected_gains
from toile.diagnosis.occlusion import OcclusionSettings, hidden_shares, lasting
from toile.diagnosis.outside_causes import OutsideCause, OutsideCauses, outside_stage
from toile.diagnosis.pipeline import Pipeline, Progress
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.record import (
    AMBIGUOUS,
    NONE,
    CalibrationUse,
    Covered,
    EffectReport,
    Estimate,
    GapReport,
    Protocol,
    SessionAnswer,
    Shrink,
    StandIn,
    Where,
)
from toile.diagnosis.results import KINDS
from toile.diagnosis.second_effect import EffectsBeside, SecondEffect
from toile.diagnosis.session_alias import SessionAlias, session_alias
from toile.diagnosis.session_checks import (
    copied_clips,
    moved_holders,
    short_of_memory,
    stopped_short,
    unknown_motions,
    unlike_devices,
    wind_in_still_air,
)
from toile.diagnosis.session_evidence import (
    SessionEvidence,
    promising,
    session_evidence,
)
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import (
    HypothesisStages,
    RefinedMotion,
    SeenClip,
    SessionModel,
    seen_clips,
    uneven_stage,
)
from toile.diagnosis.session_weights import EVIDENCE_FILE, SessionWeights
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import TIMES_FILE, StageTimes
from toile.diagnosis.stored_values import ValueStore
from toile.diagnosis.touched_obstacles import TouchedObstacles
from toile.diagnosis.verdict import (
    is_clear,
    of_class,
    of_two,
    overtaken,
    refuted,
    seen_in_part,
    unsettled,
    verdict_of,
)
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Effect, Scope
from toile.effects.catalogue import CATALOGUE, PUSHING, STAGES, STAND_INS, StandInEffect
from toile.effects.contact import Contact
from toile.errors import InputError
from toile.generation.clip_plan import MOTIONS
from toile.scenes.session import Session
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

KNOWN_BY = {"plumb_line": "gravity_tilt", "clock": "frame_rate"}
"""Effects that something in view has measured."""


_LEAST_GAIN = 0.05
"""Expected information for which it is worth to record another clip [nats]."""

_LACKING = "Something acts on the cloth or within it, and no effect of the catalogue does that."
"""A force, or another change: what it looks like is said of the stand-ins."""

_RESIZED = (
    "The cloth seems to become smaller or larger while what holds it stands still, and no effect of the "
    "catalogue does that."
)

_COVERED = (
    "Something seems to pass before the cloth that the masks take for cloth: there the cloth's print is gone."
)

_UNCOVERED = "the same clip with masks that leave out what passes before the cloth, or one without it"


@dataclass(frozen=True)
class _Found:
    """What the clips have been found to say."""

    clips: list[SeenClip]
    model: SessionModel
    base: JointFit
    fits: dict[str, JointFit]
    evidence: SessionEvidence
    weights: SessionWeights
    alias: SessionAlias
    left_out: LeftOut
    gains: dict[str, float]
    displacements: dict[str, Displacement]
    second: SecondEffect | None
    stand_ins: dict[str, StandIn]
    resized: dict[str, float]
    covered: dict[str, Covered]
    slipped: tuple[int, int]


@denormals_flushed()
def diagnose_session(
    problems: Sequence[DiagnosisProblem],
    session: Session,
    effects: Sequence[Effect],
    settings: DiagnosisSettings,
    together: SessionSettings,
    folder: Path,
    progress: Progress,
    workers: Workers = ALONE,
) -> GapReport:
    """Diagnose several clips of one cloth; results of stages go into the folder, and are used again.

    Args:
        problems: one for every clip, all frames of which are fitted.
        session: the clips.
        effects: candidates, at zero.
        settings: of every clip.
        together: of all clips.
        folder: of the run.
        progress: called with what is being done and the share that is done.
        workers: share what can be done side by side.

    Returns:
        The report; the caller writes it.
    """
    verdict = replace(settings.verdict, named=max(settings.verdict.named, together.named))
    settings = replace(settings, verdict=verdict)
    known = {effect for key, effect in KNOWN_BY.items() if getattr(session, key)}
    effects = tuple(effect for effect in effects if effect.NAME not in known)
    if not effects:
        raise InputError(
            "No effect is in question",
            where="candidates",
            expected="one that the session's plumb line and clock leave open",
            got=", ".join(sorted(known)),
        )
    moving = [effect for effect in effects if isinstance(effect, FORCES)]
    times = StageTimes.going_on(folder / TIMES_FILE)
    # Usual effects act whether they are candidates or not.
    longest = max((p.scene.n_frames - 1) / p.scene.fps for p in problems)
    stand_ins = [STAND_INS[name]().for_clip(longest) for name in together.stand_ins]
    acting = (Contact(), *(CATALOGUE[name]() for name in together.usual), *stand_ins, *effects)
    outcomes = (JointFit, RefinedMotion, TouchedObstacles, OutsideCauses, OutsideCause)
    kinds = (*KINDS, *outcomes, EffectEvidence, Displacement)
    store = StageStore(folder, ValueStore(kinds, acting), times)
    pipeline = Pipeline(store, progress)
    names = list(dict.fromkeys(clip.device for clip in session.clips))
    devices = [names.index(clip.device) for clip in session.clips]
    motions = [clip.motion for clip in session.clips]
    # Of no interest once there is an answer, so the page does not say it.
    n_frames = sum(problem.scene.n_frames for problem in problems)
    n_vertices = int(np.prod([min(together.side, side) for side in problems[0].scene.grid]))
    _said(short_of_memory(n_frames, n_vertices, psutil.virtual_memory().available / 1e9))
    scenes = [problem.scene for problem in problems]
    checks = (unlike_devices(session, scenes), copied_clips(session, scenes))
    remarkable = _said([*unknown_motions(session), *chain.from_iterable(checks)])
    clips = seen_clips(problems, devices, pipeline, progress, motions)

    made_from = {
        f"clip {k}.{key}": value for k, p in enumerate(problems) for key, value in p.made_from.items()
    }
    made_from |= {"together": fingerprint(together), "devices": fingerprint(devices)}
    made_from["still"] = fingerprint([(clip.still_air, clip.held_still) for clip in clips])
    made_from |= {"stiffness": fingerprint(settings.stiffness), "shooting": fingerprint(settings.shooting)}
    held = held_motion(pipeline, clips, together, settings.stiffness, made_from, workers)
    clips, motion, holders, made_from = held.clips, held.motion, held.holders, held.made_from
    for name, clip in zip(session.clip_names, clips, strict=True):
        if clip.let_go:
            _log.info("%s: what holds the cloth does not stay, so the model lets it go", name)
    of_one_clip = SessionWeights.load()
    weights = of_one_clip.of_clips(len(clips))
    changes = {
        name: change
        for name, clip, positions in zip(session.clip_names, clips, holders.positions, strict=True)
        if (change := change_of_size(clip, positions)) is not None
    }
    progress("what passes before the cloth", 0.5)
    hidden = {
        name: hidden_in(clip, together.occlusion)
        for name, clip in zip(session.clip_names, clips, strict=True)
    }
    covered = {
        name: cover for name, shares in hidden.items() if (cover := cover_of(shares, weights)) is not None
    }
    resized = {name: change for name, change in changes.items() if abs(change) > weights.resized}
    if not resized:
        # Holders go with a cloth that seems to change its size.
        remarkable += _said(moved_holders(session, clips, holders.positions))
    # Beside free forces errors are alike everywhere: those take up what the law is wrong by in one place.
    even = motion
    if together.uneven_rounds:
        uneven = uneven_stage(clips, together, settings.stiffness, 0.495, made_from, workers)
        motion = pipeline.run(uneven, motion)
    model = SessionModel(clips, motion, together, settings.stiffness)
    stages = HypothesisStages(model, progress, made_from, workers)
    plain = pipeline.run(stages.plain(0.5), motion)
    base = pipeline.run(stages.usual(0.53), motion, plain)
    remarkable += _said(wind_in_still_air(session, model.fitting.clips, base))
    if any(effect.NAME == Contact.NAME for effect in effects):
        # It is known what the cloth may touch.
        of_one_clip, weights = replace(of_one_clip, searched=0.0), replace(weights, searched=0.0)
    if model.looks_for_obstacles(effects):
        model = model.with_obstacles(pipeline.run(stages.obstacles(0.54), motion, base))
    if any(model.own):
        stages = replace(stages, model=model)
        effects, moving = (*effects, Contact()), [*moving, Contact()]
    outside = pipeline.run(
        outside_stage(
            clips, together, settings.stiffness, [*moving, *stand_ins], 0.55, made_from, workers, model.own
        ),
        even,
    )
    progress("what every effect would change", 0.62)
    # What acts in the base model is among what is linearised, candidate or not.
    candidates = {effect.NAME for effect in moving}
    acting_already = [e for e in model.fitting.usual_in(base) if e.NAME not in candidates]
    considered = [*moving, *stand_ins, *acting_already]
    systems = model.fitting.systems(considered, base, workers)
    quadratic = model.fitting.quadratic(considered, base, systems)
    fits = model.fitting.linearised(considered, base, quadratic)
    fits |= {name: base for name in base.names if name in candidates}
    errors = model.errors(base)
    learned = learned_chances(clips, motion)
    asked = [*moving, *stand_ins]
    chosen = promising(base, fits, asked, errors, together.fitted, plain, base.names, learned)
    # What leads from outside is predicted as well, whatever its fit under a law says.
    leads = outside.leading(weights.asked_of_outside)
    chosen += [e for e in moving if leads == e.NAME and e not in chosen]
    # Tangents say nothing of what works against a stiffness that is not there.
    chosen += [e for e in moving if model.fitting.has_lost_its_stiffness(e, base) and e not in chosen]
    for k, effect in enumerate(chosen):
        share = 0.64 + 0.24 * (k + 1) / (len(chosen) + 1)
        fits[effect.NAME] = pipeline.run(stages.fit(effect, share), motion, base)
    remarkable += _said(stopped_short(base, {effect.NAME: fits[effect.NAME] for effect in chosen}))

    progress("what the clips say together", 0.88)
    calibration = Calibration.load(None if settings.calibration is None else Path(settings.calibration))
    # A motion that is left as tracked errs as tracking does.
    slips = together.slip if together.refining.any else settings.attachment_slip
    of_images = with_slips(clips, holders.positions, effects, slips, resized=bool(resized))
    fitting = model.fitting
    # How far causes from outside move the cloth is known where they were judged.
    moved_by = Displacements(fitting.clips, fitting.start, model.width)
    displacements = moved_by.of_all(
        {
            name: fit
            for name, fit in fits.items()
            if name not in outside.causes or name in (*PUSHING, *STAND_INS)
        },
        workers,
    )
    sizes = {name: one.last for name, one in displacements.items()}
    sizes |= stand_in_sizes(sizes, outside)
    every = {name: sizes.pop(name) for name in base.names if name in sizes}
    displacements = {name: one.displacement for name, one in outside.causes.items()} | displacements
    evidence = session_evidence(
        base,
        fits,
        effects,
        of_images,
        devices,
        errors,
        calibration,
        learned,
        weights,
        every,
        plain,
        sizes,
        outside.causes,
        max(changes.values(), key=abs, default=None),
        max(float(shares.max()) for shares in hidden.values()),
    )
    evidence.motion.write(folder / EVIDENCE_FILE)
    scale = evidence.scale
    alias = session_alias(model.fitting, considered, quadratic, weights.threshold, scale)
    simulated = {effect.NAME: fits[effect.NAME] for effect in chosen}
    progress("prediction of the clip that is left out", 0.89)
    ahead = max(2, round(together.ahead * problems[-1].scene.fps / 25))
    best = [name for name in evidence.chances if name in simulated][: together.refined]

    def foretold(
        fitting: JointFitting, against: JointFit, of: Mapping[str, JointFit], placebos: int
    ) -> LeftOut:
        return left_out_shrinks(
            fitting,
            None if model.left_out is None else model.left_out.with_usual(fitting.usual),
            against,
            of,
            {effect.NAME: effect for effect in moving},
            ahead,
            placebos,
            together.seed,
            lambda own, fit: model.last_clip_of(own, fit, workers),
            workers,
        )

    left_out = foretold(model.fitting, base, {name: fits[name] for name in best}, together.placebos)
    worse = overtaken(left_out.shrinks) if len(clips) > 1 else ()
    if worse and next(iter(evidence.chances)) == NONE:
        evidence = evidence.without(worse, weights)
    second: SecondEffect | None = None
    if sum(evidence.chances.get(effect.NAME, 0.0) for effect in moving) >= settings.verdict.named:
        # Something moves the cloth, whichever it is.
        progress("what acts beside the most probable effect", 0.93)

        def borne_out(
            fitting: JointFitting, with_first: JointFit, fit: JointFit, effect: Effect
        ) -> Shrink | None:
            # Without placebos: whether the second effect does harm is asked, not whether it helps.
            return foretold(fitting, with_first, {effect.NAME: fit}, 0).shrinks.get(effect.NAME)

        beside = EffectsBeside(
            pipeline,
            stages,
            motion,
            base,
            simulated,
            moving,
            outside,
            learned,
            weights,
            borne_out if len(clips) > 1 else None,
        )
        second = beside.second(evidence.chances, settings.verdict, 0.93).unless(worse)
    gains: dict[str, float] = {}
    if not is_clear(evidence.chances, settings.verdict) and not (second and second.name):
        progress("clips that may be recorded next", 0.95)
        gains = expected_gains(
            model.fitting,
            base,
            {**dict.fromkeys(base.names, base), **fits},
            considered,
            systems,
            evidence.motion.without(evidence.silent),
            of_one_clip,
            MOTIONS,
            together.draws,
            together.seed,
            workers,
            boundary=together.boundary,
        )
    progress("answer", 0.99)
    unnamed = _stand_ins(stand_ins, model, fits, outside, evidence, weights)
    found = _Found(
        clips,
        model,
        base,
        fits,
        evidence,
        weights,
        alias,
        left_out,
        gains,
        displacements,
        second,
        unnamed,
        resized,
        covered,
        which_slips(of_images),
    )
    report = _report(found, effects, settings, together, calibration, session, folder)
    return replace(report, warnings=tuple(remarkable))


def _said(warnings: list[str]) -> list[str]:
    """The warnings, said on the console and in the log; the page has them from the report."""
    for warning in warnings:
        _log.warning("%s", warning)
    return warnings


def _stand_ins(
    effects: Sequence[StandInEffect],
    model: SessionModel,
    fits: Mapping[str, JointFit],
    outside: OutsideCauses,
    evidence: SessionEvidence,
    weights: SessionWeights,
) -> dict[str, StandIn]:
    """What stands in for causes that the catalogue lacks, the most probable first."""
    # Odds have the constant of the logits only where the same effects say nothing.
    motion, clip = evidence.motion.without(evidence.silent), model.fitting.clips[0]
    around, times = clip.around, clip.known_times
    odds = motion.odds(weights)
    by_name = {effect.NAME: effect for effect in effects if effect.NAME in odds}
    # UNKNOWN is more: what nothing explains, and what the cloth looks like, say nothing of what moves it.
    every = float(np.logaddexp.reduce(list(evidence.logits.values())))
    found = {}
    for name in sorted(by_name, key=lambda name: -odds[name]):
        effect = by_name[name]
        mean, size = fits[name].own, motion.sizes[name]
        if name in outside.causes and motion.outside[name].nats() > motion.nats(name):
            mean = outside.causes[name].coefficients
        acting = effect.with_values(effect.scales * torch.from_numpy(mean[: len(effect.scales)].copy()))
        chance = float(np.exp(odds[name] - every))
        came_to = acting.amounts(around, _material(model.fitting, fits[name].values), times)
        said = {f"{amount.what} [{amount.unit}]": amount.value for amount in came_to}
        found[name] = StandIn(chance, size if np.isfinite(size) else None, said)
    return found


def hidden_in(clip: SeenClip, settings: OcclusionSettings) -> Array:
    """Share of the cloth's print that is hidden for a while, in every frame of a clip (F,)."""
    # Where the base model is wrong its motion may leave the cloth's print; tracking follows that.
    positions = clip.tracked.positions[: clip.n_frames]
    shares = hidden_shares(clip.problem.reconstruction, positions, settings)
    return lasting(shares, clip.problem.scene.fps, settings)


def cover_of(shares: Array, weights: SessionWeights) -> Covered | None:
    """What seems to be before the cloth; None where nothing does.

    Args:
        shares: of its print that are hidden (F,).
        weights: see SessionWeights.
    """
    frames = np.flatnonzero(shares > weights.covered)
    if not len(frames):
        return None
    return Covered(float(shares.max()), int(frames[0]), int(frames[-1]))


def stand_in_sizes(sizes: Mapping[str, float], outside: OutsideCauses) -> dict[str, float]:
    """How far stand-ins move the cloth: under the law or beside free forces, whichever is farther [widths].

    Args:
        sizes: under the law, by name.
        outside: beside free forces.
    """
    both = [name for name in STAND_INS if name in sizes and name in outside.causes]
    return {name: max(sizes[name], outside.causes[name].displacement.last) for name in both}


def learned_chances(clips: Sequence[SeenClip], motion: RefinedMotion) -> dict[str, float] | None:
    """Probabilities of the learned decision; None without weights, or for clips that are too short for it."""
    if not WEIGHTS.is_file() or not all(long_enough(c.n_frames, c.problem.scene.fps) for c in clips):
        return None
    features = []
    for clip, refined in zip(clips, motion.positions, strict=True):
        scene = clip.problem.scene
        positions = refined.reshape(-1, *scene.grid, 3)
        gravity = scene.gravity.numpy().astype(np.float64)
        features.append(
            clip_features(positions, list(scene.pinned_vertices), scene.fps, gravity, scene.cloth_size)
        )
    return LearnedDecision.load().session_posterior(features)


def _report(
    found: _Found,
    effects: Sequence[Effect],
    settings: DiagnosisSettings,
    together: SessionSettings,
    calibration: Calibration,
    session: Session,
    folder: Path,
) -> GapReport:
    evidence, by_name = found.evidence, {effect.NAME: effect for effect in effects}
    findings = dict(evidence.findings)
    distances = _distances(found)
    _write(folder / VERTICES_FILE, np.concatenate(distances).mean(0))
    _write(folder / FRAMES_FILE, np.concatenate(distances).astype(np.float32))
    alias, unseen = found.alias.alias, found.alias.unseen
    classes = [c for c in alias.classes(together.alike) if len(c) > 1]
    image_evidence = {name: one.log_evidence for name, one in findings.items() if name not in found.fits}
    verdict = verdict_of(
        evidence.chances,
        image_evidence,
        calibration,
        found.left_out.shrinks,
        explained=evidence.left <= found.weights.strange,
        clips=len(found.clips),
        settings=settings.verdict,
    )
    if verdict.effect == UNKNOWN:
        reasons = ((_RESIZED, found.resized), (_COVERED, found.covered))
        said = " ".join(reason for reason, there in reasons if there)
        verdict = replace(verdict, reason=said or _LACKING)
    if unseen:
        # Whatever they do is in the base model already.
        classes = [c for c in classes if not set(c) <= set(unseen)] + [(NONE, *unseen)]
    verdict = of_class(verdict, evidence.chances, classes, settings.verdict)
    second = found.second
    if second is not None and second.name:
        # Sizes of causes from outside are known where the forces within the cloth are free.
        for name, (mean, covariance) in second.found.items():
            if name in findings and name not in evidence.motion.outside:
                log_evidence, wide = findings[name].log_evidence, evidence.scale * covariance
                findings[name] = finding(by_name[name], log_evidence, mean, wide)
        acts = sum(p for name, p in evidence.chances.items() if name in found.fits)
        verdict = of_two(verdict, second.first, second.name, acts * second.chances[second.name])
    if len(found.clips) > 1:
        verdict = refuted(verdict, evidence.chances, found.left_out.shrinks)
    if not found.base.converged:
        verdict = unsettled(verdict, evidence.chances, found.fits)
    pairs = zip(session.clip_names, found.clips, strict=True)
    frames = [(name, clip.n_frames, clip.problem.scene.n_frames) for name, clip in pairs]
    verdict = seen_in_part(verdict, evidence.chances, frames)
    following = ""
    # A class that is one answer is clear where its members are not.
    gains = found.gains if verdict.effect in (AMBIGUOUS, UNKNOWN) else {}
    if gains:
        best, gain = next(iter(gains.items()))
        if gain >= _LEAST_GAIN:
            following = best
            verdict = replace(verdict, next_recording=f"another clip, {best}: {MOTIONS[best]}")
    if verdict.effect == UNKNOWN and found.covered and not found.resized:
        # Another motion would not take it away.
        following, verdict = "", replace(verdict, next_recording=_UNCOVERED)
    mean = np.concatenate(distances).mean((1, 2))
    drops = {**image_evidence, **evidence.drops}
    # What may be moving the cloth, even where that may as well be nothing.
    moving = next((name for name in evidence.chances if name in found.displacements), "")
    moved = found.displacements[moving].known if moving else []
    return GapReport(
        verdict,
        Where(
            stage_chances(evidence.chances),
            tuple((mean / max(float(np.median(mean)), 1e-9)).tolist()),
            VERTICES_FILE,
            acts_on=_write_map(found, verdict.effect, folder),
        ),
        tuple(
            EffectReport(
                name,
                STAGES[name].value,
                chance,
                estimates(findings[name], by_name[name], settings.widened),
                found.left_out.shrinks.get(name),
                _amounts(found, findings[name], by_name[name], session, settings.widened),
            )
            for name, chance in evidence.chances.items()
            if name in findings
        ),
        alias,
        Protocol(
            settings.seed,
            tuple(range(len(mean))),
            (),
            f"toile {version('toile')}",
            max(drops, key=lambda name: drops[name]),
        ),
        CalibrationUse(False, "", "", "", ("sessions have no calibration yet",)),
        session=SessionAnswer(
            session.clip_names,
            tuple(clip.n_frames for clip in found.clips),
            dict(evidence.chances),
            tuple(classes),
            _material(found.model.fitting, found.base.values),
            evidence.left,
            following,
            dict(gains),
            moving,
            tuple(moved) if np.isfinite(moved).all() else (),
            {} if second is None else second.chances,
            "" if second is None else second.first,
            "" if second is None else second.name,
            _obstacles(found, session) if Contact.NAME in (*verdict.candidates, verdict.also) else {},
            found.stand_ins if UNKNOWN in verdict.candidates else {},
            found.resized,
            found.covered,
            unseen,
            None if second is None else second.shrink,
        ),
    )


def _write_map(found: _Found, name: str, folder: Path) -> str | None:
    """Write where the effect that is named acts; the file's name, None where there is nothing to write."""
    (folder / ACTS_ON_FILE).unlink(missing_ok=True)
    acting: list[Effect | None]
    if name == AnchorSlip.NAME:
        # In another clip that number may be another corner, or none.
        clip, vertex = found.slipped
        acting = [AnchorSlip(vertex=vertex) if k == clip else None for k in range(len(found.clips))]
    elif name in found.fits:
        acting = [effects[-1] for effects in found.fits[name].effects]
    else:
        return None
    places = effect_map(found.model, found.base, acting)
    if places is None:
        return None
    _write(folder / ACTS_ON_FILE, places)
    return ACTS_ON_FILE


def _obstacles(found: _Found, session: Session) -> dict[str, dict[str, tuple[float, ...]]]:
    """What may be touched, by clip."""
    pairs = zip(session.clip_names, found.model.own, strict=True)
    return {
        clip: {
            name: tuple(map(float, at))
            for name, at in own[Contact.NAME].place().items()
            if name != "thickness"
        }
        for clip, own in pairs
        if Contact.NAME in own
    }


def _amounts(
    found: _Found, finding: Finding, effect: Effect, session: Session, widened: float
) -> dict[str, Estimate]:
    """What the coefficients of an effect come to, those of the first clip where every clip has its own."""
    fitting, second = found.model.fitting, found.second
    values = found.fits.get(effect.NAME, found.base).values
    if second is not None and effect.NAME in second.found:
        values = second.values
    clip = fitting.clips[0]
    material = _material(fitting, values)
    came_to = amounts(finding, effect, clip.around, material, clip.known_times, widened)
    if effect.SCOPE is not Scope.CLIP or len(found.clips) == 1:
        return came_to
    return {f"{what} in {session.clip_names[0]}": estimate for what, estimate in came_to.items()}


def _material(fitting: JointFitting, values: Array) -> dict[str, float]:
    """Material of a hypothesis by name, SI, from its fit's values."""
    material = fitting.start * np.exp(values[: len(fitting.start)])
    names = fitting.clips[0].shooting.simulator.cloth.energies.parameters.names
    return dict(zip(names, map(float, material), strict=True))


def _distances(found: _Found) -> list[Array]:
    """Base model to tracked cloth, of every clip on the scene's grid (F, H, W) [m]."""
    out = []
    fitting, grids = found.model.fitting, found.model.grids
    for clip, seen_clip, grid, windows in zip(
        fitting.clips, found.model.clips, grids, found.base.windows, strict=True
    ):
        shooting = clip.shooting
        away = np.zeros((len(shooting.tracked.positions), len(grid.prolong)))
        for window in windows:
            frames = window.positions[:: shooting.substeps]
            seen = shooting.tracked.positions[window.first : window.last + 1]
            between = np.einsum("vn,fnc->fvc", grid.prolong, frames - seen)
            away[window.first : window.last + 1] = np.linalg.norm(between, axis=-1)
        out.append(away.reshape(-1, *seen_clip.problem.scene.grid))
    return out


def _write(path: Path, array: NDArray[np.floating]) -> None:
    with written_atomically(path) as temporary:
        np.save(temporary, array)
