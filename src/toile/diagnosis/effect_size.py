"""How far an effect moves the cloth: what moves it less than the model's own errors do is no cause to name.

Where images are precise, evidence grows without limit for whatever takes up the last millimetre that a model
on a grid is wrong by. "None" therefore stands for an interval, not for a point (Berger and Delampady 1987,
Testing precise hypotheses).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import N_WIND, base_of
from toile.diagnosis.joint_fit import JointClip, JointFit, tracked_windows
from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.refits import Refit, acting_with, within_bounds
from toile.diagnosis.shooting import Base
from toile.effects.base import Effect

Array = NDArray[np.float64]

_FEWEST = 8
"""Frames of a piece at least."""


def effect_size(mechanics: Mechanics, model: Refit) -> float:
    """Mean distance [m] of windows with the effect from those without it, all else equal; second halves.

    The effect has the coefficients that are estimated, which its refit may still be on the way to.
    """
    shooting = mechanics.shooting
    (effect,) = model.effects
    acting = (acting_with(effect, within_bounds(effect, model.mean)),)
    away = []
    for window in model.windows:
        without = shooting.simulate(window, window.standardised, model.base)
        try:
            there = shooting.simulate(window, window.standardised, model.base, acting, mechanics.around)
        except FloatingPointError:
            # So strong that a step blows up here; the refit's own coefficients did not.
            there = window
        distance = np.linalg.norm((there.positions - without.positions)[:: shooting.substeps], axis=-1)
        away.append(distance[len(distance) // 2 :].mean())
    return float(np.mean(away))


def moved(clips: Sequence[JointClip], start: Array, fit: JointFit, width: float) -> float:
    """How far the effect in question moves the cloth [widths].

    The first clip is simulated from its first frame to its last, with the effect and without, all else equal;
    what counts is the mean distance in the last third, as for sizes that a generated scene is asked for.

    Args:
        clips: of the session.
        start: material that log ratios refer to (P,).
        fit: in which one effect is in question.
        width: of the cloth [m].
    """
    if not np.any(fit.own):
        return 0.0
    clip, n_material = clips[0], len(start)
    # Effects of the base model act in both.
    usual = fit.effects[0][:-1] if fit.n_usual else ()
    values = np.concatenate((fit.values[:n_material], fit.values[n_material : n_material + N_WIND]))
    base = base_of(start, values)
    frames = clip.windows[-1].last
    while True:
        away = _distance(clip, base, usual, fit.effects[0], frames)
        if away is not None or frames < _FEWEST:
            break
        # What blows up is tried in shorter pieces.
        frames = frames // 2
    return np.inf if away is None else away / width


def _distance(
    clip: JointClip, base: Base, usual: tuple[Effect, ...], effects: tuple[Effect, ...], frames: int
) -> float | None:
    """Mean distance in the last third of pieces of so many frames [m]; None where a step fails."""
    shooting = clip.shooting.with_window(frames)
    away = []
    for window in tracked_windows(shooting, clip.windows[-1].last + 1):
        try:
            both = [
                shooting.simulate(window, window.standardised, base, acting, clip.around)
                for acting in (usual, effects)
            ]
        except FloatingPointError:
            return None
        if not all(one.converged for one in both):
            return None
        distance = np.linalg.norm((both[1].positions - both[0].positions)[:: shooting.substeps], axis=-1)
        away.append(distance[2 * len(distance) // 3 :].mean())
    return float(np.mean(away))
