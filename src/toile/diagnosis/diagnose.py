"""The diagnosis of one clip, from its images to a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toile.atomic_file import write_npz
from toile.diagnosis.base_fit import N_BASE, base_of
from toile.diagnosis.border import border, border_evidence
from toile.diagnosis.colours import brightness_evidence, colours, exposure_evidence
from toile.diagnosis.decision import NONE, UNKNOWN, Calibration, confidence_set, probabilities
from toile.diagnosis.held_out import predict
from toile.diagnosis.mechanics import Mechanics, analyse_mechanics
from toile.diagnosis.model_grid import model_grid
from toile.diagnosis.recordings import next_recording
from toile.diagnosis.shooting import Shooting, ShootingSettings
from toile.diagnosis.tracked import Tracked, point_settings, tracked_motion, without_calibration
from toile.effects.base import BrightnessEffect, CameraEffect, Effect, ExposureEffect, MaskEffect
from toile.effects.catalogue import STAGES
from toile.evaluation.diagnosis_record import (
    AMBIGUOUS,
    Alias,
    EffectReport,
    Estimate,
    GapReport,
    Protocol,
    Shrink,
    Verdict,
    Where,
)
from toile.fitting.gauss_newton.recipe import TrackingRecipe
from toile.fitting.reconstruction import Reconstruction

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a clip is diagnosed.

    Attributes:
        side: vertices along each side of the model's grid; None for the scene's own.
        held_out: share of the frames at the end that nothing is fitted to.
        shooting: windows and priors.
        stiffness: start values Y, S, B in network units.
        longest_substep: of the base model [s].
        usual_discrepancy: size of a force mode that a right model still needs [m/s²]; beyond it something is
            missing.
        compared: effects whose prediction of held-out frames is measured.
        placebos: force fields without meaning that are fitted and predicted beside them.
        seed: of everything random.
    """

    side: int | None = 20
    held_out: float = 0.25
    shooting: ShootingSettings = field(default_factory=ShootingSettings)
    stiffness: tuple[float, float, float] = (6000.0, 20.0, 1.0)
    longest_substep: float = 0.01
    usual_discrepancy: float = 0.8
    compared: int = 3
    placebos: int = 4
    seed: int = 0


@dataclass(frozen=True)
class Finding:
    """What one candidate has going for it.

    Attributes:
        log_evidence: against the base model.
        mean, deviation: of its numbers in their own units, by name.
    """

    log_evidence: float
    mean: dict[str, float]
    deviation: dict[str, float]


def diagnose(
    reconstruction: Reconstruction,
    recipe: TrackingRecipe,
    effects: Sequence[Effect],
    settings: DiagnosisSettings,
    folder: Path,
    progress: Progress,
) -> GapReport:
    """Diagnose a clip; arrays go into the folder, and what has been tracked there before is used again.

    Args:
        reconstruction: the scene with its cloth and free forces; changed in place.
        recipe: tracks the motion; its last stage is used.
        effects: candidates.
        settings: see DiagnosisSettings.
        folder: of the run.
        progress: called with what is being done and the share that is done.

    Returns:
        The report; the caller writes it.
    """
    torch.manual_seed(settings.seed)
    scene = reconstruction.scene
    F = scene.n_frames
    used = max(6, F - round(settings.held_out * F))
    positions = _tracked_positions(reconstruction, recipe, used, folder, progress)
    grid = model_grid(scene, reconstruction.cloth, settings.side)
    progress("what the images say", 0.45)
    tracked = tracked_motion(reconstruction, positions, grid, point_settings(recipe), settings.seed)
    findings: dict[str, Finding] = {}
    outline = border(scene)
    seen = colours(reconstruction, positions)
    for effect in effects:
        if isinstance(effect, CameraEffect | MaskEffect):
            outlined = border_evidence(effect, scene, outline)
            findings[effect.NAME] = _finding(effect, outlined.log_evidence, outlined.mean, outlined.covariance)
        elif isinstance(effect, BrightnessEffect):
            lit = brightness_evidence(effect, seen)
            findings[effect.NAME] = _finding(effect, lit.log_evidence, lit.mean, lit.covariance)
        elif isinstance(effect, ExposureEffect):
            smeared = exposure_evidence(effect, seen)
            findings[effect.NAME] = _finding(effect, smeared.log_evidence, smeared.mean, smeared.covariance)
    progress("base model", 0.5)
    done = [0]

    def count(what: str, cost: float) -> None:
        done[0] += 1
        progress(f"base model, cost {cost:.0f}", min(0.5 + 0.025 * done[0], 0.85))

    mechanics = analyse_mechanics(
        scene,
        grid,
        tracked,
        effects,
        settings.shooting,
        settings.stiffness,
        settings.longest_substep,
        used,
        count,
    )
    none, moving, unknown = _mechanical_findings(mechanics, settings.usual_discrepancy)
    findings.update(moving)
    calibration = Calibration.load()
    evidence = {name: finding.log_evidence for name, finding in findings.items()}
    found = probabilities({**evidence, UNKNOWN: unknown}, calibration)
    progress("held-out frames", 0.87)
    ranked = [name for name in found if name in findings]
    shrinks = _shrinks(mechanics, tracked, ranked, findings, settings, used, F)
    progress("report", 0.97)
    where = _where(mechanics, tracked, findings, calibration, folder)
    alias = _alias(mechanics, none, calibration)
    reports = tuple(
        EffectReport(
            name,
            STAGES[name].value,
            found[name],
            _estimates(findings[name], next(e for e in effects if name == e.NAME)),
            shrinks.get(name),
        )
        for name in ranked
    )
    naive = _naive(mechanics, findings)
    protocol = Protocol(
        settings.seed, tuple(range(used)), tuple(range(used, F)), f"toile {version('toile')}", naive
    )
    verdict = _verdict(found, findings, calibration, shrinks)
    write_npz(
        folder / "screening.npz",
        {
            "names": np.array(list(evidence)),
            "log_evidence": np.array(list(evidence.values())),
            "unknown": np.array(unknown),
            "discrepancy": np.array(none),
            "base": mechanics.fit.values,
            "costs": np.array(mechanics.fit.history),
        },
    )
    return GapReport(verdict, where, reports, alias, protocol)


def _tracked_positions(
    reconstruction: Reconstruction, recipe: TrackingRecipe, used: int, folder: Path, progress: Progress
) -> Array:
    """Frame positions (F, N, 3); those of the first ``used`` frames have not seen the others."""
    path = folder / "tracked.npz"
    if path.exists():
        with np.load(path) as stored:
            if int(stored["used"]) == used:
                return np.asarray(stored["positions"])
    tracking = without_calibration(recipe)
    tracking.start(reconstruction)
    n = tracking.n_cycles(reconstruction)
    sub = reconstruction.substeps
    early: Array | None = None
    for index in range(n):
        report = tracking.cycle(reconstruction, index)
        motion = tracking.substep_positions()
        assert motion is not None
        if report.n_frames <= used:
            early = motion[0, ::sub].numpy().copy()
        progress(f"tracking, frame {report.n_frames} of {reconstruction.scene.n_frames}", 0.45 * (index + 1) / n)
    assert motion is not None
    positions = motion[0, ::sub].numpy().copy()
    if early is not None:
        count = min(len(early), used)
        positions[:count] = early[:count]
    write_npz(path, {"positions": positions, "used": np.array(used)})
    return positions


def _finding(effect: Effect, log_evidence: float, mean: Array, covariance: Array) -> Finding:
    scales = effect.scales.numpy()
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0)) * scales
    names = [parameter.name for parameter in effect.parameters]
    return Finding(
        float(log_evidence),
        dict(zip(names, (mean * scales).tolist(), strict=True)),
        dict(zip(names, deviation.tolist(), strict=True)),
    )


def _mechanical_findings(mechanics: Mechanics, usual: float) -> tuple[float, dict[str, Finding], float]:
    """Usual discrepancy of the base, findings of the effects that move the cloth, evidence of UNKNOWN."""
    evidence = mechanics.evidence
    base = evidence.posterior((), usual)
    free = evidence.posterior(())
    findings: dict[str, Finding] = {}
    for name, (a, b) in mechanics.columns.items():
        effect = mechanics.effects[name]
        if isinstance(effect, CameraEffect):
            continue
        low = np.array([0.0 if p.low == 0 else -np.inf for p in effect.parameters])
        columns = list(range(evidence.n_base + a, evidence.n_base + b))
        best = evidence.signed(columns, low, usual)
        mean, covariance = np.zeros(b - a), np.zeros((b - a, b - a))
        at = [c - evidence.n_base - a for c in best.columns]
        mean[at] = best.mean
        covariance[np.ix_(at, at)] = best.covariance
        findings[name] = _finding(effect, best.log_evidence - base.log_evidence, mean, covariance)
    return free.discrepancy, findings, free.log_evidence - base.log_evidence


def _naive(mechanics: Mechanics, findings: dict[str, Finding]) -> str:
    """The candidate with the largest drop of the training loss."""
    evidence = mechanics.evidence
    drops = {name: f.log_evidence for name, f in findings.items() if name not in mechanics.columns}
    for name, (a, b) in mechanics.columns.items():
        columns = list(range(evidence.n_base + a, evidence.n_base + b))
        drops[name] = max(evidence.loss_drop(columns, 0.4), drops.get(name, -np.inf))
    return max(drops, key=lambda name: drops[name])


def _estimates(finding: Finding, effect: Effect) -> dict[str, Estimate]:
    """Estimates with 90 % intervals within the bounds."""
    out = {}
    for parameter in effect.parameters:
        mean = float(np.clip(finding.mean[parameter.name], parameter.low, parameter.high))
        reach = 1.645 * _WIDENED * finding.deviation[parameter.name]
        out[parameter.name] = Estimate(
            mean,
            float(np.clip(mean - reach, parameter.low, parameter.high)),
            float(np.clip(mean + reach, parameter.low, parameter.high)),
            parameter.unit,
        )
    return out


def _shrinks(
    mechanics: Mechanics,
    tracked: Tracked,
    ranked: Sequence[str],
    findings: dict[str, Finding],
    settings: DiagnosisSettings,
    used: int,
    n_frames: int,
) -> dict[str, Shrink]:
    """Held-out position errors without and with the first few effects, and with placebos."""
    shooting, fit, around = mechanics.shooting, mechanics.fit, mechanics.around
    last = fit.windows[-1]
    end = min(n_frames - 1, used - 1 + settings.shooting.window)
    if end <= used - 1 or last.end is None:
        return {}
    longer = type(around)(around.cloth, around.cloth_size, around.gravity, around.fps, n_frames)
    base = predict(shooting, longer, fit.base, (), last.end, used - 1, end)
    if base is None:
        return {}
    placebo = _placebo(mechanics, shooting, longer, settings, used - 1, end)
    out: dict[str, Shrink] = {}
    for name in [n for n in ranked if n in mechanics.columns][: settings.compared]:
        refit = _refit(mechanics, name, findings[name], settings.usual_discrepancy)
        if refit is None:
            continue
        effect, shared, state = refit
        with_effect = predict(
            shooting, longer, base_of(fit.start_stiffness, shared), (effect,), state, used - 1, end
        )
        if with_effect is None:
            continue
        gain = 1 - with_effect.errors / np.maximum(base.errors, 1e-6)
        total = 1 - with_effect.errors.mean() / base.errors.mean()
        rng = np.random.default_rng(settings.seed)
        # Blocks of two frames: neighbouring ones share their error.
        blocks = np.array_split(np.arange(len(gain)), max(1, len(gain) // 2))
        draws = []
        for _ in range(400):
            index = np.concatenate([blocks[i] for i in rng.integers(len(blocks), size=len(blocks))])
            draws.append(1 - with_effect.errors[index].mean() / base.errors[index].mean())
        low, high = np.quantile(draws, (0.05, 0.95))
        out[name] = Shrink(
            "distance to tracked positions [mm]",
            f"frames {used} to {end}",
            float(base.errors.mean() * 1e3),
            float(with_effect.errors.mean() * 1e3),
            float(total),
            float(min(low, total)),
            float(max(high, total)),
            placebo,
        )
    return out


def _refit(mechanics: Mechanics, name: str, finding: Finding, usual: float):  # type: ignore[no-untyped-def]
    """Effect, base values and state at the end of the fitted frames with the effect in the model."""
    evidence, fit, shooting = mechanics.evidence, mechanics.fit, mechanics.shooting
    effect = mechanics.effects[name]
    values = torch.tensor([finding.mean[p.name] for p in effect.parameters], dtype=torch.float64)
    low = torch.tensor([p.low for p in effect.parameters], dtype=torch.float64)
    high = torch.tensor([p.high for p in effect.parameters], dtype=torch.float64)
    values = values.clamp(low, high)
    a, b = mechanics.columns[name]
    white = (values / effect.scales).numpy()
    shared, states = evidence.given(
        list(range(evidence.n_base + a, evidence.n_base + b)), white, usual
    )
    window = fit.windows[-1]
    step = states[-1] / np.where(
        np.arange(len(window.white)) >= shooting.layout(window.last - window.first)[1],
        shooting.settings.force,
        1.0,
    )
    moved = shooting.simulate(
        window,
        window.white + step,
        base_of(fit.start_stiffness, shared),
        (effect.with_values(values),),
        mechanics.around,
    )
    if not moved.converged or moved.end is None:
        return None
    return effect.with_values(values), shared, moved.end


def _placebo(
    mechanics: Mechanics, shooting: Shooting, around, settings: DiagnosisSettings, first: int, last: int  # type: ignore[no-untyped-def]
) -> float | None:
    """Best shrink by constant force fields without meaning, fitted like effects."""
    if settings.placebos == 0:
        return None
    fit, window = mechanics.fit, mechanics.fit.windows[-1]
    assert window.end is not None
    base = predict(shooting, around, fit.base, (), window.end, first, last)
    if base is None:
        return None
    # What the discrepancy was at the end of the fitted frames, carried forward: the baseline to beat.
    _, _, force = shooting.local(window, window.white)
    best = -np.inf
    rng = np.random.default_rng(settings.seed)
    carried = force[-1]
    for index in range(settings.placebos):
        extra = carried if index == 0 else carried[rng.permutation(len(carried))]
        found = predict(shooting, around, fit.base, (), window.end, first, last, extra)
        if found is not None:
            best = max(best, 1 - float(found.errors.mean() / base.errors.mean()))
    return best if np.isfinite(best) else None


def _where(
    mechanics: Mechanics,
    tracked: Tracked,
    findings: dict[str, Finding],
    calibration: Calibration,
    folder: Path,
) -> Where:
    """Where the base model, left to itself within a window, departs from the tracked motion."""
    shooting, fit = mechanics.shooting, mechanics.fit
    F = len(tracked.positions)
    away = np.zeros((F, tracked.positions.shape[1]))
    count = np.zeros(F)
    for window in fit.windows:
        white = window.white.copy()
        white[shooting.layout(window.last - window.first)[1] :] = 0.0
        free = shooting.simulate(window, white, fit.base)
        frames = free.positions[:: shooting.substeps]
        for i in range(1, len(frames)):
            away[window.first + i] += np.linalg.norm(
                frames[i] - tracked.positions[window.first + i], axis=-1
            )
            count[window.first + i] += 1
    away /= np.maximum(count, 1)[:, None]
    used = count > 0
    floor = float(np.median(away[used])) if used.any() else 1.0
    vertices = away[used].mean(0).reshape(shooting.grid)
    np.save(folder / "gap_vertices.npy", vertices)
    np.save(folder / "gap_frames_vertices.npy", away.reshape(F, *shooting.grid).astype(np.float32))
    stages: dict[str, float] = {}
    for name, finding in findings.items():
        stage = STAGES[name].value
        stages[stage] = max(stages.get(stage, 0.0), calibration.score(name, finding.log_evidence), 0.0)
    total = sum(stages.values())
    shares = {stage: value / total if total > 0 else 0.0 for stage, value in stages.items()}
    speed = np.linalg.norm(np.diff(tracked.positions, axis=0), axis=-1)
    fast = speed > np.median(speed)
    regimes = {
        "fast": float(away[1:][fast & used[1:, None]].mean() / floor) if (fast & used[1:, None]).any() else 0.0,
        "slow": float(away[1:][~fast & used[1:, None]].mean() / floor) if (~fast & used[1:, None]).any() else 0.0,
    }
    scores = tuple(float(v) for v in away.mean(1) / max(floor, 1e-9))
    return Where(shares, scores, "gap_vertices.npy", regimes)


def _alias(mechanics: Mechanics, size: float, calibration: Calibration) -> Alias:
    """Which effects leave the same trace on this clip, and how weak they may be."""
    fisher = mechanics.evidence.fisher(size)
    names = list(mechanics.columns)
    blocks = [slice(*mechanics.columns[name]) for name in names]
    roots = []
    for block in blocks:
        values, vectors = np.linalg.eigh(fisher[block, block] + 1e-3 * np.eye(block.stop - block.start))
        roots.append(vectors / np.sqrt(np.maximum(values, 1e-9)) @ vectors.T)
    matrix = np.eye(len(names))
    for i in range(len(names)):
        for j in range(i):
            cross = roots[i] @ fisher[blocks[i], blocks[j]] @ roots[j]
            matrix[i, j] = matrix[j, i] = min(1.0, float(np.linalg.norm(cross, 2)))
    limits: dict[str, float | None] = {}
    for name, block in zip(names, blocks, strict=True):
        information = float(fisher[block.start, block.start])
        needed = calibration.usual.get(name, 0.0) + calibration.threshold * max(
            calibration.spread.get(name, 1.0), 1.0
        )
        parameter = mechanics.effects[name].parameters[0]
        limit = float(np.sqrt(2 * max(needed, 1.0) / max(information, 1e-12))) * parameter.scale
        limits[name] = limit if limit <= max(abs(parameter.low), abs(parameter.high)) else None
    return Alias(tuple(names), tuple(tuple(float(v) for v in row) for row in matrix), limits)


def _verdict(
    found: dict[str, float],
    findings: dict[str, Finding],
    calibration: Calibration,
    shrinks: dict[str, Shrink],
) -> Verdict:
    candidates = confidence_set(found)
    first = candidates[0]
    also = None
    if len(candidates) == 1 and first in findings:
        # Another stage leaves a trace of its own: both act.
        others = {
            name: calibration.score(name, f.log_evidence)
            for name, f in findings.items()
            if STAGES[name] != STAGES[first]
        }
        strongest = max(others, key=lambda name: others[name], default=None)
        if strongest is not None and others[strongest] > 2 * calibration.threshold:
            also = strongest
    if len(candidates) > 1:
        stages = {STAGES[c].value for c in candidates if c in STAGES}
        stage = stages.pop() if len(stages) == 1 else UNKNOWN
        listed = ", ".join(candidates)
        return Verdict(
            AMBIGUOUS,
            candidates,
            stage,
            float(sum(found[c] for c in candidates)),
            f"This clip cannot tell {listed} apart.",
            next_recording(candidates),
        )
    if first == NONE:
        return Verdict(
            NONE, candidates, NONE, found[NONE], "The base model explains the clip to within its noise.", ""
        )
    if first == UNKNOWN:
        return Verdict(
            UNKNOWN,
            candidates,
            UNKNOWN,
            found[UNKNOWN],
            "Forces beyond the usual are missing, and no effect of the catalogue supplies them.",
            next_recording(candidates),
        )
    reason = f"{first} explains what the base model misses."
    if first in shrinks:
        s = shrinks[first]
        reason += (
            f" Held-out error goes from {s.base:.1f} to {s.with_effect:.1f} mm ({100 * s.estimate:.0f} % less)."
        )
    return Verdict(first, candidates, STAGES[first].value, found[first], reason, "", also)


# Intervals of the linearised model are too narrow by about this factor.
_WIDENED = 2.0
