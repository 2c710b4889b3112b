"""Gradient-boosted trees as plain arrays: exported from scikit-learn, stored and evaluated without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Trees:
    """Boosted trees of several classes; a node's children of a leaf are the leaf itself.

    Attributes:
        baseline: (C,) scores before any tree.
        classes: (T,) class that each tree adds to.
        roots: (T,) first node of each tree.
        features: (n,) that a node looks at.
        thresholds: (n,) up to which it goes left.
        missing_left: (n,) whether nan goes left.
        children: (n, 2) left and right.
        values: (n,) of leaves.
        depth: of the deepest tree.
    """

    baseline: Array
    classes: NDArray[np.int64]
    roots: NDArray[np.int64]
    features: NDArray[np.int64]
    thresholds: Array
    missing_left: NDArray[np.bool_]
    children: NDArray[np.int64]
    values: Array
    depth: int

    def scores(self, rows: Array) -> Array:
        """Scores (n, C) of rows of features (n, k); nan is a missing one."""
        scores = np.tile(self.baseline, (len(rows), 1))
        for score, row in zip(scores, np.asarray(rows, np.float64), strict=True):
            node = self.roots
            for _ in range(self.depth):
                value = row[self.features[node]]
                left = np.where(np.isnan(value), self.missing_left[node], value <= self.thresholds[node])
                node = self.children[node, np.where(left, 0, 1)]
            np.add.at(score, self.classes, self.values[node])
        return scores

    def splits(self, n_features: int) -> NDArray[np.int64]:
        """How many nodes split by each feature (k,)."""
        inner = self.children[:, 0] != np.arange(len(self.features))
        return np.bincount(self.features[inner], minlength=n_features)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """As arrays of small types, for a file."""
        return {
            "baseline": self.baseline,
            "classes": self.classes.astype(np.int16),
            "roots": self.roots.astype(np.int32),
            "features": self.features.astype(np.int16),
            "thresholds": self.thresholds,
            "missing_left": self.missing_left,
            "children": self.children.astype(np.int32),
            "values": self.values.astype(np.float32),
            "depth": np.array(self.depth),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Trees:
        """From what ``arrays`` gave."""
        return cls(
            baseline=arrays["baseline"].astype(np.float64),
            classes=arrays["classes"].astype(np.int64),
            roots=arrays["roots"].astype(np.int64),
            features=arrays["features"].astype(np.int64),
            thresholds=arrays["thresholds"].astype(np.float64),
            missing_left=arrays["missing_left"].astype(bool),
            children=arrays["children"].astype(np.int64),
            values=arrays["values"].astype(np.float64),
            depth=int(arrays["depth"]),
        )


NEVER = -30.0
"""Score of a class that did not occur."""


def exported(model: HistGradientBoostingClassifier, n_classes: int | None = None) -> Trees:
    """Trees of a fitted classifier of three classes or more, without categorical features.

    Args:
        model: fitted to class numbers.
        n_classes: C, where some of them may not have occurred; None for as many as did.
    """
    numbers = model.classes_.astype(np.int64) if n_classes else np.arange(len(model.classes_))
    baseline = np.full(n_classes or len(numbers), NEVER)
    # scikit-learn has no public way to its trees; a test compares the scores.
    iterations = model._predictors  # type: ignore[attr-defined]
    parts: dict[str, list[NDArray[Any]]] = {
        k: [] for k in ("features", "thresholds", "missing_left", "children", "values")
    }
    classes, roots, start, depth = [], [], 0, 0
    for trees in iterations:
        for k, tree in enumerate(trees):
            nodes = tree.nodes
            leaf = nodes["is_leaf"].astype(bool)
            own = np.arange(len(nodes))
            left = np.where(leaf, own, nodes["left"].astype(np.int64))
            right = np.where(leaf, own, nodes["right"].astype(np.int64))
            parts["features"].append(np.where(leaf, 0, nodes["feature_idx"].astype(np.int64)))
            parts["thresholds"].append(nodes["num_threshold"].astype(np.float64))
            parts["missing_left"].append(nodes["missing_go_to_left"].astype(bool))
            parts["children"].append(start + np.stack([left, right], -1))
            parts["values"].append(np.where(leaf, nodes["value"], 0.0))
            classes.append(int(numbers[k]))
            roots.append(start)
            depth = max(depth, int(nodes["depth"].max()))
            start += len(nodes)
    baseline[numbers] = np.asarray(model._baseline_prediction).ravel()  # type: ignore[attr-defined]
    return Trees(
        baseline=baseline,
        classes=np.array(classes),
        roots=np.array(roots),
        depth=depth,
        **{k: np.concatenate(v) for k, v in parts.items()},
    )
