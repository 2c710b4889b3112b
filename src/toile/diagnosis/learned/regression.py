"""Least squares in blocks: what a block of regressors explains beside others, from one Gram matrix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_RIDGE = 1e-4
"""Of a column's own square: regressors that are nearly one another's sum share their coefficient."""


@dataclass(frozen=True)
class Blocks:
    """A target and named blocks of regressors, all columns of unit length.

    Attributes:
        gram: (n, n) of the columns; moments (n,) of columns and target.
        total: square of the target.
        columns: of every block.
        scales: (n,) lengths of the columns before.
        freedom: independent numbers that the target holds.
    """

    gram: Array
    moments: Array
    total: float
    columns: Mapping[str, NDArray[np.int64]]
    scales: Array
    freedom: float

    @classmethod
    def of(cls, target: Array, blocks: Mapping[str, Array], correlated: float = 1.0) -> Blocks:
        """From a target (m,) and regressors (m, k) by block.

        Args:
            target: what is to be explained.
            blocks: regressors.
            correlated: rows that tell the same, because a smoothing has run over them.
        """
        columns, start = {}, 0
        for name, block in blocks.items():
            columns[name] = np.arange(start, start + block.shape[1])
            start += block.shape[1]
        matrix = np.concatenate([*blocks.values(), target[:, None]], 1)
        gram = matrix.T @ matrix
        scales = np.sqrt(np.maximum(np.diag(gram)[:-1], 1e-30))
        return cls(
            gram[:-1, :-1] / np.outer(scales, scales),
            gram[:-1, -1] / scales,
            float(gram[-1, -1]),
            columns,
            scales,
            max(len(target) / correlated, 1.0),
        )

    def picked(self, names: Iterable[str]) -> NDArray[np.int64]:
        """Columns of several blocks."""
        return np.concatenate([self.columns[n] for n in names])

    def fit(self, names: Sequence[str]) -> tuple[Array, float, Array]:
        """Coefficients of the unit columns, what is left of the square, and the inverse's diagonal."""
        index = self.picked(names)
        inverse = np.linalg.inv(self.gram[np.ix_(index, index)] + _RIDGE * np.eye(len(index)))
        coefficients = inverse @ self.moments[index]
        left = self.total - float(coefficients @ self.moments[index])
        return coefficients, max(left, 1e-12 * self.total + 1e-30), np.diag(inverse)

    def left(self, names: Sequence[str]) -> float:
        """What is left of the target's square."""
        index = self.picked(names)
        matrix = self.gram[np.ix_(index, index)] + _RIDGE * np.eye(len(index))
        left = self.total - float(self.moments[index] @ np.linalg.solve(matrix, self.moments[index]))
        return max(left, 1e-12 * self.total + 1e-30)

    def left_of_pairs(self, base: Sequence[str], groups: Sequence[Sequence[str]]) -> Array:
        """What is left with the base and two groups (n, n), symmetric; with one on the diagonal."""
        b = self.picked(base)
        parts = [self.picked(group) for group in groups]
        rest = np.concatenate(parts)
        ridged = self.gram + _RIDGE * np.eye(len(self.gram))
        inner = np.linalg.solve(
            ridged[np.ix_(b, b)], np.column_stack([self.gram[np.ix_(b, rest)], self.moments[b]])
        )
        # The base is eliminated once; pairs are what is left, filled up to one size.
        gram = ridged[np.ix_(rest, rest)] - self.gram[np.ix_(rest, b)] @ inner[:, :-1]
        moments = self.moments[rest] - self.gram[np.ix_(rest, b)] @ inner[:, -1]
        start = np.cumsum([0, *(len(p) for p in parts)])
        own = [np.arange(start[i], start[i + 1]) for i in range(len(parts))]
        first, second = np.triu_indices(len(parts))
        index = [
            own[i] if i == j else np.concatenate([own[i], own[j]]) for i, j in zip(first, second, strict=True)
        ]
        size = max(len(i) for i in index)
        padded = np.full((len(index), size), -1)
        for row, i in zip(padded, index, strict=True):
            row[: len(i)] = i
        real = padded >= 0
        matrices = np.where(real[:, :, None] & real[:, None], gram[padded[:, :, None], padded[:, None]], 0.0)
        matrices += np.where(real, 0.0, 1.0)[:, :, None] * np.eye(size)
        vectors = np.where(real, moments[padded], 0.0)
        explained = (vectors * np.linalg.solve(matrices, vectors[..., None])[..., 0]).sum(1)
        left = np.empty((len(parts), len(parts)))
        left[first, second] = left[second, first] = (
            self.total - float(self.moments[b] @ inner[:, -1]) - explained
        )
        return np.maximum(left, 1e-12 * self.total + 1e-30)

    def gain(self, with_: Sequence[str], without: Sequence[str]) -> float:
        """Logarithm of what is left without a block over what is left with it."""
        return float(np.log(self.left(without) / self.left(with_)))

    def signed(self, names: Sequence[str], block: str) -> tuple[Array, Array]:
        """Coefficients in the regressors' own units, and over their deviations, of one block among others."""
        coefficients, left, spread = self.fit(names)
        start = sum(len(self.columns[n]) for n in names[: names.index(block)])
        part = slice(start, start + len(self.columns[block]))
        deviation = np.sqrt(left / self.freedom * spread[part])
        return coefficients[part] / self.scales[self.columns[block]], coefficients[part] / deviation
