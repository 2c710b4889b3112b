"""How far the error shrinks on a whole clip that fits have not seen.

Material and effects come from the other clips, but for effects that belong to a clip (gusts, contact): no
other clip knows of those, so they come from the fit to all. The clip left out is predicted piece by piece:
from where the cloth is, and as fast as it is, some frames ahead with nothing free. Where it is and how fast,
in depth above all, images hardly say, and a law that is wrong has drawn it to where that law is right; so
every hypothesis begins with the motion that it has refined itself. The same images judge all of them. The
clip's wind is that of the hypothesis' own fit to all clips, since no other clip knows of it. So starts and
wind have seen what is predicted, those of base model and effect alike; placebos begin with the base model's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import N_WIND, base_of
from toile.diagnosis.image_error import METRIC, ImageError
from toile.diagnosis.joint_fit import JointClip, JointFit, JointFitting, tracked_windows
from toile.diagnosis.record import LAST_CLIP, PIECES, Shrink
from toile.diagnosis.shooting import Base, cosine_modes
from toile.diagnosis.shrinkage import PredictionSettings, interval, shrink_of
from toile.effects.base import Effect, Scope
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]
Refine = Callable[[tuple[Effect, ...], JointFit], JointClip]

_SIZES = (0.05, 0.15, 0.4)
"""Of the placebos' forces [m/s²]."""


@dataclass(frozen=True)
class LeftOut:
    """Prediction of the clip that was left out.

    Attributes:
        shrinks: by effect.
        frames: that were predicted.
    """

    shrinks: dict[str, Shrink]
    frames: tuple[int, ...]


def left_out_shrinks(
    whole: JointFitting,
    without: JointFitting | None,
    base: JointFit,
    fits: Mapping[str, JointFit],
    effects: Mapping[str, Effect],
    ahead: int,
    placebos: int,
    seed: int,
    refine: Refine | None = None,
    workers: Workers = ALONE,
) -> LeftOut:
    """Errors of the predictions of the last clip, with and without effects.

    Args:
        whole: the problem of all clips.
        without: of all but the last one; None where there is only one: then that one is predicted by a fit
            that has seen it, piece by piece.
        base: the base model, fitted to all.
        fits: effects to compare, fitted to all, by name.
        effects: by name.
        ahead: frames of a piece.
        placebos: force fields without meaning; the best one counts.
        seed: of those.
        refine: gives the last clip around the motion that a hypothesis refines it to; None: all begin with
            the motion that there is.
        workers: share the windows of a clip, and placebos.
    """
    clip = whole.clips[-1]
    judge = ImageError(clip.shooting.tracked)
    usual = whole.usual_in(base)
    chosen: dict[str, tuple[tuple[Effect, ...], JointFit]] = {"": (usual, base)}
    chosen |= {name: (_effects_of(fit, usual, effects[name]), fit) for name, fit in fits.items()}
    errors: dict[str, Array | None] = {}
    for name, (own, fit) in chosen.items():
        try:
            there = clip if refine is None else refine(own, fit)
        except FloatingPointError:
            # A step fails where the hypothesis begins, so it predicts nothing.
            errors[name] = None
            continue
        predictor = _Predictor(there, ahead, judge)
        others = (
            fit
            if without is None
            else without.fitted(own, _cut(whole, without, own, fit), workers, spread=False)
        )
        last = whole.layout(own)
        wind = fit.values[last.base(len(whole.clips) - 1)][-N_WIND:]
        values = np.concatenate((others.values[: last.n_material], wind))
        acting = _acting(whole, without, own, others, fit)
        errors[name] = predictor.errors(base_of(whole.start, values), acting)
        if not name:
            ours, model, plain = predictor, base_of(whole.start, values), acting
    without_effect = errors.pop("")
    if without_effect is None:
        return LeftOut({}, ())
    best = _best_placebo(ours, model, plain, without_effect, placebos, seed, workers)
    # What a piece starts with wrongly stays with it: its frames are no cases of their own.
    resampled = PredictionSettings(block=min(ahead, len(without_effect)))
    shrinks = {}
    for name, better in errors.items():
        if better is None:
            continue
        total = shrink_of(without_effect, better)
        low, high = interval(without_effect, better, seed, resampled)
        held = LAST_CLIP if without is not None else f"{PIECES} of {ahead} frames"
        shrinks[name] = Shrink(
            METRIC,
            held,
            float(without_effect.mean() * 1e3),
            float(better.mean() * 1e3),
            total,
            min(low, total),
            max(high, total),
            best,
        )
    return LeftOut(shrinks, ours.frames)


def _effects_of(fit: JointFit, usual: tuple[Effect, ...], effect: Effect) -> tuple[Effect, ...]:
    """Of the base model's own effects their fit is the base model itself."""
    return (*usual, effect) if fit.n_usual else (effect,)


class _Predictor:
    """Predicts a clip piece by piece.

    Args:
        clip: to predict.
        ahead: frames of a piece.
        judge: of predicted frames.
    """

    def __init__(self, clip: JointClip, ahead: int, judge: ImageError) -> None:
        n = clip.windows[-1].last + 1
        self.shooting = clip.shooting.with_window(ahead)
        self.windows = tracked_windows(self.shooting, n)
        self.around = clip.around
        self.frames = tuple(range(1, n))
        self.error = judge

    def errors(self, base: Base, effects: tuple[Effect, ...], field: Array | None = None) -> Array | None:
        """Of every predicted frame (F - 1,) [m], see ImageError; None where a step fails.

        Args:
            base: material and wind.
            effects: that act.
            field: force per mass beside (N, 3) [m/s²].
        """
        shooting = self.shooting if field is None else self.shooting.pushed(field)
        given = shooting.with_effects(effects, self.around, base)
        try:
            moved = shooting.simulate_all(self.windows, [w.standardised for w in self.windows], base, given)
        except FloatingPointError:
            return None
        if not all(window.converged for window in moved):
            return None
        frames = np.concatenate([window.positions[:: shooting.substeps][1:] for window in moved])
        return np.array([self.error.of(frame, x) for frame, x in zip(self.frames, frames, strict=True)])


def _best_placebo(
    ours: _Predictor,
    base: Base,
    usual: tuple[Effect, ...],
    without: Array,
    n: int,
    seed: int,
    workers: Workers,
) -> float | None:
    """Best shrink among smooth static force fields, in either direction and of several sizes."""
    rng = np.random.default_rng(seed)
    modes = cosine_modes(ours.shooting.simulator.cloth.lines, 2)
    fields = []
    for _ in range(n):
        field = np.einsum("kc,kn->nc", rng.standard_normal((len(modes), 3)), modes) / len(modes) ** 0.5
        fields += [size * field for size in (*_SIZES, *(-s for s in _SIZES))]

    def errors(field: Array) -> Array | None:
        return ours.errors(base, usual, field)

    found = [shrink_of(without, one) for one in workers.map(errors, fields) if one is not None]
    return max(found, default=None)


def _cut(whole: JointFitting, without: JointFitting, effects: tuple[Effect, ...], fit: JointFit) -> JointFit:
    """A fit to all clips as the begin of one to all but the last."""
    before, after = whole.layout(effects), without.layout(effects)
    n = len(without.clips)
    coefficients = np.zeros(after.n_coefficients)
    for clip in range(n):
        for there, here in zip(before.coefficients(clip), after.coefficients(clip), strict=True):
            coefficients[here] = fit.coefficients[there]
    cut = replace(
        fit,
        values=fit.values[: after.n_base],
        coefficients=coefficients,
        windows=fit.windows[:n],
        effects=fit.effects[:n],
    )
    return without.costed(effects, cut)


def _acting(
    whole: JointFitting,
    without: JointFitting | None,
    effects: tuple[Effect, ...],
    others: JointFit,
    fit: JointFit,
) -> tuple[Effect, ...]:
    """The effects as they act in the last clip."""
    places = whole.layout(effects).coefficients(len(whole.clips) - 1)
    devices = [] if without is None else [clip.device for clip in without.clips]
    acting = []
    for k, effect in enumerate(effects):
        # What no other clip knows of, its own gusts or a device of its own, comes from the fit to all.
        of_clip = fit.coefficients[places[k]]
        same = devices.index(whole.clips[-1].device) if whole.clips[-1].device in devices else None
        known = {Scope.CLOTH: 0, Scope.DEVICE: same, Scope.CLIP: None}[effect.SCOPE]
        if without is not None and known is not None:
            of_clip = others.coefficients[without.layout(effects).coefficients(known)[k]]
        acting.append(whole.clips[-1].acting(effect, of_clip))
    return tuple(acting)
