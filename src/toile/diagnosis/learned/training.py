"""Training of the learned decision: trees, temperature, power of a session's clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax
from sklearn.ensemble import HistGradientBoostingClassifier

from toile.diagnosis.learned.decision import LearnedDecision
from toile.diagnosis.learned.examples import Examples
from toile.diagnosis.learned.trees import exported
from toile.generation.fast.effects import LABELS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingSettings:
    """How trees are grown.

    Attributes:
        iterations: trees per class.
        rate: of learning.
        leaves: of a tree at most; least: examples in a leaf.
        shrinkage: of the leaves' values (L2).
        share: of the features that a split may look at.
        kept: features that are kept of all, those that a first, short growth splits by most often.
        seed: of what is random.
    """

    iterations: int = 200
    rate: float = 0.07
    leaves: int = 10
    least: int = 25
    shrinkage: float = 3.0
    share: float = 0.2
    kept: int = 300
    seed: int = 0


_FIRST_ITERATIONS, _FIRST_RATE = 50, 0.12


def trained(
    examples: Examples, settings: TrainingSettings, names: Sequence[str] | None = None
) -> LearnedDecision:
    """Grow the trees, on the features that are worth it; not calibrated yet.

    Args:
        examples: three labels or more; one that does not occur is never answered.
        settings: see TrainingSettings.
        names: of the features to choose from; None for all.
    """
    names = examples.names if names is None else tuple(names)
    if len(names) > settings.kept:
        first = replace(settings, iterations=min(_FIRST_ITERATIONS, settings.iterations), rate=_FIRST_RATE)
        splits = _grown(examples, first, names).trees.splits(len(names))
        best = np.sort(np.argsort(-splits, kind="stable")[: settings.kept])
        names = tuple(names[i] for i in best)
    return _grown(examples, settings, names)


def _grown(examples: Examples, settings: TrainingSettings, names: tuple[str, ...]) -> LearnedDecision:
    columns = [examples.names.index(n) for n in names]
    rows = examples.features[:, columns]
    codes = np.array([LABELS.index(label) for label in examples.labels])
    model = HistGradientBoostingClassifier(
        learning_rate=settings.rate,
        max_iter=settings.iterations,
        max_leaf_nodes=settings.leaves,
        min_samples_leaf=settings.least,
        l2_regularization=settings.shrinkage,
        max_features=settings.share,
        max_bins=127,
        early_stopping=False,
        random_state=settings.seed,
    )
    model.fit(rows, codes)
    # A little beyond what was seen is no reason to drop a feature.
    low, high = np.nanmin(rows, 0), np.nanmax(rows, 0)
    margin = 0.02 * (high - low)
    return LearnedDecision(
        labels=LABELS,
        names=names,
        ranges=np.stack([low - margin, high + margin], -1).astype(np.float64),
        trees=exported(model, len(LABELS)),
        log_prior=np.log(np.maximum(np.bincount(codes, minlength=len(LABELS)), 0.5) / len(codes)),
    )


def calibrated(
    decision: LearnedDecision, examples: Examples, sessions: Sequence[Examples]
) -> LearnedDecision:
    """Set the temperature on clips that were left out, then the power on sessions that were."""
    codes = _codes(decision, examples)
    scores = decision.trees.scores(_masked(decision, examples))
    temperature = _least(lambda t: _loss(log_softmax(scores / t, -1), codes), 0.3, 5.0)
    decision = decision.calibrated(temperature, 1.0)
    if sessions:
        logs = [decision.log_posteriors(_rows(decision, s)) for s in sessions]
        causes = np.array([_codes(decision, s)[0] for s in sessions])

        def loss(power: float) -> float:
            joint = np.stack([decision.prior + power * (log - decision.prior).sum(0) for log in logs])
            return _loss(log_softmax(joint, -1), causes)

        decision = decision.calibrated(temperature, _least(loss, 0.2, 1.5))
    return decision


def _rows(decision: LearnedDecision, examples: Examples) -> Array:
    columns = [examples.names.index(n) for n in decision.names]
    return examples.features[:, columns].astype(np.float64)


def _masked(decision: LearnedDecision, examples: Examples) -> Array:
    rows = _rows(decision, examples)
    rows[(rows < decision.ranges[:, 0]) | (rows > decision.ranges[:, 1])] = np.nan
    return rows


def _codes(decision: LearnedDecision, examples: Examples) -> NDArray[np.int64]:
    return np.array([decision.labels.index(label) for label in examples.labels])


def _loss(log_probabilities: Array, codes: NDArray[np.int64]) -> float:
    return float(-log_probabilities[np.arange(len(codes)), codes].mean())


def _least(function: object, low: float, high: float) -> float:
    return float(minimize_scalar(function, bounds=(low, high), method="bounded").x)  # type: ignore[call-overload]
