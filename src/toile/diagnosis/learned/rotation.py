"""Torque about the line of the holders, and energy: two balances in which no stress takes part."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.learned.fields import Fields, dot, mean
from toile.diagnosis.learned.regression import Blocks

Array = NDArray[np.float64]

_RIGHT, _DOWN, _AHEAD = np.eye(3)


def rotation_features(fields: Fields) -> dict[str, float]:
    """Balance of torque about the line through the two outer pins; names begin with "torque"."""
    pins = _smooth_pins(fields, 0)
    if pins.shape[1] < 2:
        return {}
    line = pins[:, -1] - pins[:, 0]
    axis = line / np.linalg.norm(line, axis=-1, keepdims=True)
    arm = fields.x - pins[:, :1]
    inertia = fields.a - _DOWN
    n, v = fields.n, fields.v
    speed = np.linalg.norm(v, axis=-1, keepdims=True)
    across = dot(v, n)[..., None] * n

    def torque(force: Array) -> Array:
        return dot(mean(np.cross(arm, np.broadcast_to(force, arm.shape))), axis)

    waves = np.cos(np.pi * fields.time[:, None] * np.arange(1, 9))
    ahead, normal = torque(_AHEAD), torque(n * (n @ _AHEAD)[..., None])
    place = np.linalg.norm(arm, axis=-1, keepdims=True)
    blocks = {
        "base": np.stack([ahead, normal, torque(_RIGHT)], -1),
        "drag": np.stack([torque(-across), torque(-speed * across), torque(-v)], -1),
        "gusts": ahead[:, None] * waves,
        "density": np.stack([torque((place - 0.5) * inertia), torque((place - 0.5) ** 2 * inertia)], -1),
        "interval": torque(_DOWN)[:, None],
        "pressure": torque(n)[:, None],
        "bending": torque(n * (fields.rvv + fields.ruu)[..., None])[:, None],
    }
    return {f"torque.{k}": x for k, x in _series(torque(inertia), blocks, fields, "base").items()}


def energy_features(fields: Fields) -> dict[str, float]:
    """Balance of power; names begin with "energy"."""
    v, a, n = fields.v, fields.a, fields.n
    hand = _smooth_pins(fields, 1).mean(1)
    # Seen from the hand the reaction does no work, and inertia does.
    relative = v - hand[:, None]
    power = mean(dot(relative, a - _DOWN))
    speed = np.linalg.norm(v, axis=-1)
    across = dot(v, n)
    rate = fields.interval
    stored = np.stack([mean(fields.kuu**2 + fields.kvv**2), mean(fields.shear**2)], -1)
    blocks = {
        "wind": np.stack(
            [mean(relative[..., 0]), mean(relative[..., 2]), mean(dot(relative, n) * n[..., 2])], -1
        ),
        "stored": -np.gradient(stored, rate, axis=0),
        "drag": -np.stack([mean(across**2), mean(speed * across**2), mean(speed**2)], -1),
        "damping": -np.stack(
            [
                mean(fields.ruu**2 + fields.rvv**2),
                mean(fields.shear_rate**2),
                mean(dot(fields.vu, fields.vu) + dot(fields.vv, fields.vv)),
            ],
            -1,
        ),
        "interval": mean(relative[..., 1])[:, None],
    }
    blocks["base"] = np.concatenate([blocks.pop("wind"), blocks.pop("stored")], -1)
    features = _series(power, blocks, fields, "base")
    moving = mean(dot(v, v)) / 2 - mean(fields.x[..., 1])
    change = moving - moving[0] - np.cumsum(dot(mean(a - _DOWN), hand)) * rate
    part = max(len(change) // 4, 1)
    for k in range(4):
        features[f"change{k}"] = float(change[k * part : (k + 1) * part].mean())
    features["kinetic"] = float(np.log(mean(dot(v, v)).mean() + 1e-9))
    return {f"energy.{k}": x for k, x in features.items()}


def _series(target: Array, blocks: Mapping[str, Array], fields: Fields, base: str) -> dict[str, float]:
    """Gains and signs of blocks of a scalar series, beside its base."""
    b = Blocks.of(target, blocks, correlated=fields.correlated)
    left = b.left((base,))
    result = {"left": float(np.log(left / len(target) + 1e-12)), "explained": float(np.log(b.total / left))}
    for name in blocks:
        values, ratios = b.signed((base, name) if name != base else (base,), name)
        for i in range(len(values) if name != "gusts" else 0):
            result[f"value.{name}{i}"] = float(values[i])
            result[f"ratio.{name}{i}"] = float(ratios[i])
        if name != base:
            result[f"gain.{name}"] = b.gain((base, name), (base,))
    for name in blocks:
        others = [n for n in blocks if n not in (base, name, "gusts")]
        if name not in (base, "gusts"):
            result[f"own.{name}"] = b.gain((base, *others, name), (base, *others))
    return result


def _smooth_pins(fields: Fields, order: int) -> Array:
    m = fields.motion
    smooth = m.smoothed(m.pins, order)[fields.frames]
    # The pinned vertices in the order of their row, so that first and last are the outer ones.
    return smooth[:, np.argsort(m.pin_places[:, 0])]
