"""Every candidate at its own best fit: with the effect in the simulator, and judged around there.

Around the base fit an effect is judged as if all it did were proportional to its strength, and stiffness,
wind, starts and forces answered it in proportion. A frame rate or a stiffness that varies then takes up what
the base model cannot do otherwise, and an anisotropy of a factor of five looks worse than it is. Here the
clip is simulated with each candidate, its coefficients and all else are moved to where they suit one another,
and the evidence is that of a Gaussian around that place (Laplace's approximation at the hypothesis' own mode,
MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.base_fit import base_of, changed_windows, longest_step
from toile.diagnosis.continuity import Discrepancy, WindowSystem
from toile.diagnosis.evidence import Evidence, Posterior
from toile.diagnosis.mechanics import Mechanics, effect_systems
from toile.diagnosis.shooting import Base, WindowMotion
from toile.effects.base import Effect
from toile.geometry.camera import Camera
from toile.limits import Finite, Fraction, NonNegative, Positive, Unit
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RefitSettings:
    """When passes that bring to convergence the base model and fit effects end, and how far one goes.

    Attributes:
        least_score: linearised screening score (log evidence to first order) from which on an effect is
            tried. Below zero, as what is weak to first order may be strong.
        little: a pass of the base refit that lowers the cost by less than this is the last one.
        converged: log evidence by which a pass of a refit may change it and be the last one.
        longest_wind: change of the wind in one pass at most [m/s²]; of stiffness see ShootingSettings.
        worst: share of the largest rise of a window's cost. Windows whose cost rises by more are held back
            where no step of all helps.
    """

    least_score: Finite = -4.0
    little: NonNegative = 2.0
    converged: NonNegative = 1.0
    longest_wind: Annotated[Positive, Unit("m/s²")] = 2.0
    worst: Fraction = 0.1


DEFAULT = RefitSettings()


@dataclass(frozen=True)
class Refit:
    """A hypothesis at its best fit.

    Attributes:
        effects: in the model with their coefficients, one or none. None as well where no step with the effect
            lowered the cost: its linearised score is not there.
        base: stiffness and wind.
        windows: simulated.
        gained: log evidence beyond that of the base model after as many passes.
        image_cost: negative log-likelihood of the fitted frames, up to a constant.
        mean, covariance: of the effect's coefficients in prior deviations (n,), (n, n).
    """

    effects: tuple[Effect, ...]
    base: Base
    windows: list[WindowMotion]
    gained: float
    image_cost: float
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class Race:
    """The base model and the well-scoring effects at their best fits.

    Attributes:
        base: the base model, which has had as many passes as any effect.
        effects: those that act where they have ended, by name.
        beyond: log evidence that the base model gains by forces larger than usual.
        discrepancy: of the base model then.
    """

    base: Refit
    effects: dict[str, Refit]
    beyond: float
    discrepancy: Discrepancy


@dataclass(frozen=True)
class _Moved:
    """Windows, base values and the effect's coefficients after a pass, what was gained, the damping."""

    windows: list[WindowMotion]
    values: Array
    coefficients: Array
    effects: tuple[Effect, ...]
    gained: float
    damping: float


def converged(
    mechanics: Mechanics,
    camera: Camera,
    usual: Discrepancy,
    passes: int,
    workers: Workers = ALONE,
    settings: RefitSettings = DEFAULT,
) -> Mechanics:
    """The base model fitted with forces of the size that it needs, and effects to first order around there.

    The base fit leaves much to its forces so as to find the motion from afar. Where far smaller ones do, all
    else has to move a good way, and what effects seem to gain on that way is not theirs.

    Args:
        mechanics: base fit and linear systems around it, without effects.
        camera: nominal.
        usual: discrepancy of a right model.
        passes: at most.
        workers: share the windows.
        settings: see RefitSettings.
    """
    shooting, fit, evidence = mechanics.shooting, mechanics.fit, mechanics.evidence
    effects = list(mechanics.effects.values())
    n = sum(len(effect.scales) for effect in effects)
    damping = 0.0
    for index in range(passes):
        best = evidence.posterior((), usual)
        moved = _step(mechanics, evidence, best, None, fit.windows, np.zeros(0), damping, settings, workers)
        if moved is None:
            break
        fit = replace(fit, windows=moved.windows, values=moved.values)
        # A short step is no sign of having arrived.
        if (moved.damping == 0 and moved.gained < settings.little) or index + 1 == passes:
            break
        damping = shooting.settings.damping.less(moved.damping)
        systems = effect_systems(shooting, fit, (), mechanics.around, None, 0, workers)
        evidence = Evidence(systems, fit.values, evidence.deviations, evidence.settings)
    systems = effect_systems(shooting, fit, effects, mechanics.around, camera, n, workers)
    evidence = Evidence(systems, fit.values, evidence.deviations, evidence.settings)
    return replace(mechanics, fit=fit, evidence=evidence)


@dataclass(frozen=True)
class _Place:
    """Where a hypothesis is on the way to its best fit.

    Attributes:
        windows: simulated.
        values: of the base (P + 2,).
        coefficients: of the effect in prior deviations (n,).
        effects: in the simulator.
        systems: around there.
        best: posterior around there.
        image_cost: of the fitted frames.
        log_evidences: after every pass, the first one from before any; one means something beside that of
            another hypothesis on the same clip.
        damping: of the next step.
        is_done: whether the last pass has changed little.
    """

    windows: list[WindowMotion]
    values: Array
    coefficients: Array
    effects: tuple[Effect, ...]
    systems: list[WindowSystem]
    best: Posterior
    image_cost: float
    log_evidences: tuple[float, ...]
    damping: float = 0.0
    is_done: bool = False


class Refitting:
    """A hypothesis on its way to its best fit, pass by pass from the base fit on.

    Args:
        mechanics: converged, see there.
        effect: of the catalogue; None for the base model itself.
        free: coefficients of the effect that are; the others stay zero.
        usual: discrepancy of a right model; the hypothesis has to do with it.
        settings: see RefitSettings.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        effect: Effect | None,
        free: Sequence[int],
        usual: Discrepancy,
        settings: RefitSettings = DEFAULT,
    ) -> None:
        first = mechanics.evidence
        n_base = first.n_base
        n = 0 if effect is None else len(effect.scales)
        a = 0 if effect is None else n_base + mechanics.coefficients[effect.NAME][0]
        systems = [s.with_shared([*range(n_base), *range(a, a + n)]) for s in first.systems]
        self._mechanics, self._effect, self._usual = mechanics, effect, usual
        self._settings = settings
        self._free = [n_base + c for c in free]
        self._place = self._judged(mechanics.fit.windows, mechanics.fit.values, np.zeros(n), (), systems, ())

    @property
    def log_evidences(self) -> tuple[float, ...]:
        """See _Place."""
        return self._place.log_evidences

    def advanced(self) -> _Place:
        """Where it is after one more pass; where it was if the one before has changed little."""
        place, mechanics, fit = self._place, self._mechanics, self._mechanics.fit
        if place.is_done:
            return place
        moved = _step(
            mechanics,
            self._evidence(place.systems, place.values, place.coefficients),
            place.best,
            self._effect,
            place.windows,
            place.coefficients,
            place.damping,
            self._settings,
        )
        if moved is None:
            return replace(place, is_done=True)
        around = replace(fit, windows=moved.windows, values=moved.values)
        n = len(moved.coefficients)
        systems = effect_systems(mechanics.shooting, around, moved.effects, mechanics.around, None, n)
        found = self._judged(
            moved.windows, moved.values, moved.coefficients, moved.effects, systems, place.log_evidences
        )
        # The first pass may lead through places that are worse.
        little = abs(found.log_evidences[-1] - found.log_evidences[-2]) < self._settings.converged
        done = len(found.log_evidences) > 2 and moved.damping == 0 and little
        damping = mechanics.shooting.settings.damping.less(moved.damping)
        return replace(found, damping=damping, is_done=done)

    def move(self, place: _Place) -> None:
        """Go to where ``advanced`` leads."""
        self._place = place

    def result(self, base_model: Refitting) -> Refit:
        """Where it is, beside the base model."""
        place = self._place
        n, n_base = len(place.coefficients), self._mechanics.evidence.n_base
        mean, covariance = np.zeros(n), np.zeros((n, n))
        at = [c - n_base for c in place.best.free]
        mean[at] = place.best.mean
        covariance[np.ix_(at, at)] = place.best.covariance
        base = base_of(self._mechanics.fit.start_material, place.values)
        return Refit(
            place.effects,
            base,
            place.windows,
            # What more passes bring any model is no merit of the one that has had them.
            place.log_evidences[-1] - base_model.log_evidences[: len(place.log_evidences)][-1],
            place.image_cost,
            mean,
            covariance,
        )

    def evidence(self) -> Evidence:
        """Of hypotheses around where it is."""
        place = self._place
        return self._evidence(place.systems, place.values, place.coefficients)

    def _evidence(self, systems: list[WindowSystem], values: Array, coefficients: Array) -> Evidence:
        first = self._mechanics.evidence
        return Evidence(systems, values, first.deviations, first.settings, coefficients, like=first)

    def _judged(
        self,
        windows: list[WindowMotion],
        values: Array,
        coefficients: Array,
        effects: tuple[Effect, ...],
        systems: list[WindowSystem],
        before: tuple[float, ...],
    ) -> _Place:
        best = self._evidence(systems, values, coefficients).scaled(self._free, self._usual)
        image_cost = sum(map(self._mechanics.shooting.image_cost, windows))
        after = (*before, best.log_evidence - image_cost)
        return _Place(windows, values, coefficients, effects, systems, best, image_cost, after)


def within_bounds(effect: Effect, coefficients: Array) -> Array:
    """An effect's coefficients (n,) in prior deviations, none beyond its bounds."""
    low = np.array([p.low / p.scale for p in effect.parameters])
    high = np.array([p.high / p.scale for p in effect.parameters])
    return coefficients.clip(low, high)


def acting_with(effect: Effect, coefficients: Array) -> Effect:
    """The effect with coefficients (n,) in prior deviations."""
    return effect.with_values(torch.from_numpy(coefficients) * effect.scales)


def refits(
    mechanics: Mechanics,
    best_scoring: Mapping[str, Sequence[int]],
    penalties: Mapping[str, float],
    usual: Discrepancy,
    tried: Sequence[int],
    report: Callable[[str, float], None],
    workers: Workers = ALONE,
    settings: RefitSettings = DEFAULT,
) -> Race:
    """The base model and the well-scoring effects at their best fits, as a race: the last drop out early.

    Args:
        mechanics: converged, see there.
        best_scoring: coefficients of each effect that are free, the best-scoring effect first.
        penalties: taken from the log evidence of each.
        usual: discrepancy of a right model.
        tried: effects that have a first pass, a second one, and so on.
        report: called with what has been done and the share that is done.
        workers: share the hypotheses.
        settings: see RefitSettings.
    """
    total, done = sum(tried) + len(tried), 0
    base = Refitting(mechanics, None, (), usual, settings)
    models = {
        name: Refitting(mechanics, mechanics.effects[name], free, usual, settings)
        for name, free in list(best_scoring.items())[: max(tried, default=0)]
    }
    running = list(models)
    for count in tried:
        running = sorted(running, key=lambda name: penalties[name] - models[name].log_evidences[-1])[:count]
        going = {"the base model": base, **{name: models[name] for name in running}}
        places = workers.map(Refitting.advanced, list(going.values()))
        for (name, model), place in zip(going.items(), places, strict=True):
            model.move(place)
            done += 1
            report(f"refit of {name}", done / total)
    found = {name: model.result(base) for name, model in models.items()}
    acting = {name: model for name, model in found.items() if model.effects}
    evidence = base.evidence()
    missing = evidence.posterior(())
    beyond = missing.log_evidence - evidence.posterior((), usual).log_evidence
    return Race(base.result(base), acting, beyond, missing.discrepancy)


def _step(
    mechanics: Mechanics,
    evidence: Evidence,
    best: Posterior,
    effect: Effect | None,
    windows: list[WindowMotion],
    coefficients: Array,
    damping: float,
    settings: RefitSettings,
    workers: Workers = ALONE,
) -> _Moved | None:
    """One pass; None where no step lowers the cost."""
    shooting, start = mechanics.shooting, mechanics.fit.start_material
    damped = shooting.settings.damping
    longest = longest_step(shooting, settings.longest_wind)
    at = [c - evidence.n_base for c in best.free]

    def cost(moved: list[WindowMotion], base: Array, own: Array) -> float:
        prior = (base / evidence.deviations) ** 2
        images = shooting.clip_cost(moved, best.discrepancy)
        return images + 0.5 * float(prior.sum() + ((own[at] / best.prior_inflation) ** 2).sum())

    before = cost(windows, evidence.values, coefficients)
    seen = np.array([shooting.image_cost(window) for window in windows])
    frozen: NDArray[np.bool_] | None = None
    for _ in range(2):
        risen: Array | None = None
        tried = damping
        for _ in range(damped.tried):
            values, own, changes = evidence.towards(
                best.free, best.discrepancy, tried, longest, frozen, best.prior_inflation
            )
            trial = coefficients.copy()
            trial[at] = own
            acting: tuple[Effect, ...] = ()
            if effect is not None:
                trial = within_bounds(effect, trial)
                acting = (acting_with(effect, trial),)
            try:
                moved = changed_windows(
                    shooting, windows, changes, base_of(start, values), acting, mechanics.around, workers
                )
            except FloatingPointError:
                # Effects can be strong enough to blow up a step.
                tried = damped.more(tried)
                continue
            gained = before - cost(moved, values, trial)
            if gained > 0 and all(window.converged for window in moved):
                return _Moved(moved, values, trial, acting, gained, tried)
            if risen is None:
                risen = np.array([shooting.image_cost(window) for window in moved]) - seen
            tried = damped.more(tried)
        # Snap-through buckling at the slightest change makes its window worse whatever the others gain.
        frozen = None if risen is None else risen > settings.worst * risen.max()
        if frozen is None or frozen.all():
            return None
        damping = 0.0
    return None
