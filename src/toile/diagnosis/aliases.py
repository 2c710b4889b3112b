"""Which effects leave the same trace on a clip, and how weak they may be to be seen there."""

from __future__ import annotations

import numpy as np

from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.decision import Calibration, Weights
from toile.diagnosis.mechanics import Mechanics
from toile.diagnosis.record import Alias


def alias_of(mechanics: Mechanics, size: Discrepancy, calibration: Calibration, weights: Weights) -> Alias:
    """Which effects leave the same trace on this clip, and how weak they may be.

    Args:
        mechanics: with evidence of all effects.
        size: of the discrepancy.
        calibration: says which evidence is enough.
        weights: how much of it counts.
    """
    fisher = mechanics.evidence.fisher(size)
    names = list(mechanics.coefficients)
    blocks = [slice(*mechanics.coefficients[name]) for name in names]
    roots = []
    for block in blocks:
        values, vectors = np.linalg.eigh(fisher[block, block] + 1e-3 * np.eye(block.stop - block.start))
        roots.append(vectors / np.sqrt(np.maximum(values, 1e-9)) @ vectors.T)
    matrix = np.eye(len(names))
    for i in range(len(names)):
        for j in range(i):
            cross = roots[i] @ fisher[blocks[i], blocks[j]] @ roots[j]
            matrix[i, j] = matrix[j, i] = min(1.0, float(np.linalg.norm(cross, 2)))
    limits: dict[str, float | None] = {}
    for name, block in zip(names, blocks, strict=True):
        information = float(fisher[block.start, block.start])
        needed = calibration.usual.get(name, 0.0) + calibration.threshold * max(
            calibration.spread.get(name, 1.0), 1.0
        )
        parameter = mechanics.effects[name].parameters[0]
        fitted = max(needed, 1.0) / weights.in_sample
        limit = float(np.sqrt(2 * fitted / max(information, 1e-12))) * parameter.scale
        limits[name] = limit if limit <= max(abs(parameter.low), abs(parameter.high)) else None
    return Alias(tuple(names), tuple(tuple(float(v) for v in row) for row in matrix), limits)
