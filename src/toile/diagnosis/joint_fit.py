"""One hypothesis at its best fit to several clips of one cloth, with no force that nobody can name.

A free force, however small, buys what an effect would explain: the base model with it fits as well as the
truth, and the evidence is gone. Here a hypothesis has the material, a wind for every clip, starts of windows
tied to the ends before them, and its own effects; what is left is its misfit. Clips share the material and
whatever belongs to the cloth or the device. Every hypothesis is fitted until a pass changes little.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import lsq_linear
from scipy.signal import savgol_filter
from torch import Tensor

from toile.diagnosis.base_fit import (
    N_WIND,
    BaseFit,
    base_deviations,
    base_of,
    changed_windows,
    simulated_windows,
    window_bounds,
)
from toile.diagnosis.continuity import Discrepancy, Joined, WindowSystem
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.evidence import Evidence
from toile.diagnosis.mechanics import effect_systems
from toile.diagnosis.positive import positive_lower
from toile.diagnosis.refits import acting_with, within_bounds
from toile.diagnosis.shooting import Shooting, WindowMotion
from toile.effects.base import Effect, Scope, Surroundings
from toile.limits import Count, CountOrZero, Fraction, NonNegative, Positive, Unit
from toile.physics.state import State
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]
Places = NDArray[np.intp]


@dataclass(frozen=True)
class JointFitSettings:
    """How far a hypothesis is fitted.

    Attributes:
        passes: over all clips at most.
        converged: share of the misfit that a pass gains, below which it is the last one.
        nothing: nats beside it; the last pass as well is one whose quadratic promises no more.
        kept: share of what the quadratic promises that a step must keep; one that keeps less is damped more.
        longest_wind: change of a wind in one pass at most [m/s²].
        chords: further steps of a pass with the same tangents, at most; beside the one that leads a step back
            which keeps too little.
        worth: share of the first step's gain below which such a step is the last one.
        prior_inflation: factor on the prior deviations of an effect's coefficients: those say how large one
            usually is, not how large it can be.
        few: coefficients of an effect that hardly need a prior.
        few_inflation: the factor for effects of no more.
        inextensible: share of the cloth's side by which threads stretch under its weight, below which stiffer
            ones look the same; none get stiffer than that, or than where fits begin.
        force: deviation of each mode of a free force that every hypothesis has beside; 0 for none.
        outside: of those among them that disturb the balance of torques, where there are any, see
            force_modes.
    """

    passes: Count = 25
    converged: NonNegative = 0.003
    nothing: NonNegative = 1.0
    kept: Fraction = 0.1
    longest_wind: Annotated[Positive, Unit("m/s²")] = 2.0
    chords: CountOrZero = 4
    worth: Fraction = 0.1
    prior_inflation: Positive = 3.0
    few: CountOrZero = 3
    few_inflation: Positive = 10.0
    inextensible: Positive = 5e-5
    force: Annotated[NonNegative, Unit("m/s²")] = 0.0
    outside: Annotated[Positive, Unit("m/s²")] = 0.002

    def inflation(self, effect: Effect) -> float:
        """Prior deviation of an effect's coefficients in their own units."""
        return self.few_inflation if len(effect.scales) <= self.few else self.prior_inflation

    @property
    def size(self) -> Discrepancy:
        """Of the forces; anything where windows have none."""
        return Discrepancy(self.force, self.outside) if self.force else Discrepancy(1.0, 1.0)


DEFAULT = JointFitSettings()

_SMOOTHED = 5
"""Frames through which the cubic goes whose slope is the velocity of a start."""

DRAUGHT = 0.02
"""Deviation of the wind in still air, that of a closed room [m/s²]."""

_ANY_WIND = 1e3
"""Times the deviation of a wind, and nothing is known of it."""

_TRUSTED = 0.5
"""Share of what is promised from which on steps may be longer again."""

_SOFT = 2.0
"""Prior deviations below its usual value from which on a stiffness counts as next to nothing."""

_FIRST_PASSES = 5
"""After which it shows from where a fit goes further."""

_ROOM = 1e-12
"""Between the bounds of a coefficient that is at one of them, and below those of the law in logarithms."""


@dataclass(frozen=True)
class JointClip:
    """One clip of the session, and where its fit begins.

    Attributes:
        shooting: its problem.
        around: the nominal clip on the model's grid.
        device: that filmed it, from 0.
        windows: as tracked.
        wind: with which a fit begins (2,) [m/s²].
        own: effects, at zero, that act elsewhere in every clip, as they are in this one, by name.
    """

    shooting: Shooting
    around: Surroundings
    device: int
    windows: list[WindowMotion]
    wind: tuple[float, ...] = (0.0,) * N_WIND
    own: Mapping[str, Effect] = field(default_factory=dict)

    @property
    def known_times(self) -> Tensor:
        """Of the frames that are fitted (T,) [s]."""
        return self.around.frame_times()[: self.windows[-1].last + 1]

    def acting(self, effect: Effect, coefficients: Array) -> Effect:
        """An effect as it acts in this clip, with coefficients (n,) in prior deviations."""
        return acting_with(self.own.get(effect.NAME, effect).in_clip(self.around), coefficients)


def joint_clip(
    shooting: Shooting,
    around: Surroundings,
    n_frames: int,
    device: int = 0,
    *,
    forces: bool = False,
    velocities: Array | None = None,
    wind: tuple[float, ...] = (0.0,) * N_WIND,
) -> JointClip:
    """A clip whose windows start where the cloth was tracked, as fast as it was.

    Args:
        shooting: its problem, with forces or without.
        around: the nominal clip on the model's grid.
        n_frames: frames used.
        device: that filmed it.
        forces: whether windows keep forces of their own, see JointFitSettings.
        velocities: see tracked_windows.
        wind: see JointClip.
    """
    bare = (shooting if forces else shooting.without_forces()).counting_frames_once()
    return JointClip(bare, around, device, tracked_windows(bare, n_frames, velocities), wind)


def tracked_velocities(shooting: Shooting, n_frames: int) -> Array:
    """Of all frames (F, N, 3) [m/s], by cubics through five (Savitzky and Golay 1964); frame 0 is at rest.

    Args:
        shooting: the problem.
        n_frames: frames used.
    """
    over = min(_SMOOTHED, n_frames - (n_frames + 1) % 2)
    apart = shooting.substeps * shooting.simulator.time_step
    x = shooting.tracked.positions[:n_frames]
    v: Array = savgol_filter(x, over, min(3, over - 1), deriv=1, delta=apart, axis=0)
    v[0] = 0.0
    return v


def frame_positions(shooting: Shooting, windows: Sequence[WindowMotion]) -> Array:
    """Positions in all frames (F, N, 3) [m] of windows that follow one another.

    Args:
        shooting: the problem.
        windows: simulated.
    """
    step = shooting.substeps
    return np.concatenate([windows[0].positions[:1], *(window.positions[step::step] for window in windows)])


def fitted_velocities(shooting: Shooting, windows: Sequence[WindowMotion]) -> Array:
    """Of all frames (F, N, 3) [m/s]: those of a fit where its windows start, and as tracked elsewhere.

    A fit around another motion that begins with them has hardly to find them again.

    Args:
        shooting: the problem that was fitted.
        windows: of the fit.
    """
    found = tracked_velocities(shooting, windows[-1].last + 1)
    for window in windows:
        if window.start is not None:
            found[window.first] = window.start.velocities[0].numpy()
    return found


def tracked_windows(shooting: Shooting, n_frames: int, velocities: Array | None = None) -> list[WindowMotion]:
    """Windows that start where the cloth was tracked; their motion is the tracked one.

    Args:
        shooting: the problem.
        n_frames: frames used.
        velocities: of all frames (F, N, 3) [m/s]; None for ``tracked_velocities``.
    """
    sub, h = shooting.substeps, shooting.simulator.time_step
    x = shooting.tracked.positions[:n_frames]
    v = tracked_velocities(shooting, n_frames) if velocities is None else velocities
    path = CubicSpline(np.arange(n_frames), x)
    windows = []
    for first, last in window_bounds(n_frames, shooting.settings.window):
        reference = State.start(
            torch.from_numpy(x[first].copy())[None],
            torch.from_numpy(v[first].copy())[None],
            h,
            shooting.simulator.n_past,
            torch.tensor([first * sub * h], dtype=torch.float64),
        )
        n = last - first
        motion = np.asarray(path(first + np.arange(n * sub + 1) / sub))
        windows.append(WindowMotion(first, last, reference, np.zeros(shooting.layout(n)[2]), motion))
    return windows


class SharedLayout:
    """Which unknowns the windows of all clips share: [material | wind of every clip | coefficients].

    Coefficients of an effect come once for the cloth, once for every device, or once for every clip.

    Args:
        n_material: numbers of the material.
        devices: of every clip.
        effects: of the hypothesis.
    """

    def __init__(self, n_material: int, devices: Sequence[int], effects: Sequence[Effect]) -> None:
        self.n_material, self.n_clips = n_material, len(devices)
        self.n_base = n_material + N_WIND * self.n_clips
        self.effects = tuple(effects)
        self._places: list[list[Places]] = []
        at = 0
        for effect in effects:
            n = len(effect.scales)
            groups = {
                Scope.CLOTH: [0] * self.n_clips,
                Scope.DEVICE: list(devices),
                Scope.CLIP: list(range(self.n_clips)),
            }[effect.SCOPE]
            order = {group: k for k, group in enumerate(dict.fromkeys(groups))}
            self._places.append([at + order[group] * n + np.arange(n) for group in groups])
            at += n * len(order)
        self.n_coefficients = at

    def coefficients(self, clip: int) -> list[Places]:
        """Places of every effect's coefficients in a clip among all coefficients."""
        return [places[clip] for places in self._places]

    @property
    def places(self) -> list[list[int]]:
        """Places of all coefficients of every effect among all coefficients, each once."""
        return [sorted({int(p) for places in of_clips for p in places}) for of_clips in self._places]

    def base(self, clip: int) -> Places:
        """Places of material and wind of a clip among the base values."""
        wind = self.n_material + N_WIND * clip
        return np.array([*range(self.n_material), *range(wind, wind + N_WIND)], np.intp)

    def columns(self, clip: int) -> Places:
        """Places of a clip's shared unknowns [material | wind | coefficients] among all shared ones."""
        return np.concatenate((self.base(clip), *(self.n_base + c for c in self.coefficients(clip))))

    def embedded(self, system: WindowSystem, clip: int) -> WindowSystem:
        """A window's system over the shared unknowns of all clips."""
        columns, n = self.columns(clip), self.n_base + self.n_coefficients
        own, local = len(columns), len(system.standardised)
        at = np.concatenate((columns, n + np.arange(local)))
        matrix, gradient = np.zeros((n + local, n + local)), np.zeros(n + local)
        matrix[np.ix_(at, at)] = system.matrix
        gradient[at] = system.gradient
        link = system.link
        if link is not None:
            before = np.zeros((len(link.before), n + link.before.shape[1] - own))
            before[:, columns] = link.before[:, :own]
            before[:, n:] = link.before[:, own:]
            link = replace(link, before=before)
        return replace(system, matrix=matrix, gradient=gradient, link=link)


@dataclass(frozen=True)
class JointFit:
    """A hypothesis at its best fit.

    Attributes:
        names: of its effects; those of the base model first.
        values: log ratios of the material's numbers, and the winds of all clips (P + 2 C,).
        coefficients: of all these effects in prior deviations, see SharedLayout (n,).
        covariance: of them, (n, n).
        windows: simulated, of every clip.
        effects: acting in every clip.
        misfit: negative log-posterior without determinants: of images, ties, and priors.
        history: misfit after every pass.
        occam: half the log determinant of what the effects' coefficients have learnt.
        converged: whether there was little left to gain, all windows in balance: False where passes ran out,
            or no step gained.
        size: prior deviation of its own coefficients under which it was fitted.
        n_usual: coefficients of the base model's effects, which come before its own.
        deviation: see Effect.deviation, of the effect in question on the material of the fit.
        possible: see Effect.is_possible, of the effect in question on that material.
    """

    names: tuple[str, ...]
    values: Array
    coefficients: Array
    covariance: Array
    windows: list[list[WindowMotion]]
    effects: list[tuple[Effect, ...]]
    misfit: float
    history: tuple[float, ...]
    occam: float
    converged: bool
    size: float = 1.0
    n_usual: int = 0
    deviation: float = 1.0
    possible: bool = True

    @property
    def in_balance(self) -> bool:
        """Whether every sub-step of every window was solved to its tolerance."""
        return all(window.converged for window in chain.from_iterable(self.windows))

    @property
    def own(self) -> Array:
        """Coefficients of the effect in question (n - n_usual,)."""
        return self.coefficients[self.n_usual :]

    @property
    def own_covariance(self) -> Array:
        """Of them, those of the base model's effects integrated out."""
        return self.covariance[self.n_usual :, self.n_usual :]

    def evidence(self, against: JointFit) -> EffectEvidence:
        """What it says about the coefficients of the effect in question; nothing where no cloth has them.

        Args:
            against: the hypothesis without it.
        """
        unit = self.deviation
        own, covariance = self.own / unit, self.own_covariance / unit**2
        if not self.possible:
            return EffectEvidence.of(0.0, np.zeros_like(own), covariance, self.size / unit)
        return EffectEvidence.of(against.misfit - self.misfit, own, covariance, self.size / unit)


class JointFitting:
    """Fits of hypotheses to the same clips.

    Args:
        clips: of one cloth.
        start: material that logarithms refer to (P,).
        values: log ratios where fits begin (P,).
        settings: see JointFitSettings.
        usual: effects, at zero, that the base model has: what no cloth is without.
    """

    def __init__(
        self,
        clips: Sequence[JointClip],
        start: Array,
        values: Array,
        settings: JointFitSettings = DEFAULT,
        usual: Sequence[Effect] = (),
    ) -> None:
        self.clips, self.start, self.settings = list(clips), start, settings
        self.usual = tuple(usual)
        self.size = settings.size
        parameters = self.clips[0].shooting.simulator.cloth.energies.parameters
        self._names = [p.name for p in parameters]
        # Whoever begins with stiffer threads means it.
        upper = [
            max(self._stiffest(), own) if p.name == "stretching" else p.upper
            for p, own in zip(parameters, start, strict=True)
        ]
        self._highest = np.log(upper / start) - _ROOM
        self._values = np.minimum(values, self._highest)
        self._devices = [clip.device for clip in clips]

    def _stiffest(self) -> float:
        """Stiffness Y [N/m] of threads that hardly stretch under the cloth's weight; inf without gravity."""
        around = self.clips[0].around
        weight = float(around.cloth.masses.sum()) * float(around.gravity.norm())
        return weight / (self.settings.inextensible * min(around.cloth_size)) if weight > 0 else np.inf

    def start_fit(self, workers: Workers = ALONE) -> JointFit:
        """The base model where fits begin, without any effect, simulated."""
        return self.started((), np.zeros(0), workers)

    def started(self, effects: Sequence[Effect], coefficients: Array, workers: Workers = ALONE) -> JointFit:
        """A hypothesis where fits begin, simulated.

        Args:
            effects: of the hypothesis, at zero or anywhere.
            coefficients: theirs, in prior deviations, see SharedLayout (n,).
            workers: share the windows of a clip.
        """
        values = np.concatenate((self._values, *(clip.wind for clip in self.clips)))
        layout = self.layout(effects)
        acting = self._acting(layout, coefficients)
        windows = []
        for c, clip in enumerate(self.clips):
            base = base_of(self.start, values[layout.base(c)])
            given = clip.shooting.with_effects(acting[c], clip.around, base)
            own = [window.standardised for window in clip.windows]
            windows.append(simulated_windows(clip.shooting, clip.windows, own, base, given, workers))
        cost = self._cost(layout, windows, values, coefficients)
        names = tuple(effect.NAME for effect in layout.effects)
        covariance = np.diag(self._inflations(layout) ** 2)
        return JointFit(names, values, coefficients, covariance, windows, acting, cost, (cost,), 0.0, False)

    def started_like(self, fit: JointFit, workers: Workers = ALONE) -> JointFit:
        """The usual effects as strong as in a fit around another motion of the same clips, with its forces.

        Args:
            fit: of the usual effects.
            workers: share the windows of a clip.
        """
        pushed = copy.copy(self)
        pushed.clips = [
            replace(
                clip, windows=[_pushed(clip.shooting, *pair) for pair in zip(clip.windows, own, strict=True)]
            )
            for clip, own in zip(self.clips, fit.windows, strict=True)
        ]
        return pushed.started(self.usual, fit.coefficients, workers)

    def expected(self, values: Array) -> JointFit:
        """The base model with these values and the clips' windows as they are; nothing is fitted.

        Args:
            values: log ratios of the material's numbers, and the winds of all clips (P + 2 C,).
        """
        none: list[tuple[Effect, ...]] = [()] * len(self.clips)
        windows = [clip.windows for clip in self.clips]
        return JointFit((), values, np.zeros(0), np.zeros((0, 0)), windows, none, 0.0, (0.0,), 0.0, False)

    def fitted(
        self,
        effects: Sequence[Effect],
        begin: JointFit,
        workers: Workers = ALONE,
        *,
        spread: bool = True,
    ) -> JointFit:
        """A hypothesis at its best.

        Args:
            effects: of the hypothesis, at zero or anywhere; () for the base model.
            begin: the base model, or a fit of some of these effects.
            workers: share the windows of a clip.
            spread: whether the coefficients' covariance is asked for. Without, it stays that of where the
                last tangents were made: those at the end, which cost as much as a pass, are not.
        """
        layout = self.layout(effects)
        place = self._placed(layout, begin)
        damping, history = 0.0, [place.misfit]
        converged = False
        damped = self.clips[0].shooting.settings.damping
        evidence = self._evidence(layout, place, workers)
        spread = spread and layout.n_coefficients > 0
        little = 0
        for k in range(self.settings.passes):
            moved, damping, trusted = self._step(layout, place, evidence, damping, workers)
            if moved is None:
                # Nothing to gain; or nowhere to go, where the quadratic does not hold even for short steps.
                converged = trusted
                break
            first = place.misfit - moved.misfit
            moved = self._further(layout, moved, first, evidence, damping, workers)
            gained = place.misfit - moved.misfit
            place = moved
            history.append(place.misfit)
            # One short step is no sign of having arrived, two are.
            nothing = max(self.settings.converged * abs(place.misfit), self.settings.nothing)
            little = little + 1 if gained < nothing else 0
            converged = little > 0 and (damping == 0 or little > 1)
            ends = converged or k == self.settings.passes - 1
            if spread or not ends:
                evidence = self._evidence(layout, place, workers)
            if ends:
                break
            if trusted:
                damping = damped.less(damping)
        covariance, occam = self._learnt(layout, evidence)
        return replace(
            place,
            history=(*begin.history, *history[1:]),
            covariance=covariance,
            occam=occam,
            converged=converged and place.in_balance,
            size=self.settings.inflation(effects[-1]) if effects else 1.0,
            n_usual=len(begin.coefficients) if len(effects) > len(begin.names) else begin.n_usual,
            deviation=self._deviation_of(effects[-1], place.values) if effects else 1.0,
            possible=self._is_possible(place.effects[0][-1], place.values) if effects else True,
        )

    def fitted_hypothesis(self, effect: Effect, base: JointFit, workers: Workers = ALONE) -> JointFit:
        """A hypothesis at its best, from where the base model has ended: it cannot be worse.

        Where the base model has lost the stiffness that the effect works against, a fit begins with that as
        it usually is, see ``has_lost_its_stiffness``. It goes on if it soon explains more than the base model
        does and a cloth can be like that; if not, the effect does nothing.

        Args:
            effect: in question.
            base: the base model.
            workers: share the windows of a clip.
        """
        hypothesis = self.hypothesis(effect, base)
        begin = self._with_its_stiffness(effect, base, workers)
        if begin is None:
            return self.fitted(hypothesis, base, workers)
        brief = copy.copy(self)
        brief.settings = replace(self.settings, passes=min(_FIRST_PASSES, self.settings.passes))
        tried = brief.fitted(hypothesis, begin, workers, spread=False)
        if tried.possible and tried.misfit < base.misfit:
            return self.fitted(hypothesis, tried, workers)
        # From where the base model has ended it would push a cloth that resists nothing.
        return self._nothing_said(effect, base)

    def _nothing_said(self, effect: Effect, base: JointFit) -> JointFit:
        """The base model as a hypothesis whose own effect does nothing."""
        there = self.with_effect_at_zero(base, effect)
        n, deviation = len(base.coefficients), self._deviation_of(effect, base.values)
        return replace(
            there, n_usual=n, size=self.settings.inflation(effect), deviation=deviation, possible=True
        )

    def has_lost_its_stiffness(self, effect: Effect, base: JointFit) -> bool:
        """Whether the base model has next to nothing of the stiffness against which an effect works.

        A model that lacks a moment makes up for it that way. There the logarithm of the stiffness has no
        slope any more: neither tangents show what the effect would do, nor does a fit come back.

        Args:
            effect: in question.
            base: the base model.
        """
        k = self._stiffness_of(effect)
        return k is not None and bool(base.values[k] < -_SOFT * self._deviations(self.layout(()))[k])

    def _deviation_of(self, effect: Effect, values: Array) -> float:
        """See Effect.deviation, on a material of these log ratios."""
        return effect.deviation(self._material(values))

    def _is_possible(self, acting: Effect, values: Array) -> bool:
        """See Effect.is_possible, on a material of these log ratios."""
        return acting.is_possible(self._material(values))

    def _material(self, values: Array) -> dict[str, float]:
        material = self.start * np.exp(np.minimum(values[: len(self.start)], self._highest))
        return dict(zip(self._names, map(float, material), strict=True))

    def _stiffness_of(self, effect: Effect) -> int | None:
        """Place of the stiffness against which an effect works among the material's numbers."""
        return self._names.index(effect.STIFFNESS) if effect.STIFFNESS in self._names else None

    def _with_its_stiffness(self, effect: Effect, base: JointFit, workers: Workers) -> JointFit | None:
        """The base model with the stiffness that it has lost where fits begin.

        None where it has lost none, or a step with it blows up.
        """
        k = self._stiffness_of(effect)
        if k is None or not self.has_lost_its_stiffness(effect, base):
            return None
        n = len(self.start)
        other = copy.copy(self)
        other._values = base.values[:n].copy()
        other._values[k] = 0.0
        winds = base.values[n:].reshape(-1, N_WIND)
        other.clips = [
            replace(clip, windows=windows, wind=tuple(map(float, wind)))
            for clip, windows, wind in zip(self.clips, base.windows, winds, strict=True)
        ]
        try:
            begin = other.started(self.usual_in(base), base.coefficients, workers)
        except FloatingPointError:
            return None
        return begin if begin.in_balance else None

    def with_usual(self, effects: Sequence[Effect]) -> JointFitting:
        """Fits to the same clips with another base model.

        Args:
            effects: at zero, that it has.
        """
        other = copy.copy(self)
        other.usual = tuple(effects)
        return other

    def with_own(self, own: Sequence[Mapping[str, Effect]]) -> JointFitting:
        """Fits to the same clips with effects that act elsewhere in each, see JointClip.own."""
        other = copy.copy(self)
        other.clips = [replace(clip, own=there) for clip, there in zip(self.clips, own, strict=True)]
        return other

    def with_effect_at_zero(self, fit: JointFit, effect: Effect) -> JointFit:
        """A fit to which an effect belongs that does nothing yet.

        Args:
            fit: without it.
            effect: at zero.
        """
        n = self.layout((effect,)).n_coefficients
        return replace(
            fit,
            names=(*fit.names, effect.NAME),
            coefficients=np.concatenate((fit.coefficients, np.zeros(n))),
            covariance=block_diag(fit.covariance, self.settings.inflation(effect) ** 2 * np.eye(n)),
            effects=[(*acting, effect) for acting in fit.effects],
        )

    def usual_in(self, base: JointFit) -> tuple[Effect, ...]:
        """Effects that a base model has."""
        return tuple(effect for effect in self.usual if effect.NAME in base.names)

    def hypothesis(self, effect: Effect, base: JointFit) -> tuple[Effect, ...]:
        """Effects of the model in which one is in question: those of the base model, and that one.

        Args:
            effect: none of the base model's.
            base: the base model.
        """
        return (*self.usual_in(base), effect)

    def layout(self, effects: Sequence[Effect]) -> SharedLayout:
        """Which unknowns the clips share under a hypothesis."""
        return SharedLayout(len(self.start), self._devices, effects)

    def costed(self, effects: Sequence[Effect], fit: JointFit) -> JointFit:
        """A fit that was made for more clips, with the misfit of these."""
        layout = self.layout(effects)
        cost = self._cost(layout, fit.windows, fit.values, fit.coefficients)
        return replace(fit, misfit=cost, history=(cost,))

    def systems(
        self, effects: Sequence[Effect], fit: JointFit, workers: Workers = ALONE
    ) -> list[list[WindowSystem]]:
        """Of every clip around a fit of the base model, with the coefficients of effects that may be added.

        They are over [material | wind | coefficients | local unknowns] of the clip, see ``fisher``.

        Raises:
            ValueError: an effect of the fit is missing among the effects.
        """
        absent = set(fit.names) - {effect.NAME for effect in effects}
        if absent:
            raise ValueError(
                f"effects: expected all of the base model's, without {', '.join(sorted(absent))}"
            )
        layout = self.layout(effects)
        place = self._placed(layout, fit)
        return [self._systems(layout, place, c, workers, motion=False) for c in range(len(self.clips))]

    def fisher(self, effects: Sequence[Effect], systems: Sequence[Sequence[WindowSystem]]) -> Array:
        """Information on the effects' coefficients; material, winds and windows' own unknowns integrated out.

        Args:
            effects: see ``systems``.
            systems: of every clip.
        """
        layout = self.layout(effects)
        return self._joined(layout, systems, np.zeros(layout.n_base)).fisher(self.size)

    def in_any_wind(self, evidence: Evidence) -> Evidence:
        """The same where a steady wind may be as strong as it likes, but in clips whose air is still.

        Args:
            evidence: of these clips.
        """
        winds = [1.0 if clip.around.still_air else _ANY_WIND for clip in self.clips for _ in range(N_WIND)]
        # What the windows' own unknowns leave is the same, and kept.
        other = copy.copy(evidence)
        other.deviations = evidence.deviations * np.concatenate((np.ones(len(self.start)), winds))
        return other

    def quadratic(
        self, effects: Sequence[Effect], base: JointFit, systems: Sequence[Sequence[WindowSystem]]
    ) -> Evidence:
        """What ``linearised`` minimises; the same wherever effects that do nothing yet are reckoned.

        Args:
            effects: see ``linearised``.
            base: see there.
            systems: see there.
        """
        layout = self.layout(effects)
        return self._joined(layout, systems, base.values, self._placed(layout, base).coefficients)

    def linearised(
        self, effects: Sequence[Effect], base: JointFit, evidence: Evidence
    ) -> dict[str, JointFit]:
        """Every effect at the minimum of the quadratic around the base model; nothing is simulated.

        Args:
            effects: that may be added; those of the base model among them, if it has any.
            base: the base model.
            evidence: the quadratic of all these effects around it, see ``quadratic``.

        Returns:
            By name; of the base model's effects nothing.
        """
        layout = self.layout(effects)
        usual, wide = [], []
        for effect, places in zip(effects, layout.places, strict=True):
            if effect.NAME in base.names:
                usual += [layout.n_base + place for place in places]
                wide += [self.settings.inflation(effect)] * len(places)
        found = {}
        for effect, places in zip(effects, layout.places, strict=True):
            if effect.NAME in base.names:
                continue
            alone = self.layout(self.hypothesis(effect, base))
            n_usual, inflation = len(base.coefficients), self.settings.inflation(effect)
            free = [layout.n_base + place for place in places]
            # Sizes of the prior only: the evidence of the fit is made of drop and covariance.
            information, score = evidence.information(free, self.size, usual, wide)
            precision = information + np.eye(len(free)) / inflation**2
            covariance = np.asarray(np.linalg.inv(precision), np.float64)
            # Within the bounds: strengths cut off one by one would be worse than none.
            low, high = self._reach(alone, self._placed(alone, base))
            lower = positive_lower(0.5 * (precision + precision.T))
            bounds = (low[alone.n_base + n_usual :], high[alone.n_base + n_usual :])
            found_at = lsq_linear(lower.T, solve_triangular(lower, score, lower=True), bounds, method="bvls")
            coefficients = self._bounded(alone, np.concatenate((base.coefficients, found_at.x)))
            best, acting = coefficients[n_usual:], self._acting(alone, coefficients)
            drop = float(score @ best - 0.5 * best @ precision @ best)
            found[effect.NAME] = replace(
                base,
                names=tuple(one.NAME for one in alone.effects),
                coefficients=coefficients,
                covariance=block_diag(base.covariance, covariance),
                effects=acting,
                misfit=base.misfit - drop,
                converged=False,
                size=inflation,
                n_usual=n_usual,
                deviation=self._deviation_of(effect, base.values),
                possible=self._is_possible(acting[0][-1], base.values),
            )
        return found

    def _placed(self, layout: SharedLayout, begin: JointFit) -> JointFit:
        """A hypothesis where another one with some of its effects has ended."""
        names = tuple(effect.NAME for effect in layout.effects)
        if names == begin.names:
            return begin
        coefficients = np.zeros(layout.n_coefficients)
        by_name = {effect.NAME: effect for effect in layout.effects}
        before = self.layout([by_name[name] for name in begin.names if name in by_name])
        for clip in range(len(self.clips)):
            here = dict(zip(names, layout.coefficients(clip), strict=True))
            for effect, places in zip(before.effects, before.coefficients(clip), strict=True):
                coefficients[here[effect.NAME]] = begin.coefficients[places]
        # Where no step gains anything they act as they are.
        acting = self._acting(layout, coefficients)
        return replace(begin, names=names, coefficients=coefficients, effects=acting)

    def _acting(self, layout: SharedLayout, coefficients: Array) -> list[tuple[Effect, ...]]:
        return [
            tuple(
                own.acting(effect, coefficients[places])
                for effect, places in zip(layout.effects, layout.coefficients(clip), strict=True)
            )
            for clip, own in enumerate(self.clips)
        ]

    def _bounded(self, layout: SharedLayout, coefficients: Array) -> Array:
        bounded = coefficients.copy()
        for clip in range(len(self.clips)):
            for effect, places in zip(layout.effects, layout.coefficients(clip), strict=True):
                bounded[places] = within_bounds(effect, coefficients[places])
        return bounded

    def _evidence(
        self, layout: SharedLayout, place: JointFit, workers: Workers, *, motion: bool = True
    ) -> Evidence:
        clips = range(len(self.clips))
        systems = [self._systems(layout, place, c, workers, motion=motion) for c in clips]
        return self._joined(layout, systems, place.values, place.coefficients)

    def _joined(
        self,
        layout: SharedLayout,
        systems: Sequence[Sequence[WindowSystem]],
        values: Array,
        coefficients: Array | None = None,
    ) -> Evidence:
        """Evidence of all clips from the systems of each, see ``systems``."""
        embedded = [layout.embedded(one, c) for c, own in enumerate(systems) for one in own]
        return Evidence(embedded, values, self._deviations(layout), coefficients=coefficients)

    def _systems(
        self, layout: SharedLayout, place: JointFit, c: int, workers: Workers, *, motion: bool
    ) -> list[WindowSystem]:
        """Of one clip's windows, over [material | its wind | its coefficients | local unknowns]."""
        clip = self.clips[c]
        fit = BaseFit(place.windows[c], self.start, place.values[layout.base(c)], place.misfit, ())
        n = sum(len(effect.scales) for effect in layout.effects)
        acting = self._acting(layout, place.coefficients)[c]
        return effect_systems(clip.shooting, fit, acting, clip.around, None, n, workers, motion=motion)

    def _deviations(self, layout: SharedLayout) -> Array:
        of_clip = base_deviations(self.clips[0].shooting)
        draught = np.full(N_WIND, DRAUGHT)
        winds = [draught if clip.around.still_air else of_clip[-N_WIND:] for clip in self.clips]
        return np.concatenate((of_clip[:-N_WIND], *winds))

    def _longest(self, layout: SharedLayout) -> Array:
        stiffness = self.clips[0].shooting.settings.longest_stiffness
        winds = N_WIND * layout.n_clips
        return np.array([stiffness] * layout.n_material + [self.settings.longest_wind] * winds)

    def _cost(
        self, layout: SharedLayout, windows: list[list[WindowMotion]], values: Array, coefficients: Array
    ) -> float:
        images = sum(
            clip.shooting.clip_cost(own, self.size) for clip, own in zip(self.clips, windows, strict=True)
        )
        prior = ((values / self._deviations(layout)) ** 2).sum()
        own = ((coefficients / self._inflations(layout)) ** 2).sum()
        return float(images + 0.5 * (prior + own))

    def _step(
        self, layout: SharedLayout, place: JointFit, evidence: Evidence, damping: float, workers: Workers
    ) -> tuple[JointFit | None, float, bool]:
        """One pass, the damping that it took, and whether the quadratic held; None where nothing is gained.

        A full step that lowers the misfit a little is no sign of having arrived: where the quadratic promises
        much more, a shorter one gains more.
        """
        settings, damped = self.settings, self.clips[0].shooting.settings.damping
        best, taken = None, damping
        for _ in range(damped.tried):
            joined = Joined(evidence.systems, self.size, damping)
            shared = self._shared_step(layout, place, joined, damping)
            now, scale = np.concatenate((place.values, place.coefficients)), self._scale(layout)
            of_priors = 0.5 * float(((now / scale) ** 2).sum() - (((now + shared) / scale) ** 2).sum())
            promised = joined.promised(shared) + of_priors
            if damping == 0 and promised < settings.nothing:
                return None, damping, True
            moved = self._moved(layout, place, shared, joined.locals(shared), workers, evidence)
            if moved is not None and place.misfit - moved.misfit < settings.kept * promised:
                # Where the step has left a curved valley, its tangents still lead back to the ground.
                back = self._chord(layout, moved, evidence, damping, workers)
                moved = back if back is not None and back.misfit < moved.misfit else moved
            if moved is not None and moved.misfit < (place if best is None else best).misfit:
                best, taken = moved, damping
                kept = place.misfit - moved.misfit
                if kept >= settings.kept * promised:
                    return moved, damping, kept >= _TRUSTED * promised
            elif best is not None:
                # Shorter steps gain less again.
                break
            damping = damped.more(damping)
        return best, taken, False

    def _further(
        self,
        layout: SharedLayout,
        moved: JointFit,
        first: float,
        evidence: Evidence,
        damping: float,
        workers: Workers,
    ) -> JointFit:
        """Where more steps with the same tangents lead, as long as they gain enough beside ``first``.

        A simulation costs a fraction of what new tangents do (Shamanskii 1967, A modification of Newton's
        method).
        """
        for _ in range(self.settings.chords):
            again = self._chord(layout, moved, evidence, damping, workers)
            if again is None:
                break
            gained = moved.misfit - again.misfit
            if gained > 0:
                moved = again
            if gained < max(self.settings.worth * first, self.settings.nothing):
                break
        return moved

    def _chord(
        self, layout: SharedLayout, moved: JointFit, evidence: Evidence, damping: float, workers: Workers
    ) -> JointFit | None:
        """One more step, from where one has led, with the tangents of where that began."""
        carried = self._carried(layout, moved, evidence)
        joined = Joined(carried.systems, self.size, damping)
        shared = self._shared_step(layout, moved, joined, damping)
        return self._moved(layout, moved, shared, joined.locals(shared), workers, carried)

    def _carried(self, layout: SharedLayout, moved: JointFit, evidence: Evidence) -> Evidence:
        """Evidence around another place, with residuals of there and tangents of where it was made."""
        systems: list[WindowSystem] = []
        made = iter(evidence.systems)
        for c, clip in enumerate(self.clips):
            columns = layout.columns(c)
            for k, window in enumerate(moved.windows[c]):
                system = next(made)
                assert system.motion is not None
                own = clip.shooting.image_gradient(window, system.motion)
                gradient = np.zeros_like(system.gradient)
                gradient[columns], gradient[evidence.n_shared :] = own[: len(columns)], own[len(columns) :]
                link = system.link
                if link is not None:
                    link = replace(link, jump=clip.shooting.jump(moved.windows[c][k - 1], window))
                systems.append(
                    replace(system, gradient=gradient, standardised=window.standardised, link=link)
                )
        return Evidence(systems, moved.values, self._deviations(layout), coefficients=moved.coefficients)

    def _shared_step(self, layout: SharedLayout, place: JointFit, joined: Joined, damping: float) -> Array:
        """Change of the shared unknowns to the minimum of the quadratic within their bounds."""
        scale, now = self._scale(layout), np.concatenate((place.values, place.coefficients))
        H = joined.reduced.matrix + np.diag((1 + damping) / scale**2)
        right = joined.reduced.right - now / scale**2
        lower = positive_lower(scale[:, None] * H * scale)
        low, high = self._reach(layout, place)
        found = lsq_linear(
            lower.T,
            solve_triangular(lower, scale * right, lower=True),
            (low / scale, high / scale),
            method="bvls",
        )
        # What rounding puts beyond a bound would be refused by the effect.
        return np.clip(scale * found.x, low, high)

    def _reach(self, layout: SharedLayout, place: JointFit) -> tuple[Array, Array]:
        """By how much every shared unknown may change at least and at most."""
        longest = self._longest(layout)
        farthest = longest.copy()
        # Beyond its bound a ratio counts as that: no derivative, nothing to hold it there, and a cliff where
        # the prior pulls it back.
        n = layout.n_material
        farthest[:n] = np.clip(self._highest - place.values[:n], 0.0, longest[:n])
        low, high = np.full(layout.n_coefficients, -np.inf), np.full(layout.n_coefficients, np.inf)
        for clip in range(len(self.clips)):
            for effect, places in zip(layout.effects, layout.coefficients(clip), strict=True):
                low[places] = [p.low / p.scale for p in effect.parameters]
                high[places] = [p.high / p.scale for p in effect.parameters]
        own = place.coefficients
        # At its bound a coefficient still needs some room, however little.
        return (
            np.concatenate((-longest, np.minimum(low - own, -_ROOM))),
            np.concatenate((farthest, np.maximum(high - own, _ROOM))),
        )

    def _scale(self, layout: SharedLayout) -> Array:
        """Prior deviations of all shared unknowns."""
        return np.concatenate((self._deviations(layout), self._inflations(layout)))

    def _inflations(self, layout: SharedLayout) -> Array:
        """Prior deviations of all coefficients in their own units."""
        wide = np.empty(layout.n_coefficients)
        for effect, places in zip(layout.effects, layout.places, strict=True):
            wide[places] = self.settings.inflation(effect)
        return wide

    def _moved(
        self,
        layout: SharedLayout,
        place: JointFit,
        shared: Array,
        changes: list[Array],
        workers: Workers,
        evidence: Evidence,
    ) -> JointFit | None:
        """The hypothesis with changed unknowns, shared and local, simulated; None where a step blows up."""
        values = place.values + shared[: layout.n_base]
        coefficients = self._bounded(layout, place.coefficients + shared[layout.n_base :])
        acting = self._acting(layout, coefficients)
        windows: list[list[WindowMotion]] = []
        at = 0
        for c, clip in enumerate(self.clips):
            step = np.concatenate((values - place.values, coefficients - place.coefficients))[
                layout.columns(c)
            ]
            ahead = zip(
                place.windows[c],
                evidence.systems[at : at + len(place.windows[c])],
                changes[at:],
                strict=False,
            )
            own = [_predicted(w, system, np.concatenate((step, change))) for w, system, change in ahead]
            base = base_of(self.start, values[layout.base(c)])
            of_clip = changes[at : at + len(own)]
            at += len(own)
            try:
                windows.append(
                    changed_windows(clip.shooting, own, of_clip, base, acting[c], clip.around, workers)
                )
            except FloatingPointError:
                return None
        pairs = zip(chain.from_iterable(place.windows), chain.from_iterable(windows), strict=True)
        if any(before.converged and not now.converged for before, now in pairs):
            # One that is not at rest in its potential where a fit begins must not hold up all others.
            return None
        cost = self._cost(layout, windows, values, coefficients)
        return replace(
            place, values=values, coefficients=coefficients, windows=windows, effects=acting, misfit=cost
        )

    def _learnt(self, layout: SharedLayout, evidence: Evidence) -> tuple[Array, float]:
        """Covariance of the coefficients, and half the log determinant of what has been learnt of them."""
        n, b = layout.n_coefficients, layout.n_base
        if not n:
            return np.zeros((0, 0)), 0.0
        reduced = evidence.reduced(self.size).matrix
        scale = self._scale(layout)
        H = np.eye(b + n) + scale[:, None] * reduced * scale
        covariance = scale[:, None] * np.linalg.inv(H) * scale
        inside = covariance[b:, b:]
        wide = self._inflations(layout)
        _, whole = np.linalg.slogdet(inside / np.outer(wide, wide))
        return inside, float(-0.5 * whole)


def _pushed(shooting: Shooting, window: WindowMotion, like: WindowMotion) -> WindowMotion:
    """A window with the forces of another one."""
    first = shooting.layout(window.last - window.first)[1]
    unknowns = np.concatenate((window.standardised[:first], like.standardised[first:]))
    return replace(window, standardised=unknowns)


def _predicted(window: WindowMotion, system: WindowSystem, step: Array) -> WindowMotion:
    """The window where its tangents say it will go: where its simulation begins to look."""
    assert system.motion is not None
    moved = (system.motion @ step.astype(np.float32)).reshape(window.positions.shape)
    return replace(window, positions=window.positions + moved)
