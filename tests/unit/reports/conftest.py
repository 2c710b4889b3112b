"""A made-up diagnosis of a clip, with everything that a report can hold."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from toile.diagnosis.record import (
    Alias,
    EffectReport,
    Estimate,
    GapReport,
    Protocol,
    Shrink,
    Verdict,
    Where,
)
from toile.effects.catalogue import CATALOGUE
from toile.reports.diagnosis_arrays import DiagnosisArrays, Screening

CONFIG = "scene: <tiny>\n"


def shrink(estimate: float, *, placebo: float | None = 0.05, spread: float = 0.08) -> Shrink:
    return Shrink(
        "distance to tracked positions [mm]",
        "frames 30 to 39",
        8.0,
        8.0 * (1 - estimate),
        estimate,
        estimate - spread,
        estimate + spread,
        placebo,
    )


def made_up_report(n_frames: int = 40, n_used: int = 30) -> GapReport:
    """Air drag, clearly."""
    rng = np.random.default_rng(0)
    probabilities = {"air_drag": 0.93, "internal_damping": 0.03, "gusts": 0.012}
    shrinks = {
        "air_drag": shrink(0.6),
        "internal_damping": shrink(0.31),
        "gusts": shrink(-0.1),
    }
    effects = []
    for name, effect in CATALOGUE.items():
        numbers = {}
        for k, p in enumerate(effect.PARAMETERS):
            value = float(np.clip((0.8 if k % 2 == 0 else 0.1) * p.scale, p.low, p.high))
            reach = 0.3 * p.scale
            numbers[p.name] = Estimate(value, max(value - reach, p.low), min(value + reach, p.high), p.unit)
        effects.append(
            EffectReport(
                name,
                effect.STAGE.value,
                probabilities.get(name, 0.0005),
                numbers,
                shrinks.get(name),
            )
        )
    effects.sort(key=lambda effect: -effect.probability)
    names = tuple(e.name for e in effects if e.stage in ("mechanics", "actuation", "camera"))
    factors = rng.normal(size=(len(names), 12))
    factors[names.index("internal_damping")] = factors[names.index("air_drag")] + 0.2
    factors /= np.linalg.norm(factors, axis=1, keepdims=True)
    matrix = np.minimum(np.abs(factors @ factors.T), 1.0)
    limits = {
        name: None if k == 4 else 0.3 * CATALOGUE[name].PARAMETERS[0].scale for k, name in enumerate(names)
    }
    scores = np.concatenate((1 + 0.9 * np.sin(np.arange(n_used) / 4) ** 2, np.zeros(n_frames - n_used)))
    return GapReport(
        Verdict("air_drag", ("air_drag",), "mechanics", 0.93, "air_drag explains <it>.", ""),
        Where(
            {
                "actuation": 0.08,
                "mechanics": 0.71,
                "camera": 0.11,
                "appearance": 0.07,
                "observation": 0.03,
            },
            tuple(scores.tolist()),
            "gap_vertices.npy",
            {"fast": 1.6, "slow": 0.7, "slack": 1.1},
        ),
        tuple(effects),
        Alias(names, tuple(tuple(row) for row in matrix.tolist()), limits),
        Protocol(0, tuple(range(n_used)), tuple(range(n_used, n_frames)), "toile 0.1", "gusts"),
    )


def made_up_arrays(positions: np.ndarray, n_used: int) -> DiagnosisArrays:
    """Arrays on a coarser grid (4, 3) for a motion (F, H, W, 3)."""
    F = len(positions)
    i, j = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 3), indexing="ij")
    gap = 1e-3 * (1 + 4 * i * j)[None] * (1 + np.arange(F) / F)[:, None, None]
    gap[n_used:] = 0.0
    return DiagnosisArrays(
        gap[:n_used].mean(0),
        gap,
        positions.reshape(F, -1, 3),
        Screening(
            {"air_drag": 42.0, "gusts": -2.0}, 3.0, (0.4, 0.1), np.zeros(5), np.array([900.0, 410.0, 395.0])
        ),
        CONFIG,
    )


@pytest.fixture
def made_up_diagnosis() -> Callable[..., GapReport]:
    """Makes the report of a clip with so many frames, of which so many are used."""
    return made_up_report


@pytest.fixture
def made_up_gap() -> Callable[..., DiagnosisArrays]:
    """Makes the arrays beside it."""
    return made_up_arrays
