"""Probabilities of what moves a cloth, from features of one clip or of several."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax, softmax

from toile.atomic_file import written_atomically
from toile.diagnosis.learned.features import VERSION
from toile.diagnosis.learned.trees import Trees
from toile.errors import InputError

Array = NDArray[np.float64]

WEIGHTS = Path(__file__).with_name("weights.npz")
"""Of the package; docs/results/learned_decision.md says how they were made and what they are worth."""


@dataclass(frozen=True)
class LearnedDecision:
    """Boosted trees on physical features, calibrated.

    Attributes:
        labels: none, the effects that move the cloth, outside.
        names: of the features.
        ranges: (k, 2) of every feature in training; what lies outside is not looked at.
        trees: see Trees.
        temperature: that scores are divided by.
        session_power: of the likelihood of every clip of a session, below 1 since clips share what misleads.
        log_prior: (C,) shares of the labels in training.
    """

    labels: tuple[str, ...]
    names: tuple[str, ...]
    ranges: Array
    trees: Trees
    temperature: float = 1.0
    session_power: float = 1.0
    log_prior: Array | None = None

    @classmethod
    def load(cls, path: Path | str | None = None) -> LearnedDecision:
        """Read weights; None for those of the package.

        Raises:
            InputError: no such file, or weights for other features.
        """
        path = WEIGHTS if path is None else Path(path)
        if not path.is_file():
            raise InputError(
                "No learned decision",
                where=str(path),
                expected="weights of `toile blind train`",
                got="no file",
            )
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if int(arrays["version"]) != VERSION:
            raise InputError(
                "The learned decision is for other features",
                where=str(path),
                expected=f"version {VERSION}",
                got=f"version {int(arrays['version'])}",
            )
        return cls(
            labels=tuple(json.loads(str(arrays["labels"]))),
            names=tuple(json.loads(str(arrays["names"]))),
            ranges=arrays["ranges"].astype(np.float64),
            trees=Trees.from_arrays(arrays),
            temperature=float(arrays["temperature"]),
            session_power=float(arrays["session_power"]),
            log_prior=arrays["log_prior"].astype(np.float64),
        )

    def save(self, path: Path) -> None:
        """Write the weights; nothing in them is code."""
        arrays: dict[str, NDArray[Any]] = {
            **self.trees.arrays(),
            "version": np.array(VERSION),
            "labels": np.array(json.dumps(self.labels)),
            "names": np.array(json.dumps(self.names)),
            "ranges": self.ranges,
            "temperature": np.array(self.temperature),
            "session_power": np.array(self.session_power),
            "log_prior": self.prior,
        }
        with written_atomically(path) as temporary:
            np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]

    @property
    def prior(self) -> Array:
        """Logarithms of the labels' shares in training (C,)."""
        n = len(self.labels)
        return np.full(n, -np.log(n)) if self.log_prior is None else self.log_prior

    def calibrated(self, temperature: float, session_power: float) -> LearnedDecision:
        """The same trees with other calibration."""
        return replace(self, temperature=temperature, session_power=session_power)

    def outside_range(self, features: Mapping[str, float]) -> tuple[str, ...]:
        """Names of features beyond what training has seen, which are dropped."""
        row = self._row(features)
        beyond = (row < self.ranges[:, 0]) | (row > self.ranges[:, 1])
        return tuple(name for name, out in zip(self.names, beyond, strict=True) if out)

    def posterior(self, features: Mapping[str, float]) -> dict[str, float]:
        """Probabilities by label of one clip, under the shares of the labels in training.

        Args:
            features: see clip_features; those that are missing count as nan.
        """
        return self._by_label(softmax(self._log_posteriors([features])[0]))

    def session_posterior(self, clips: Sequence[Mapping[str, float]]) -> dict[str, float]:
        """Probabilities by label of several clips of one cloth that share its cause.

        Raises:
            InputError: no clip.
        """
        if not clips:
            raise InputError("A session without clips", where="clips", expected="one or more", got="none")
        return self._by_label(softmax(self.combined(self._log_posteriors(clips))))

    def combined(self, log_posteriors: Array) -> Array:
        """Logarithm (C,) of the joint posterior, up to a constant, from those of clips (n, C)."""
        power = self.session_power if len(log_posteriors) > 1 else 1.0
        result: Array = self.prior + power * (log_posteriors - self.prior).sum(0)
        return result

    def log_posteriors(self, rows: Array) -> Array:
        """Logarithms (n, C) of the posteriors of rows of features (n, k) in the order of ``names``."""
        rows = np.array(rows, np.float64)
        rows[(rows < self.ranges[:, 0]) | (rows > self.ranges[:, 1])] = np.nan
        result: Array = log_softmax(self.trees.scores(rows) / self.temperature, axis=-1)
        return result

    def _log_posteriors(self, clips: Sequence[Mapping[str, float]]) -> Array:
        return self.log_posteriors(np.stack([self._row(f) for f in clips]))

    def _row(self, features: Mapping[str, float]) -> Array:
        # Trees were trained on numbers of single precision.
        row = np.array([features.get(name, np.nan) for name in self.names], np.float32)
        return row.astype(np.float64)

    def _by_label(self, probabilities: Array) -> dict[str, float]:
        return {name: float(p) for name, p in zip(self.labels, probabilities, strict=True)}
