"""How the evidence of a session's motion becomes probabilities, and how the numbers in it are learnt.

A drop of the misfit is no probability: models are wrong in ways that other effects can mend a little, and
errors of neighbouring frames are alike. What a drop is worth is learnt on generated sessions whose cause is
known, by the likelihood of their causes (a multinomial logistic regression with the misfit's scale inside).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.errors import InputError
from toile.json_file import read_json_object

Array = NDArray[np.float64]

SHIPPED = Path(__file__).with_name("session_weights.json")

USUAL_SHARE = 0.0025
"""Errors that a base model of an unknown cloth may have [widths]."""

_LEAST = 1e-4
"""Probability of the learned decision that says no more, and share of the usual misfit that does."""


@dataclass(frozen=True)
class SessionWeights:
    """How evidence of the motion becomes a probability.

    Attributes:
        usual: what errors of the base model's size cost a right model, over what they are expected to.
        finest: share of it below which smaller errors do not make differences count for more.
        usual_size: distance by which an effect that every cloth has usually moves it, in the last third of
            the first clip [widths]: at that size, a cause and none are equally probable.
        beyond: e-folds of the odds of such an effect for each logarithm beyond that.
        threshold: evidence at which an effect and none are equally probable [nats].
        temperature: evidence by which the odds of an effect grow e-fold [nats].
        learned: weight of the learned decision's log odds among effects.
        strange: squared errors that the best hypothesis leaves, over those of USUAL_SHARE, where something
            unknown and none are equally probable.
        strangeness: e-folds of the odds of something unknown for each logarithm beyond that.
    """

    usual: float = 1.0
    finest: float = 0.3
    usual_size: float = 0.025
    beyond: float = 12.0
    threshold: float = 15.0
    temperature: float = 5.0
    learned: float = 0.6
    strange: float = 4.0
    strangeness: float = 4.0

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

    def write(self, path: Path, source: str) -> None:
        """Write them with what they were learnt from."""
        write_text(path, json.dumps({"weights": asdict(self), "source": source}, indent=2) + "\n")


@dataclass(frozen=True)
class MotionEvidence:
    """What the clips of a session say about effects that move the cloth.

    Attributes:
        base: smooth errors of the base model.
        effects: what the fit of every effect says.
        learned: probabilities of the learned decision by label, None where there is none.
        usual: effects that every cloth has, with the distance by which they move this one, see
            effect_size.moved; what is said of them is against a model without.
    """

    base: ModelErrors
    effects: Mapping[str, EffectEvidence]
    learned: Mapping[str, float] | None = None
    usual: Mapping[str, float] = field(default_factory=dict)

    def left(self, weights: SessionWeights) -> float:
        """Squared errors of the best hypothesis over those that were expected of it."""
        most = max((e.drop for name, e in self.effects.items() if name not in self.usual), default=0.0)
        # A drop is of ties and priors as well, so it may be more than all errors.
        return max((self.base.cost - most) / (weights.usual * self.base.expected), _LEAST)

    def over_usual(self, weights: SessionWeights) -> float:
        """Squared errors of the best hypothesis over those of USUAL_SHARE."""
        return self.left(weights) * (self.base.share / USUAL_SHARE) ** 2

    def nats(self, name: str, weights: SessionWeights) -> float:
        """Log evidence of an effect against the base model."""
        return self.effects[name].nats(self.scale(weights))

    def scale(self, weights: SessionWeights) -> float:
        """By how much all misfits are too large: what even the best hypothesis is wrong by is the noise."""
        return max(weights.finest, self.left(weights))

    def logit(self, name: str, weights: SessionWeights) -> float:
        """Log odds of an effect against none."""
        odds = weights.learned * _log_odds(self.learned, name, self.effects)
        logit = (self.nats(name, weights) - weights.threshold) / weights.temperature + odds
        if name in self.usual:
            # However sure it is that it acts, it is a cause only where it is more than usual.
            logit = min(logit, weights.beyond * np.log(max(self.usual[name], _LEAST) / weights.usual_size))
        return float(logit)


@dataclass(frozen=True)
class SessionCase:
    """Evidence with its cause.

    Attributes:
        session: that it comes from; cases of one session are left out together.
        cause: name of the effect, NONE for none that moves the cloth.
        evidence: see MotionEvidence.
    """

    session: str
    cause: str
    evidence: MotionEvidence


def learnt_weights(cases: Sequence[SessionCase], prior: SessionWeights | None = None) -> SessionWeights:
    """Weights under which causes are most probable.

    Args:
        cases: of sessions without and with every effect.
        prior: what few cases leave as it is; logarithms of its numbers have a deviation of 1. ``strange`` and
            ``strangeness`` stay: they need sessions whose cause is outside the catalogue.
    """
    begin = SessionWeights() if prior is None else prior
    names: tuple[str, ...] = ("usual", "finest", "threshold", "temperature", "learned")
    if any(case.evidence.usual for case in cases):
        names = (*names, "usual_size", "beyond")
    start = np.log([getattr(begin, name) for name in names])

    def of(logs: Array) -> SessionWeights:
        return replace(begin, **dict(zip(names, map(float, np.exp(logs)), strict=True)))

    def cost(logs: Array) -> float:
        own = -sum(np.log(max(chances(case.evidence, of(logs))[case.cause], 1e-12)) for case in cases)
        return float(own + 0.5 * ((logs - start) ** 2).sum())

    # Few numbers and a kink where the misfit reaches the usual one: no derivatives.
    found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4})
    return of(found.x)


def chances(evidence: MotionEvidence, weights: SessionWeights) -> dict[str, float]:
    """Probabilities of effects that move the cloth and of none of them."""
    names = [NONE, *evidence.effects]
    logits = [0.0, *(evidence.logit(name, weights) for name in evidence.effects)]
    return dict(zip(names, map(float, np.exp(log_softmax(logits))), strict=True))


def left_out_chances(cases: Sequence[SessionCase]) -> list[dict[str, float]]:
    """Probabilities of every case by weights that its session had no part in."""
    found: dict[str, SessionWeights] = {}
    for session in dict.fromkeys(case.session for case in cases):
        found[session] = learnt_weights([case for case in cases if case.session != session])
    return [chances(case.evidence, found[case.session]) for case in cases]


def _log_odds(learned: Mapping[str, float] | None, name: str, effects: Collection[str]) -> float:
    """Of an effect against the mean of those in question; 0 for what the learned decision does not know.

    None and what is outside the catalogue are left to the physical evidence: where they end does not carry
    over from engine to engine, which effect it is does (docs/results/learned_decision.md).
    """
    known = [learned[other] for other in effects if other in learned] if learned else []
    if not learned or name not in learned or not known:
        return 0.0
    return float(np.log(max(learned[name], _LEAST) / max(float(np.mean(known)), _LEAST)))
