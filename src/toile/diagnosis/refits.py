"""Every candidate at its own best fit: with the effect in the simulator, and judged around there.

Around the base fit an effect is judged as if all it did were proportional to its strength, and stiffness,
wind, starts and forces answered it in proportion. A frame rate or a stiffness that varies then takes up what
the base model cannot do otherwise, and an anisotropy of a factor of five looks worse than it is. Here the
clip is simulated with each candidate, its numbers and all else are moved to where they suit one another, and
the evidence is that of a Gaussian around that place (Laplace's approximation at the hypothesis' own mode,
MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.base_fit import base_of, local_scales
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.damping import TRIED, less, more
from toile.diagnosis.evidence import Evidence, Posterior
from toile.diagnosis.mechanics import Mechanics, effect_systems
from toile.diagnosis.shooting import Base, WindowMotion
from toile.effects.base import Effect
from toile.geometry.camera import Camera

Array = NDArray[np.float64]

# Change of a logarithm of stiffness [1] or of the wind [m/s²] in one pass at most.
_LONGEST = np.array([0.7, 0.7, 0.7, 2.0, 2.0])
# A pass that lowers the cost by less than this is the last one.
_LITTLE = 2.0
# Log evidence by which a pass may change it and be the last one.
_SETTLED = 1.0
# Windows whose cost rises by this share of the largest rise are held back where no step of all helps.
_WORST = 0.1


@dataclass(frozen=True)
class Refit:
    """A hypothesis at its best fit.

    Attributes:
        effects: in the model with their numbers, one or none. None as well where no step with the effect
            lowered the cost: what it promised to first order is not there.
        base: stiffness and wind.
        windows: simulated.
        evidence: of hypotheses around there.
        gained: log evidence beyond that of the base model after as many passes.
        image_cost: negative log-likelihood of the fitted frames, up to a constant.
        mean, covariance: of the effect's numbers in prior deviations (n,), (n, n).
    """

    effects: tuple[Effect, ...]
    base: Base
    windows: list[WindowMotion]
    evidence: Evidence
    gained: float
    image_cost: float
    mean: Array
    covariance: Array


@dataclass(frozen=True)
class _Moved:
    """Windows, base values and numbers of the effect after a pass, what was gained, with which damping."""

    windows: list[WindowMotion]
    values: Array
    numbers: Array
    effects: tuple[Effect, ...]
    gained: float
    damping: float


def settled(mechanics: Mechanics, camera: Camera, usual: Discrepancy, passes: int) -> Mechanics:
    """The base model fitted with forces of the size that it needs, and effects to first order around there.

    The base fit leaves much to its forces so as to find the motion from afar. Where far smaller ones do, all
    else has to move a good way, and what effects seem to gain on that way is not theirs.

    Args:
        mechanics: base fit and linear systems around it, without effects.
        camera: nominal.
        usual: discrepancy of a right model.
        passes: at most.
    """
    shooting, fit, evidence = mechanics.shooting, mechanics.fit, mechanics.evidence
    effects = list(mechanics.effects.values())
    n = sum(len(effect.scales) for effect in effects)
    damping = 0.0
    for index in range(passes):
        best = evidence.posterior((), usual)
        moved = _step(mechanics, evidence, best, None, fit.windows, np.zeros(0), damping)
        if moved is None:
            break
        fit = replace(fit, windows=moved.windows, values=moved.values)
        # A short step is no sign of having arrived.
        if (moved.damping == 0 and moved.gained < _LITTLE) or index + 1 == passes:
            break
        damping = less(moved.damping)
        systems = effect_systems(shooting, fit, (), mechanics.around, None, 0)
        evidence = Evidence(systems, fit.values, evidence.deviations, evidence.slack)
    systems = effect_systems(shooting, fit, effects, mechanics.around, camera, n)
    evidence = Evidence(systems, fit.values, evidence.deviations, evidence.slack)
    return replace(mechanics, fit=fit, evidence=evidence)


class Refitting:
    """A hypothesis on its way to its best fit, pass by pass from the base fit on.

    Args:
        mechanics: settled, see there.
        effect: of the catalogue; None for the base model itself.
        columns: numbers of the effect that are free, the others stay zero.
        usual: discrepancy of a right model; the hypothesis has to do with it.

    Attributes:
        log_evidences: after every pass, the first one from before any; one means something beside that of
            another hypothesis on the same clip.
        is_done: whether the last pass has changed little.
    """

    def __init__(
        self, mechanics: Mechanics, effect: Effect | None, columns: Sequence[int], usual: Discrepancy
    ) -> None:
        first = mechanics.evidence
        n_base = first.n_base
        n = 0 if effect is None else len(effect.scales)
        a = 0 if effect is None else n_base + mechanics.columns[effect.NAME][0]
        systems = [s.with_shared([*range(n_base), *range(a, a + n)]) for s in first.systems]
        self._mechanics, self._effect, self._usual = mechanics, effect, usual
        self._free = [n_base + c for c in columns]
        self._windows, self._values, self._numbers = mechanics.fit.windows, mechanics.fit.values, np.zeros(n)
        self._acting: tuple[Effect, ...] = ()
        self._evidence = Evidence(systems, self._values, first.deviations, first.slack, like=first)
        self.log_evidences: list[float] = []
        self._judge()
        self._damping = 0.0
        self.is_done = False

    def advance(self) -> None:
        """One pass; none where the one before has changed little."""
        if self.is_done:
            return
        mechanics, fit = self._mechanics, self._mechanics.fit
        moved = _step(
            mechanics,
            self._evidence,
            self._best,
            self._effect,
            self._windows,
            self._numbers,
            self._damping,
        )
        if moved is None:
            self.is_done = True
            return
        self._windows, self._values = moved.windows, moved.values
        self._numbers, self._acting = moved.numbers, moved.effects
        around = replace(fit, windows=moved.windows, values=moved.values)
        n = len(self._numbers)
        systems = effect_systems(mechanics.shooting, around, self._acting, mechanics.around, None, n)
        first = mechanics.evidence
        self._evidence = Evidence(
            systems, self._values, first.deviations, first.slack, self._numbers, like=first
        )
        self._judge()
        # The first pass may lead through places that are worse.
        little = abs(self.log_evidences[-1] - self.log_evidences[-2]) < _SETTLED
        self.is_done = len(self.log_evidences) > 2 and moved.damping == 0 and little
        self._damping = less(moved.damping)

    def result(self, base_model: Refitting) -> Refit:
        """Where it is, beside the base model."""
        n, n_base = len(self._numbers), self._evidence.n_base
        mean, covariance = np.zeros(n), np.zeros((n, n))
        at = [c - n_base for c in self._best.columns]
        mean[at] = self._best.mean
        covariance[np.ix_(at, at)] = self._best.covariance
        base = base_of(self._mechanics.fit.start_stiffness, self._values)
        return Refit(
            self._acting,
            base,
            self._windows,
            self._evidence,
            # What more passes bring any model is no merit of the one that has had them.
            self.log_evidences[-1] - base_model.log_evidences[: len(self.log_evidences)][-1],
            self._image_cost,
            mean,
            covariance,
        )

    def _judge(self) -> None:
        self._best = self._evidence.scaled(self._free, self._usual)
        self._image_cost = sum(map(self._mechanics.shooting.image_cost, self._windows))
        self.log_evidences.append(self._best.log_evidence - self._image_cost)


def within_bounds(effect: Effect, numbers: Array) -> Array:
    """An effect's numbers (n,) in prior deviations, none beyond its bounds."""
    low = np.array([p.low / p.scale for p in effect.parameters])
    high = np.array([p.high / p.scale for p in effect.parameters])
    return numbers.clip(low, high)


def acting_with(effect: Effect, numbers: Array) -> Effect:
    """The effect with numbers (n,) in prior deviations."""
    return effect.with_values(torch.from_numpy(numbers) * effect.scales)


def refits(
    mechanics: Mechanics,
    promising: Mapping[str, Sequence[int]],
    charges: Mapping[str, float],
    usual: Discrepancy,
    tried: Sequence[int],
    report: Callable[[str, float], None],
) -> tuple[Refit, dict[str, Refit]]:
    """The base model and the promising effects at their best fits, as a race: the last drop out early.

    Args:
        mechanics: settled, see there.
        promising: numbers of each effect that are free, the most promising effect first.
        charges: taken from the log evidence of each.
        usual: discrepancy of a right model.
        tried: effects that have a first pass, a second one, and so on.
        report: called with what is being done and the share that is done.

    Returns:
        The base model, which has had as many passes, and the effects that act where they have ended.
    """
    total, done = sum(tried) + len(tried), 0
    base = Refitting(mechanics, None, (), usual)
    models = {
        name: Refitting(mechanics, mechanics.effects[name], columns, usual)
        for name, columns in list(promising.items())[: max(tried, default=0)]
    }
    running = list(models)
    for count in tried:
        report("refit of the base model", done / total)
        base.advance()
        done += 1
        running = sorted(running, key=lambda name: charges[name] - models[name].log_evidences[-1])[:count]
        for name in running:
            report(f"refit with {name}", done / total)
            models[name].advance()
            done += 1
    found = {name: model.result(base) for name, model in models.items()}
    return base.result(base), {name: model for name, model in found.items() if model.effects}


def _step(
    mechanics: Mechanics,
    evidence: Evidence,
    best: Posterior,
    effect: Effect | None,
    windows: list[WindowMotion],
    numbers: Array,
    damping: float,
) -> _Moved | None:
    """One pass; None where no step lowers the cost."""
    shooting, start = mechanics.shooting, mechanics.fit.start_stiffness
    at = [c - evidence.n_base for c in best.columns]

    def cost(moved: list[WindowMotion], base: Array, own: Array) -> float:
        prior = (base / evidence.deviations) ** 2
        images = shooting.clip_cost(moved, best.discrepancy)
        return images + 0.5 * float(prior.sum() + ((own[at] / best.slack) ** 2).sum())

    def simulated(changes: list[Array], base: Array, acting: tuple[Effect, ...]) -> list[WindowMotion]:
        return [
            shooting.simulate(
                window,
                window.white + change / local_scales(shooting, window.last - window.first),
                base_of(start, base),
                acting,
                mechanics.around,
            )
            for window, change in zip(windows, changes, strict=True)
        ]

    before = cost(windows, evidence.values, numbers)
    seen = np.array([shooting.image_cost(window) for window in windows])
    held: NDArray[np.bool_] | None = None
    for _ in range(2):
        risen: Array | None = None
        tried = damping
        for _ in range(TRIED):
            values, own, changes = evidence.towards(
                best.columns, best.discrepancy, tried, _LONGEST, held, best.slack
            )
            trial = numbers.copy()
            trial[at] = own
            acting: tuple[Effect, ...] = ()
            if effect is not None:
                trial = within_bounds(effect, trial)
                acting = (acting_with(effect, trial),)
            try:
                moved = simulated(changes, values, acting)
            except FloatingPointError:
                # Effects can be strong enough to blow up a step.
                tried = more(tried)
                continue
            gained = before - cost(moved, values, trial)
            if gained > 0 and all(window.converged for window in moved):
                return _Moved(moved, values, trial, acting, gained, tried)
            if risen is None:
                risen = np.array([shooting.image_cost(window) for window in moved]) - seen
            tried = more(tried)
        # A fold that snaps at the slightest change makes its window worse whatever the others gain.
        held = None if risen is None else risen > _WORST * risen.max()
        if held is None or held.all():
            return None
        damping = 0.0
    return None
