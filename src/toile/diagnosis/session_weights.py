"""How the evidence of a session's motion becomes probabilities, and how the numbers in it are learnt.

A drop of the misfit is no probability: models are wrong in ways that other effects can mend a little, and
errors of neighbouring frames are alike. What a drop is worth is learnt on generated sessions whose cause is
known, by the likelihood of their causes (a multinomial logistic regression with the misfit's scale inside).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit, log_ndtr, softmax

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.effects.catalogue import PUSHING, STAND_INS, UNCHANGING, WEIGHING
from toile.effects.gusts import Gusts
from toile.effects.pressure import Pressure
from toile.effects.rest_length_drift import RestLengthDrift
from toile.effects.steady_forces import SteadyForces
from toile.errors import InputError
from toile.json_file import read_json_object

Array = NDArray[np.float64]

EVIDENCE_FILE = "motion_evidence.json"
"""In the folder of a session's diagnosis."""

SHIPPED = Path(__file__).with_name("session_weights.json")

USUAL_SHARE = 0.0025
"""Errors that a base model of an unknown cloth may have [widths]."""

_LARGEST = 0.15
"""Distance by which causes move the cloth at most [widths]."""

_CAUSES = 10.0
"""Effects that move a cloth, as probable as none together: what a single one is up against."""

_SHARING = (SteadyForces.NAME, Pressure.NAME)
"""Stand-ins that, beside free forces, speak for unknown only as rivals of causes that show there."""

_FLEXIBLE = (SteadyForces.NAME, RestLengthDrift.NAME)
"""Stand-ins that take up some of what a law or another cause leaves; a pressure has fewer coefficients than
gusts have."""

_LAPSE = 0.02
"""Share of cases that teach nothing, because what acts is too small to be seen or a fit has failed."""

_AT, _SHARES = hermegauss(7)
"""Places, and shares up to a common factor, at which a normal distribution is averaged over."""

_LEAST = 1e-4
"""Probability of the learned decision that says no more, and share of the usual misfit that does."""


@dataclass(frozen=True)
class SessionWeights:
    """How evidence of the motion becomes a probability.

    Attributes:
        usual_size: distance by which an effect that every cloth has moves it, in the last third of the first
            clip [widths], the median over cloths and solvers.
        usual_spread: deviation of its logarithm over them.
        smallest: distance at which any other effect, as a cause, and none are equally probable, see
            MotionEvidence.logits.
        beyond: e-folds of the odds against none at most for each logarithm beyond that distance.
        surest: e-folds of the odds of an effect that speak for none as well, at most, where it moves the
            cloth by little: what a model is wrong by has not been seen to show more clearly.
        threshold: evidence at which an effect and none are equally probable [nats].
        temperature: evidence by which the odds of an effect grow e-fold [nats].
        law_spread: deviation of the logarithm of both from cloth to cloth: by how much the law is wrong about
            a cloth like none that taught them is not known.
        learned: weight of the learned decision's log odds among effects.
        outside_threshold: evidence, the forces within the cloth free, at which a cause from outside and all
            that is not from there are equally probable [nats].
        outside_temperature: evidence by which its odds grow e-fold [nats].
        outside_unchanging: share of outside_threshold that is asked of a cause of UNCHANGING: it has no
            history with which to take up what a motion is wrong by, as gusts have.
        rivals: evidence under the law by which the odds of one cause from outside against another grow e-fold
            [nats].
        farthest: e-folds by which the law tells them apart at most: a fit may have failed.
        stand_in: evidence that a flexible stand-in needs beyond what an effect does, for it takes up some of
            what a law or another cause leaves [nats].
        searched: evidence that contact needs beyond, where its obstacle is the best of many that were tried:
            it takes up some of what the law is wrong by [nats].
        outside_stand_in: that of a steady field where the forces within the cloth are free [nats].
        outside_spread: deviation of the strength of a cause from outside, as a share of it, beside what its
            fit says and before intervals are widened (DiagnosisSettings.widened).
        strange: squared errors that the best hypothesis leaves, over those of USUAL_SHARE, where something
            unknown and none are equally probable.
        strangeness: e-folds of the odds of something unknown for each logarithm beyond that.
        resized: share by which the sides of a cloth seem to change (apparent_size) where something unknown
            and all else are equally probable.
        resizing: e-folds of the odds of something unknown for each logarithm beyond that.
        covered: share of the cloth's print that is hidden (occlusion) where something unknown and all else
            are equally probable.
        covering: e-folds of the odds of something unknown for each logarithm beyond that.
        slip_threshold: evidence at which a slip and none are equally probable, by the refined paths of what
            holds the cloth (holder_slips) [nats].
        slip_temperature: evidence by which its odds grow e-fold [nats].
    """

    usual_size: float = 0.019
    usual_spread: float = 0.4
    smallest: float = 0.008
    beyond: float = 12.0
    surest: float = 20.0
    threshold: float = 17.0
    temperature: float = 4.0
    law_spread: float = 0.0
    learned: float = 0.5
    outside_threshold: float = 15.0
    outside_temperature: float = 4.0
    outside_unchanging: float = 1.0
    rivals: float = 16.0
    farthest: float = 5.0
    stand_in: float = 30.0
    searched: float = 0.0
    outside_stand_in: float = 10.0
    outside_spread: float = 0.14
    strange: float = 4.0
    strangeness: float = 4.0
    resized: float = 0.025
    resizing: float = 4.0
    covered: float = 0.01
    covering: float = 4.0
    slip_threshold: float = 10.0
    slip_temperature: float = 2.0

    @staticmethod
    def load(path: Path = SHIPPED) -> SessionWeights:
        """The weights in a file, by default those that come with the package.

        Raises:
            InputError: there is no such file, or it holds no weights.
        """
        try:
            values = read_json_object(path)["weights"]
            names = {one.name for one in fields(SessionWeights)}
            if set(values) != names or not all(np.isfinite(float(v)) for v in values.values()):
                raise ValueError(f"weights are not {', '.join(sorted(names))}")
            return SessionWeights(**{name: float(value) for name, value in values.items()})
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                "No weights of sessions can be read",
                where=str(path),
                expected="what benchmarks/session_weights.py writes",
                got=f"{type(error).__name__}: {error}",
            ) from error

    def of_clips(self, n: int) -> SessionWeights:
        """The weights for several clips; these are for one.

        By how much evidence is too large, the temperature, is what the model's own errors add to the noise.
        The noise of n clips is averaged; what a law on a grid is wrong by is alike in all of them and is not
        (a bias that clips share, as between the studies of a meta-analysis): of n clips 1 + n (T - 1) instead
        of T. Thresholds grow by as much, for they are of the same errors.

        Args:
            n: clips, one or more.
        """
        if n < 1:
            raise ValueError(f"of_clips: expected one clip or more, got {n}")

        def factor(temperature: float) -> float:
            return (1.0 + n * max(temperature - 1.0, 0.0)) / max(temperature, 1.0)

        of_law, freed = factor(self.temperature), factor(self.outside_temperature)
        return replace(
            self,
            threshold=of_law * self.threshold,
            temperature=of_law * self.temperature,
            rivals=of_law * self.rivals,
            stand_in=of_law * self.stand_in,
            searched=of_law * self.searched,
            outside_threshold=freed * self.outside_threshold,
            outside_stand_in=freed * self.outside_stand_in,
            outside_temperature=freed * self.outside_temperature,
        )

    def asked_of_outside(self, name: str) -> float:
        """Evidence, the forces within the cloth free, that is asked of a cause from outside [nats]."""
        return self.outside_threshold * (self.outside_unchanging if name in UNCHANGING else 1.0)

    def write(self, path: Path, source: str) -> None:
        """Write them with what they were learnt from."""
        write_text(path, json.dumps({"weights": asdict(self), "source": source}, indent=2) + "\n")


@dataclass(frozen=True)
class MotionEvidence:
    """What the clips of a session say about effects that move the cloth.

    Attributes:
        base: smooth errors of the base model.
        effects: what the fit of every effect says, stand-ins among them.
        learned: probabilities of the learned decision by label, None where there is none.
        usual: effects that every cloth has, with the distance by which they move this one, see
            effect_size.moved; what is said of them is against a model without.
        sizes: the same of the other effects; of those that are not here nothing is asked.
        outside: what is said of causes from outside with the forces within the cloth free, see
            outside_causes; of those that are not here nothing is known.
        resized: share by which the sides seem to change, see apparent_size; None where that is not seen.
        covered: share of the cloth's print that is hidden, see occlusion; None where nobody has looked.
    """

    base: ModelErrors
    effects: Mapping[str, EffectEvidence]
    learned: Mapping[str, float] | None = None
    usual: Mapping[str, float] = field(default_factory=dict)
    sizes: Mapping[str, float] = field(default_factory=dict)
    outside: Mapping[str, EffectEvidence] = field(default_factory=dict)
    resized: float | None = None
    covered: float | None = None

    def write(self, path: Path) -> None:
        """Keep it, so that weights can be learnt from it once the cause is known.

        Infinite sizes are left out, which JSON has no number for: of an effect without a size nothing is
        asked, as of one that is larger than any.
        """
        finite = {name: size for name, size in self.sizes.items() if np.isfinite(size)}
        write_text(path, json.dumps(asdict(replace(self, sizes=finite)), indent=1) + "\n")

    @staticmethod
    def load(path: Path) -> MotionEvidence:
        """What ``write`` has kept.

        Raises:
            InputError: there is no such file, or it holds no evidence.
        """
        try:
            values = read_json_object(path)
            effects, outside = (
                {
                    name: EffectEvidence(
                        float(one["drop"]),
                        tuple(map(float, one["information"])),
                        tuple(map(float, one["slopes"])),
                        float(one["fitted_size"]),
                    )
                    for name, one in of.items()
                }
                for of in (values["effects"], values.get("outside", {}))
            )
            base = ModelErrors(**{name: float(value) for name, value in values["base"].items()})
            learned, usual, sizes = values["learned"], values["usual"], values["sizes"]
            resized, covered = values.get("resized"), values.get("covered")
            return MotionEvidence(
                base,
                effects,
                None if learned is None else dict(learned),
                dict(usual),
                dict(sizes),
                outside,
                None if resized is None else float(resized),
                None if covered is None else float(covered),
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(
                "No evidence of a session can be read",
                where=str(path),
                expected="what a diagnosis of a session writes",
                got=f"{type(error).__name__}: {error}",
            ) from error

    def without(self, names: Collection[str]) -> MotionEvidence:
        """The same where some effects have not been asked about."""
        effects = {name: one for name, one in self.effects.items() if name not in names}
        outside = {name: one for name, one in self.outside.items() if name not in names}
        return replace(self, effects=effects, outside=outside)

    @property
    def left(self) -> float:
        """Squared errors of the best hypothesis over those that were expected of it."""
        rivals = (e.drop for name, e in self.effects.items() if name not in (*self.usual, *STAND_INS))
        most = max(rivals, default=0.0)
        # A drop is of ties and priors as well, so it may be more than all errors.
        return max((self.base.cost - most) / self.base.expected, _LEAST)

    @property
    def over_usual(self) -> float:
        """Squared errors of the best hypothesis over those of USUAL_SHARE."""
        return self.left * (self.base.share / USUAL_SHARE) ** 2

    def of_size(self, weights: SessionWeights) -> float:
        """Log odds of something unknown against all else, by what becomes of the cloth's apparent size.

        All else has been judged by a motion in which the cloth has moved away instead, so what is said of it
        says nothing against this.
        """
        if self.resized is None:
            return -np.inf
        return weights.resizing * float(np.log(max(abs(self.resized), _LEAST) / weights.resized))

    def of_cover(self, weights: SessionWeights) -> float:
        """Log odds of something unknown against all else, by how much of the cloth's print is hidden.

        What lies before the cloth moves nothing, so what is said of all else says nothing against it.
        """
        if self.covered is None:
            return -np.inf
        return weights.covering * float(np.log(max(self.covered, _LEAST) / weights.covered))

    def of_looks(self, weights: SessionWeights) -> float:
        """Log odds of something unknown against all else, by the cloth's apparent size and what covers it."""
        return float(np.logaddexp(self.of_size(weights), self.of_cover(weights)))

    def with_looks(self, logits: Mapping[str, float], weights: SessionWeights) -> dict[str, float]:
        """Log odds with what the cloth's apparent size and what covers it say of UNKNOWN.

        Args:
            logits: of all hypotheses, UNKNOWN among them or not.
            weights: see SessionWeights.
        """
        if self.resized is None and self.covered is None:
            return dict(logits)
        every = float(np.logaddexp.reduce(list(logits.values())))
        unknown = np.logaddexp(logits.get(UNKNOWN, -np.inf), every + self.of_looks(weights))
        return {**logits, UNKNOWN: float(unknown)}

    def nats(self, name: str) -> float:
        """Log evidence of an effect against the base model."""
        return _nats(self.effects[name], self.scale)

    def freed_nats(self, name: str) -> float:
        """Log evidence of a cause from outside, the forces within the cloth free.

        They take up what a law is usually wrong by. Where all hypotheses leave more, the motion itself is in
        doubt, and the misfit beside free forces is too large by as much.
        """
        return _nats(self.outside[name], max(1.0, self.over_usual))

    @property
    def scale(self) -> float:
        """By how much all misfits are too large: what even the best hypothesis is wrong by is the noise.

        Never less than 1: images that a hypothesis explains better than expected know no more than they do.
        """
        return max(1.0, self.left)

    def logits(self, weights: SessionWeights) -> dict[str, float]:
        """Log odds of every effect, of none and of UNKNOWN by its stand-ins, up to a common constant."""
        odds = self.odds(weights)
        if not any(name in self.effects for name in STAND_INS):
            return odds
        stand_ins = [odds.pop(name) for name in STAND_INS if name in odds]
        return {**odds, UNKNOWN: float(np.logaddexp.reduce([-np.inf, *stand_ins]))}

    def odds(self, weights: SessionWeights) -> dict[str, float]:
        """Log odds of every effect, every stand-in and of none of them, up to a common constant."""
        found: dict[str, float] = {}
        for (answer, _), value in self.parts(weights).items():
            found[answer] = float(np.logaddexp(found.get(answer, -np.inf), value))
        return found

    def parts(self, weights: SessionWeights) -> dict[tuple[str, str], float]:
        """Log odds of every answer, apart by what acts where it is right, up to a common constant.

        What acts is the answer itself, but for none: there it may be an effect that moves the cloth by
        little, or a density that is an error of the law.

        Evidence within the cloth is as wrong as the law is, and by how much that is differs between cloths
        more than few of them can teach. So threshold and temperature are averaged over (``law_spread``):
        what is a little above a threshold is no certainty, however steep the odds of those that taught.
        """
        if not weights.law_spread:
            return self._parts(weights)
        each = []
        for at, share in zip(_AT, _SHARES, strict=True):
            wrong = float(np.exp(weights.law_spread * at))
            of_law = replace(
                weights,
                threshold=wrong * weights.threshold,
                temperature=wrong * weights.temperature,
                rivals=wrong * weights.rivals,
                stand_in=wrong * weights.stand_in,
                searched=wrong * weights.searched,
            )
            found = self._parts(of_law)
            values = np.array(list(found.values()))
            each.append(np.log(share) + values - np.logaddexp.reduce(values))
        return dict(zip(found, map(float, np.logaddexp.reduce(each)), strict=True))

    def _parts(self, weights: SessionWeights) -> dict[tuple[str, str], float]:
        """The same of a law whose errors are known.

        None is an interval and no point: an effect of the size that a model on a grid is usually wrong by is
        none, however sure the clips are of it (Berger and Delampady 1987). So what speaks for an effect
        speaks for none as well, less with every e-fold of its size; rivals keep their distance.

        Causes from outside are judged first, where that can be done whatever the law is: what fits of a law
        say of causes within the cloth says nothing against them, for there the law's own errors count (a cut
        between modules, Plummer 2015). Which of them it is the law may help to say, for it is as wrong for
        one as for another: a flexible cause takes up nearly what another one does where forces are free.

        A density is both. What is known of it with the forces within the cloth free falls with every force
        that these are given, as that of an uneven stiffness does, so an error of the law may pass for it
        there; and under a law another may. So it has the odds that it has among its rivals under the law, as
        far as the clips show it with the forces within the cloth free; the rest is none. Of a density that
        acts other causes from outside take up a part there, so it stands against all of them, as far as the
        law prefers it to the best of them.

        Contact is either: a push in a place and for a moment may show under a law alone, and where it shows
        in the balance, it is a rival of whatever pushes from outside. So is a steady field of forces, which
        stands in for what the catalogue lacks; a pressure shows in the balance as gusts do. Beside free
        forces a steady field takes up what any cause leaves, and a pressure what gusts do, so there they open
        no case of their own: they may take from the others what the law gives them.

        Rest lengths that drift are judged under the law alone. They are forces within the cloth, as errors of
        a law are, and beside free ones they take up what threads that are too stiff, or damped otherwise,
        leave: by that a damping and two slips were unknown, surely.
        """
        both = {name for name in WEIGHING if name in self.outside and name in self.effects}
        either = {n for n in (*PUSHING, *_FLEXIBLE) if n in self.outside and n in self.effects}
        within = [name for name in self.effects if name not in self.outside or name in both | either]
        odds = {
            name: (self._of_law(name, weights) - weights.threshold) / weights.temperature
            + weights.learned * _log_odds(self.learned, name, self.effects)
            for name in within
        }
        freed = {
            name: (self.freed_nats(name) - weights.asked_of_outside(name)) / weights.outside_temperature
            for name in self.outside
            if name != RestLengthDrift.NAME
        }
        if Pressure.NAME in freed and Gusts.NAME in freed:
            # Both give the balance of torques any history in time: which of them it is the law alone says.
            freed[Pressure.NAME] = min(freed[Pressure.NAME], freed[Gusts.NAME])
        for name in STAND_INS:
            if self.sizes.get(name, np.inf) < weights.smallest:
                # Smaller than what is a cause it speaks neither for unknown nor, against effects, for none.
                odds.pop(name, None)
                freed.pop(name, None)
        if SteadyForces.NAME in freed:
            freed[SteadyForces.NAME] -= weights.outside_stand_in / weights.outside_temperature
        freed |= self._apart({n: v for n, v in freed.items() if n not in both}, weights)
        rivals = [name for name in freed if name not in both and name in self.effects]
        if both and rivals:
            best = max(rivals, key=lambda name: self._of_law(name, weights))
            taken = sum(self._stands_against(best, one, freed[one], weights) for one in both)
            freed |= {name: freed[name] - taken for name in rivals}
        none = {NONE: 0.0} | {n: odds[n] - float(np.logaddexp(0.0, freed[n])) for n in sorted(both)}
        odds |= {name: odds[name] - float(np.logaddexp(0.0, -freed[name])) for name in both}
        for name, value in odds.items():
            if name in self.usual:
                # Rivals are fitted beside it: its evidence, against a model without, is not to be set against
                # theirs. However sure it is that it acts, it is a cause only where it is more than usual.
                odds[name] = min(value, _more_than_usual(self.usual[name], weights))
            elif name in self.sizes:
                # Shares of none and of a cause in what speaks for the effect.
                beyond = _beyond(self.sizes[name], weights.smallest, weights)
                small = min(value, weights.surest) - float(np.logaddexp(0.0, beyond))
                none[name] = float(np.logaddexp(none.get(name, -np.inf), small))
                odds[name] = value - float(np.logaddexp(0.0, -beyond))
        not_outside = float(np.logaddexp.reduce([*odds.values(), *none.values()]))
        for name, value in freed.items():
            if name in both:
                continue
            beyond = _beyond(self.sizes[name], weights.smallest, weights) if name in self.sizes else np.inf
            small = not_outside + min(value, weights.surest) - np.logaddexp(0.0, beyond)
            none[name] = float(np.logaddexp(none.get(name, -np.inf), small))
            of_balance = not_outside + value - np.logaddexp(0.0, -beyond)
            odds[name] = float(np.logaddexp(odds[name], of_balance) if name in either else of_balance)
        return {(n, n): v for n, v in odds.items()} | {(NONE, n): v for n, v in none.items()}

    def _stands_against(self, other: str, name: str, freed: float, weights: SessionWeights) -> float:
        """Log odds of ``name`` beside free forces, as far as the law prefers it to another one."""
        law = (self._of_law(name, weights) - self._of_law(other, weights)) / weights.rivals
        return float(np.logaddexp(0.0, freed) * expit(law))

    def _of_law(self, name: str, weights: SessionWeights) -> float:
        """Log evidence under the law, less what a flexible stand-in or a searched obstacle needs beyond."""
        beyond = weights.stand_in if name in _FLEXIBLE else weights.searched if name in PUSHING else 0.0
        return self.nats(name) - beyond

    def _apart(self, freed: Mapping[str, float], weights: SessionWeights) -> dict[str, float]:
        """Log odds of causes from outside, with what a law says of them among themselves; their sum stays.

        It is that of those that are not _SHARING.
        """
        of_law = {
            name: self._of_law(name, weights) / weights.rivals for name in freed if name in self.effects
        }
        alone = [freed[name] for name in of_law if name not in _SHARING]
        if not alone:
            return {name: -np.inf if name in _SHARING else value for name, value in freed.items()}
        best = max(of_law.values())
        told = {name: freed[name] + max(value - best, -weights.farthest) for name, value in of_law.items()}
        before, after = np.logaddexp.reduce(alone), np.logaddexp.reduce(list(told.values()))
        return {**freed, **{name: float(value + before - after) for name, value in told.items()}}


@dataclass(frozen=True)
class SessionCase:
    """Evidence with its cause.

    Attributes:
        session: that it comes from; cases of one session are left out together.
        cause: name of the effect, NONE for none that moves the cloth.
        evidence: see MotionEvidence.
        clips: that it is from.
    """

    session: str
    cause: str
    evidence: MotionEvidence
    clips: int = 1

    def chances(self, weights: SessionWeights) -> dict[str, float]:
        """Probabilities of effects and of none, by weights for one clip."""
        return chances(self.evidence, weights.of_clips(self.clips))


def learnt_weights(
    cases: Sequence[SessionCase], prior: SessionWeights | None = None, fixed: Collection[str] = ()
) -> SessionWeights:
    """Weights under which causes are most probable.

    Args:
        cases: of sessions without and with every effect.
        prior: what few cases leave as it is; logarithms of its numbers have a deviation of 1. ``strange`` and
            ``strangeness`` stay: they need sessions whose cause is outside the catalogue; and ``law_spread``:
            it is about cloths that are not among the cases.
        fixed: names of weights that stay as well.
    """
    begin = SessionWeights() if prior is None else prior
    names: tuple[str, ...] = ()
    if any(case.evidence.effects for case in cases):
        names = (*names, "threshold", "temperature", "learned")
    if any(case.evidence.outside for case in cases):
        names = (*names, "outside_threshold", "outside_temperature")
    if any(case.evidence.usual for case in cases):
        names = (*names, "usual_size", "usual_spread")
    # What causes from outside say alone teaches only what they are worth.
    within = [case.evidence for case in cases if case.evidence.effects]
    if any(evidence.sizes for evidence in within):
        names = (*names, "smallest", "beyond")
    names = tuple(name for name in names if name not in fixed)
    start = np.log([getattr(begin, name) for name in names])

    def of(logs: Array) -> SessionWeights:
        return replace(begin, **dict(zip(names, map(float, np.exp(logs)), strict=True)))

    def cost(logs: Array) -> float:
        right = [case.chances(of(logs))[case.cause] for case in cases]
        own = sum(map(lapsed_loss, right))
        return float(own + 0.5 * ((logs - start) ** 2).sum())

    # Few numbers and a kink where the misfit reaches the usual one: no derivatives.
    found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4})
    return of(found.x)


def chances(evidence: MotionEvidence, weights: SessionWeights) -> dict[str, float]:
    """Probabilities of effects that move the cloth, of none of them, and of UNKNOWN by its stand-ins."""
    logits = evidence.with_looks(evidence.logits(weights), weights)
    return dict(zip(logits, map(float, softmax(list(logits.values()))), strict=True))


def lapsed_loss(p: float) -> float:
    """Negative log probability of a cause where some cases teach nothing [nats].

    Args:
        p: the cause's probability.
    """
    return -float(np.log((1 - _LAPSE) * p + _LAPSE / 10))


def left_out_chances(cases: Sequence[SessionCase]) -> list[dict[str, float]]:
    """Probabilities of every case by weights that its session had no part in."""
    found: dict[str, SessionWeights] = {}
    for session in dict.fromkeys(case.session for case in cases):
        found[session] = learnt_weights([case for case in cases if case.session != session])
    return [case.chances(found[case.session]) for case in cases]


def _beyond(size: float, least: float, weights: SessionWeights) -> float:
    """Log odds of a cause against none by its size alone."""
    return weights.beyond * float(np.log(max(size, _LEAST) / least))


def _more_than_usual(size: float, weights: SessionWeights) -> float:
    """Log odds of an effect that every cloth has, as a cause, against its usual strength, by its size alone.

    The logarithm of what is usual has a normal distribution over cloths and solvers; a cause comes on top of
    it, its total evenly distributed in the logarithm up to _LARGEST.
    """
    x, median, spread = np.log(max(size, _LEAST)), np.log(weights.usual_size), weights.usual_spread
    width = max(np.log(_LARGEST) - median, 1.0)
    off = (x - median) / spread
    cause = log_ndtr(off) - np.log(width)
    usual = -0.5 * off**2 - np.log(spread * np.sqrt(2 * np.pi))
    return float(cause - usual - np.log(_CAUSES))


@lru_cache(maxsize=4096)
def _nats(evidence: EffectEvidence, scale: float) -> float:
    # Weights are learnt by asking for the same thousands of times.
    return evidence.nats(scale)


def _log_odds(learned: Mapping[str, float] | None, name: str, effects: Collection[str]) -> float:
    """Of an effect against the mean of those in question; 0 for what the learned decision does not know.

    None and what is outside the catalogue are left to the physical evidence: where they end does not carry
    over from engine to engine, which effect it is does (docs/results/learned_decision.md).
    """
    known = [learned[other] for other in effects if other in learned] if learned else []
    if not learned or name not in learned or not known:
        return 0.0
    return float(np.log(max(learned[name], _LEAST) / max(float(np.mean(known)), _LEAST)))
