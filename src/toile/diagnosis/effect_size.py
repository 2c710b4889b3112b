"""How far an effect moves the cloth: what moves it less than the model's own errors do is no cause to name.

Where images are precise, evidence grows without limit for whatever takes up the last millimetre that a model
on a grid is wrong by. "None" therefore stands for an interval, not for a point (Berger and Delampady 1987,
Testing precise hypotheses).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    given = shooting.with_effects(acting, mechanics.around, model.base)
    away = []
    for window in model.windows:
        without = shooting.simulate(window, window.standardised, model.base)
        try:
            there = shooting.simulate(window, window.standardised, model.base, given)
        except FloatingPointError:
            # So strong that a step blows up here; the refit's own coefficients did not.
            there = window
        distance = np.linalg.norm((there.positions - without.positions)[:: shooting.substeps], axis=-1)
        away.append(distance[len(distance) // 2 :].mean())
    return float(np.mean(away))


@dataclass(frozen=True)
class Displacement:
    """How far an effect moves the cloth of the first clip, all else equal [widths].

    Attributes:
        frames: mean distance over the cloth, with the effect and without (F,).
        last: mean distance in the last third, for which sizes of generated scenes are asked.
    """

    frames: Array
    last: float

    @staticmethod
    def none(n_frames: int) -> Displacement:
        """Of an effect that does nothing."""
        return Displacement(np.zeros(n_frames), 0.0)


def displacement(clips: Sequence[JointClip], start: Array, fit: JointFit, width: float) -> Displacement:
    """How far the effect in question moves the cloth of the first clip.

    The clip is simulated from its first frame to its last, with the effect and without, all else equal. What
    blows up is simulated in shorter pieces; where even those do, the distance is infinite.

    Args:
        clips: of the session.
        start: material that log ratios refer to (P,).
        fit: in which one effect is in question.
        width: of the cloth [m].
    """
    clip, n_material = clips[0], len(start)
    frames = clip.windows[-1].last
    if not np.any(fit.own):
        return Displacement.none(frames + 1)
    # Effects of the base model act in both.
    usual = fit.effects[0][:-1] if fit.n_usual else ()
    values = np.concatenate((fit.values[:n_material], fit.values[n_material : n_material + N_WIND]))
    base = base_of(start, values)
    found = None
    length = frames
    while found is None and length >= _FEWEST:
        found = _distances(clip, base, usual, fit.effects[0], length)
        length //= 2
    if found is None:
        return Displacement(np.full(frames + 1, np.inf), np.inf)
    every = np.concatenate([np.zeros(1), *(piece[1:] for piece in found)]) / width
    return Displacement(
        every, float(np.mean([piece[2 * len(piece) // 3 :].mean() for piece in found])) / width
    )


def _distances(
    clip: JointClip, base: Base, usual: tuple[Effect, ...], effects: tuple[Effect, ...], frames: int
) -> list[Array] | None:
    """Mean distance of every frame of pieces of so many frames [m]; None where a step fails."""
    shooting = clip.shooting.with_window(frames)
    models = [shooting.with_effects(acting, clip.around, base) for acting in (usual, effects)]
    away = []
    for window in tracked_windows(shooting, clip.windows[-1].last + 1):
        try:
            both = [shooting.simulate(window, window.standardised, base, given) for given in models]
        except FloatingPointError:
            return None
        if not all(one.converged for one in both):
            return None
        distance = np.linalg.norm((both[1].positions - both[0].positions)[:: shooting.substeps], axis=-1)
        # Lines of the grid may be closer at the borders; masses are shares of the area.
        away.append(distance @ (shooting.masses / shooting.masses.sum()))
    return away
