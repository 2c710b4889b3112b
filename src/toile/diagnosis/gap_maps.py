"""Where the base model, left to itself for some frames, departs from the tracked motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.decision import Calibration
from toile.diagnosis.mechanics import Mechanics
from toile.effects.base import Stage
from toile.effects.catalogue import STAGES

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GapMaps:
    """Distances between base model and tracked motion.

    Attributes:
        distances: (F, h, w) [m] on the model's grid; 0 where nothing was compared.
        compared: (F,) whether a frame was.
        regimes: distance in each regime over the median distance.
    """

    distances: Array
    compared: NDArray[np.bool_]
    regimes: dict[str, float]

    @property
    def floor(self) -> float:
        """Median distance [m]."""
        return float(np.median(self.distances[self.compared])) if self.compared.any() else 0.0

    @property
    def mean(self) -> float:
        """Mean distance [m]."""
        return float(self.distances[self.compared].mean()) if self.compared.any() else 0.0

    @property
    def vertices(self) -> Array:
        """Mean over the compared frames (h, w) [m]."""
        if not self.compared.any():
            return np.zeros(self.distances.shape[1:])
        return np.asarray(self.distances[self.compared].mean(0))

    @property
    def frames(self) -> tuple[float, ...]:
        """Mean of every frame over the median distance."""
        return tuple((self.distances.mean((1, 2)) / max(self.floor, 1e-9)).tolist())


def gap_maps(mechanics: Mechanics) -> GapMaps:
    """Simulate every window from its start with the base model alone, without discrepancy."""
    shooting, fit = mechanics.shooting, mechanics.fit
    tracked = shooting.tracked.positions
    away = np.zeros(tracked.shape[:2])
    compared = np.zeros(len(tracked), bool)
    for window in fit.windows:
        standardised = window.standardised.copy()
        standardised[shooting.layout(window.last - window.first)[1] :] = 0.0
        free = shooting.simulate(window, standardised, fit.base)
        frames = free.positions[:: shooting.substeps]
        for i in range(1, len(frames)):
            f = window.first + i
            away[f] = np.linalg.norm(frames[i] - tracked[f], axis=-1)
            compared[f] = True
    speed = np.linalg.norm(np.diff(tracked, axis=0, prepend=tracked[:1]), axis=-1)
    floor = float(np.median(away[compared])) if compared.any() else 0.0
    fast = speed > np.median(speed[compared]) if compared.any() else np.zeros_like(speed, bool)
    regimes = {}
    for name, where in (("fast", fast), ("slow", ~fast)):
        inside = where & compared[:, None]
        regimes[name] = float(away[inside].mean() / max(floor, 1e-9)) if inside.any() else 0.0
    return GapMaps(away.reshape(-1, *shooting.grid), compared, regimes)


def stage_shares(
    evidence: Mapping[str, float], calibration: Calibration, numerics: float
) -> dict[str, float]:
    """Share of every stage in what separates the base model from the clip.

    Numerics come first, as a share of the gap in metres; what they leave is shared out by the evidence of
    each stage's strongest effect.

    Args:
        evidence: log evidence by effect.
        calibration: see Calibration.
        numerics: what a shorter time step changes over the gap, in [0, 1].
    """
    stages: dict[str, float] = {}
    for name, value in evidence.items():
        stage = STAGES[name].value
        score = max(calibration.score(name, value), 0.0)
        stages[stage] = max(stages.get(stage, 0.0), score)
    total = sum(stages.values())
    rest = 1 - numerics
    shares = {stage: rest * value / total if total > 0 else 0.0 for stage, value in stages.items()}
    return {Stage.NUMERICS.value: numerics, **shares}


def stage_chances(chances: Mapping[str, float]) -> dict[str, float]:
    """How probable it is that the gap lies in each stage; what is missing is none, or outside the catalogue.

    Args:
        chances: probabilities by effect; names that are no effect belong to no stage.
    """
    stages: dict[str, float] = {}
    for name, chance in chances.items():
        if name in STAGES:
            stages[STAGES[name].value] = stages.get(STAGES[name].value, 0.0) + chance
    return stages
