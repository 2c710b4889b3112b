"""How far an effect moves the cloth: what moves it less than the model's own errors do is no cause to name.

Where images are precise, evidence grows without limit for whatever takes up the last millimetre that a model
on a grid is wrong by. "None" therefore stands for an interval, not for a point (Berger and Delampady 1987,
Testing precise hypotheses).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import N_WIND, base_of
from toile.diagnosis.joint_fit import JointClip, JointFit, tracked_windows
from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.refits import Refit, acting_with, within_bounds
from toile.effects.base import Effect, Scope
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]

_FEWEST = 8
"""Frames of a piece at least."""

_Motion: TypeAlias = tuple[int, int, bytes, bytes, tuple[str, ...]]
"""Clip, frames of a piece, base values, strengths of its usual effects and their names."""


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
    """How far an effect moves the cloth, all else equal [widths].

    Attributes:
        frames: mean distance over the cloth of the first clip, with the effect and without (F,).
        last: mean distance in the last third, for which sizes of generated scenes are asked: of the first
            clip, or of an effect that belongs to a clip, of that in which it moves the cloth most.
    """

    frames: Array
    last: float

    @property
    def known(self) -> list[float]:
        """The frames' distances; none where the effect tears the cloth apart in the simulation."""
        return self.frames.tolist() if np.isfinite(self.frames).all() else []

    @staticmethod
    def none(n_frames: int) -> Displacement:
        """Of an effect that does nothing."""
        return Displacement(np.zeros(n_frames), 0.0)


class Displacements:
    """How far effects in question move the cloth.

    A clip is simulated from its first frame to its last, with the effect and without, all else equal: the
    first one, and where the effect belongs to a clip (contact, gusts), which may act in a later one alone,
    every other as well. What blows up is simulated in shorter pieces; where even those do, the distance is
    infinite. Hypotheses around one base model have the same motion without their effect, which is simulated
    once.

    Args:
        clips: of the session.
        start: material that log ratios refer to (P,).
        width: of the cloth [m].
    """

    def __init__(self, clips: Sequence[JointClip], start: Array, width: float) -> None:
        self.clips, self.start, self.width = clips, start, width
        self._without: dict[_Motion, list[Array] | None] = {}

    def of_all(self, fits: Mapping[str, JointFit], workers: Workers = ALONE) -> dict[str, Displacement]:
        """How far the effects in question in several fits move it.

        Args:
            fits: by any name.
            workers: share them.
        """
        acting = [fit for fit in fits.values() if np.any(fit.own)]
        frames = self.clips[0].windows[-1].last
        asked = Counter(self._motion_without(0, fit, frames) for fit in acting)
        for fit in acting:
            if asked[self._motion_without(0, fit, frames)] > 1:
                self._simulated_without(0, fit, frames)
        return dict(zip(fits, workers.map(self.of, list(fits.values())), strict=True))

    def of(self, fit: JointFit) -> Displacement:
        """How far the effect moves it that is in question in a fit."""
        if not np.any(fit.own):
            return Displacement.none(self.clips[0].windows[-1].last + 1)
        of_clip = fit.effects[0][-1].SCOPE is Scope.CLIP
        found = [self._in(k, fit) for k in range(len(self.clips) if of_clip else 1)]
        return Displacement(found[0].frames, max(one.last for one in found))

    def _in(self, clip: int, fit: JointFit) -> Displacement:
        """The same in one clip."""
        length = frames = self.clips[clip].windows[-1].last
        found = None
        while found is None and length >= min(_FEWEST, frames):
            found = self._distances(clip, fit, length)
            length //= 2
        if found is None:
            return Displacement(np.full(frames + 1, np.inf), np.inf)
        every = np.concatenate([np.zeros(1), *(piece[1:] for piece in found)]) / self.width
        return Displacement(
            every, float(np.mean([piece[2 * len(piece) // 3 :].mean() for piece in found])) / self.width
        )

    def _distances(self, clip: int, fit: JointFit, frames: int) -> list[Array] | None:
        """Mean distance of every frame of pieces of so many frames [m]; None where a step fails."""
        without = self._simulated_without(clip, fit, frames)
        there = None if without is None else self._motion(clip, fit, fit.effects[clip], frames)
        if without is None or there is None:
            return None
        # Lines of the grid may be closer at the borders; masses are shares of the area.
        masses = self.clips[clip].shooting.masses
        shares = masses / masses.sum()
        return [
            np.linalg.norm(moved - still, axis=-1) @ shares
            for moved, still in zip(there, without, strict=True)
        ]

    def _simulated_without(self, clip: int, fit: JointFit, frames: int) -> list[Array] | None:
        which = self._motion_without(clip, fit, frames)
        if which not in self._without:
            self._without[which] = self._motion(clip, fit, _usual(fit, clip), frames)
        return self._without[which]

    def _motion_without(self, clip: int, fit: JointFit, frames: int) -> _Motion:
        names = tuple(effect.NAME for effect in _usual(fit, clip))
        return clip, frames, fit.values.tobytes(), fit.coefficients[: fit.n_usual].tobytes(), names

    def _motion(
        self, clip: int, fit: JointFit, effects: tuple[Effect, ...], frames: int
    ) -> list[Array] | None:
        """Positions (frames + 1, N, 3) [m] of pieces of so many frames; None where a step fails."""
        of_clip = self.clips[clip]
        material, winds = np.split(fit.values, [len(self.start)])
        wind = winds[N_WIND * clip : N_WIND * (clip + 1)]
        base = base_of(self.start, np.concatenate((material, wind)))
        shooting = of_clip.shooting.with_window(frames)
        given = shooting.with_effects(effects, of_clip.around, base)
        found = []
        for window in tracked_windows(shooting, of_clip.windows[-1].last + 1):
            try:
                moved = shooting.simulate(window, window.standardised, base, given)
            except FloatingPointError:
                return None
            if not moved.converged:
                return None
            found.append(moved.positions[:: shooting.substeps])
        return found


def _usual(fit: JointFit, clip: int) -> tuple[Effect, ...]:
    """Effects of the base model, which act without the one in question as well."""
    return fit.effects[clip][:-1] if fit.n_usual else ()
