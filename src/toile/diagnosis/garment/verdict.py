"""From evidence to probabilities and an answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

NONE, AMBIGUOUS = "none", "ambiguous"

NAMED = 0.9
"""Probability from which on a hypothesis is the answer, and which the candidates hold together."""


@dataclass(frozen=True)
class DecisionWeights:
    """Turn log evidence into probabilities: log odds against none are (evidence - threshold) / temperature.

    Attributes:
        threshold: evidence at which an effect and none are equally probable [nats].
        temperature: by which evidence is too sure.
    """

    threshold: float
    temperature: float

    def probabilities(self, nats: Mapping[str, float]) -> dict[str, float]:
        """Of none and of every effect, given log evidence against none."""
        logits = np.array([0.0, *((value - self.threshold) / self.temperature for value in nats.values())])
        shares = np.exp(logits - logsumexp(logits))
        return dict(zip((NONE, *nats), map(float, shares), strict=True))

    @staticmethod
    def learnt(clips: Sequence[tuple[str, Mapping[str, float]]]) -> DecisionWeights:
        """Those under which the truth of some clips is most probable.

        A weak prior (deviation of one e-fold around a temperature of 1, three nats around a threshold of 0)
        keeps them finite where the clips are told apart completely.

        Args:
            clips: name of the truth, and log evidence by effect.
        """

        def cost(x: np.ndarray) -> float:
            weights = DecisionWeights(float(x[0]), float(np.exp(x[1])))
            lost = -sum(np.log(max(weights.probabilities(nats)[truth], 1e-300)) for truth, nats in clips)
            return float(lost + 0.5 * (x[0] / 3) ** 2 + 0.5 * x[1] ** 2)

        found = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9})
        return DecisionWeights(round(float(found.x[0]), 4), round(float(np.exp(found.x[1])), 4))


@dataclass(frozen=True)
class Verdict:
    """The answer.

    Attributes:
        answer: an effect, ``none`` or ``ambiguous``.
        probabilities: of none and every effect.
        candidates: the most probable hypotheses that together hold 90 %, the first the most probable.
    """

    answer: str
    probabilities: Mapping[str, float]
    candidates: tuple[str, ...]

    @staticmethod
    def of(probabilities: Mapping[str, float]) -> Verdict:
        """The answer that probabilities give: the first if it alone holds 90 %."""
        order = sorted(probabilities, key=lambda name: -probabilities[name])
        sums = np.cumsum([probabilities[name] for name in order])
        count = min(int(np.searchsorted(sums, NAMED - 1e-12)) + 1, len(order))
        answer = order[0] if count == 1 else AMBIGUOUS
        return Verdict(answer, dict(probabilities), tuple(order[:count]))
