"""Numbers from the balance of forces: gains of every effect alone, beside all others and beside one rival."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.learned.balance import BASE, Balance, balance
from toile.diagnosis.learned.fields import Fields
from toile.diagnosis.learned.motion import TEST_DEGREE, basis
from toile.diagnosis.learned.regression import Blocks

Array = NDArray[np.float64]

_GROUPS: dict[str, tuple[str, ...]] = {
    "gusts": ("gusts",),
    "gusts_normal": ("gusts_normal",),
    "drag": ("drag",),
    "damping": ("damping",),
    "anisotropy": ("anisotropy", "anisotropy_in_plane"),
    "stiffening": ("stiffening",),
    "rest_u": ("rest_u",),
    "rest_v": ("rest_v",),
    "density": ("density",),
    "stiffness": ("stiffness",),
    "interval": ("interval",),
    "contact": ("contact",),
    "pressure": ("pressure",),
    "vortex": ("vortex",),
}
_SIGNED = (
    "drag_linear",
    "viscosity",
    "damping",
    "anisotropy",
    "anisotropy_in_plane",
    "interval",
    "contact",
    "pressure",
    "density",
    "rest_u",
    "rest_v",
    "stiffening",
    "stiffness",
    "vortex",
)
_ALONE = ("drag_linear", "viscosity")  # parts of other blocks


def balance_features(fields: Fields) -> dict[str, float]:
    """Features of one clip; names begin with "balance"."""
    setup = balance(fields)
    b = setup.blocks
    rows = len(setup.target) * setup.target.shape[1]
    left = b.left(BASE)
    result = {
        "left": float(np.log(left / rows)),
        "explained_by_base": float(np.log(b.total / left)),
        "freedom": float(np.log(b.freedom)),
    }
    everything = (*BASE, *dict.fromkeys(n for group in _GROUPS.values() for n in group))
    all_left = b.left(everything)
    result["explained_by_all"] = float(np.log(left / all_left))
    result["left_by_all"] = float(np.log(all_left / rows))
    names = list(_GROUPS)
    pairs = b.left_of_pairs(BASE, list(_GROUPS.values()))
    one = dict(zip(names, np.diag(pairs).tolist(), strict=True))
    best = min(one.values())
    for name, group in _GROUPS.items():
        without = tuple(n for n in everything if n not in group)
        result[f"gain.{name}"] = float(np.log(left / one[name]))
        result[f"nats.{name}"] = 0.5 * b.freedom * result[f"gain.{name}"]
        result[f"own.{name}"] = float(np.log(b.left(without) / all_left))
        result[f"behind.{name}"] = float(np.log(one[name] / best))
    for i, a in enumerate(names):
        for j, c in enumerate(names[i + 1 :], i + 1):
            result[f"beside.{a}.{c}"] = float(np.log(one[c] / pairs[i, j]))
            result[f"beside.{c}.{a}"] = float(np.log(one[a] / pairs[i, j]))
    result |= _coefficients(b, everything)
    result |= _residual(setup, fields)
    return {f"balance.{k}": v for k, v in result.items()}


def _coefficients(b: Blocks, everything: tuple[str, ...]) -> dict[str, float]:
    result = {}
    for name in BASE:
        values, ratios = b.signed(BASE, name)
        for i, (value, ratio) in enumerate(zip(values, ratios, strict=True)):
            result[f"base.{name}{i}"] = float(value)
            result[f"base_ratio.{name}{i}"] = float(ratio)
    for name in _SIGNED:
        values, ratios = b.signed((*BASE, name), name)
        _, among = b.signed(everything if name not in _ALONE else (*BASE, name), name)
        for i in range(len(values)):
            result[f"value.{name}{i}"] = float(values[i])
            result[f"ratio.{name}{i}"] = float(ratios[i])
            if name not in _ALONE:
                result[f"among.{name}{i}"] = float(among[i])
    return result


def _residual(setup: Balance, fields: Fields) -> dict[str, float]:
    """Where, when and how fast the base's residual acts; stresses that it asks for against strains."""
    b = setup.blocks
    coefficients, _, _ = b.fit(BASE)
    units = coefficients / b.scales[b.picked(BASE)]
    explained = np.concatenate([setup.regressors[n] for n in BASE], -1) @ units
    residual = setup.target - explained
    result = {}
    thirds = np.array_split(np.arange(len(residual)), 4)
    total = (residual**2).mean()
    for i, part in enumerate(thirds):
        result[f"residual.quarter{i}"] = float(np.log((residual[part] ** 2).mean() / total))
    power = (residual**2).mean(1)
    result["residual.peak"] = float(np.log(power.max() / total))
    result["residual.peak_time"] = float(fields.time[power.argmax()])
    centred = residual - residual.mean(0)
    result["residual.constant"] = float((residual.mean(0) ** 2).mean() / total)
    for k, lag in enumerate((1, 2, 4)):
        step = max(1, round(lag * fields.motion.window / 4 / fields.stride))
        if step < len(centred) - 2:
            overlap = (centred[step:] * centred[:-step]).mean() / (centred**2).mean()
            result[f"residual.memory{k}"] = float(overlap)
    result |= _uniform_force(setup, residual, fields)
    result |= _stress_against_strain(setup, residual, fields)
    return result


def _uniform_force(setup: Balance, residual: Array, fields: Fields) -> dict[str, float]:
    """The uniform force that every frame's residual asks for, as a series."""
    result = {}
    columns = setup.regressors["wind"]
    gram = np.einsum("ftk,ftl->fkl", columns, columns) + 0.5 * np.eye(2)
    force = np.linalg.solve(gram, np.einsum("ftk,ft->fk", columns, residual)[..., None])[..., 0]
    explained = np.einsum("ftk,fk->ft", columns, force)
    result["force.share"] = float(np.log((residual**2).mean() / ((residual - explained) ** 2).mean()))
    for name, series in zip(("right", "ahead"), force.T, strict=True):
        result[f"force.{name}.deviation"] = float(np.log(series.std() + 1e-6))
        result[f"force.{name}.mean"] = float(series.mean())
        centred = series - series.mean()
        spectrum = np.abs(np.fft.rfft(centred * np.hanning(len(centred)))) ** 2
        hertz = np.fft.rfftfreq(len(centred), fields.stride / fields.motion.fps)
        whole = spectrum.sum() + 1e-30
        for low, high in ((0, 1), (1, 2), (2, 4), (4, 8)):
            share = spectrum[(hertz >= low) & (hertz < high)].sum() / whole
            result[f"force.{name}.hertz{low}"] = float(share)
        for label, other in (("velocity", fields.v), ("acceleration", fields.a), ("place", fields.x)):
            axis = 0 if name == "right" else 2
            moved = np.einsum("q,fq->f", basis().weights, other[..., axis])
            result[f"force.{name}.with_{label}"] = _correlation(series, moved)
    return result


def _stress_against_strain(setup: Balance, residual: Array, fields: Fields) -> dict[str, float]:
    """Stiffness along both directions and in shear: stress that the balance asks for, and strain."""
    modes = basis().test
    weighted = basis().weights[:, None] * modes
    J = modes.shape[1]
    inner = setup.regressors["in_plane"]
    units = setup.blocks.fit(BASE)[0] / setup.blocks.scales[setup.blocks.picked(BASE)]
    # The base's own stress is part of what the balance asks for.
    own = inner @ units[-inner.shape[-1] :]
    stress = np.einsum("fst,ft->fs", setup.stress_gain, residual + own).reshape(len(residual), 3, J)
    strains = (fields.euu, fields.evv, fields.shear)
    picked = [0, 1, TEST_DEGREE + 1, TEST_DEGREE + 2]
    result = {}
    for k, (name, strain) in enumerate(zip(("uu", "vv", "uv"), strains, strict=True)):
        s, e = stress[:, k][:, picked], strain @ weighted[:, picked]
        result[f"stress.{name}.mean"] = float(s[:, 0].mean())
        result[f"stress.{name}.deviation"] = float(np.log(s[:, 0].std() + 1e-6))
        for j in range(len(picked)):
            result[f"stress.{name}.correlation{j}"] = _correlation(s[:, j], e[:, j])
            square = float((e[:, j] ** 2).sum())
            result[f"stress.{name}.stiffness{j}"] = float((s[:, j] * e[:, j]).sum() / (square + 1e-9))
        rate = np.gradient(e[:, 0], fields.interval)
        cube = e[:, 0] * np.abs(e[:, 0])
        matrix = np.stack([np.ones(len(e)), e[:, 0], rate, cube], -1)
        scale = np.sqrt((matrix**2).mean(0)) + 1e-12
        gram = (matrix / scale).T @ (matrix / scale) / len(e) + 1e-3 * np.eye(4)
        fit = np.linalg.solve(gram, (matrix / scale).T @ s[:, 0] / len(e))
        spread = s[:, 0].std() + 1e-9
        result[f"stress.{name}.with_rate"] = float(fit[2] / spread)
        result[f"stress.{name}.with_square"] = float(fit[3] / spread)
    return result


def _correlation(a: Array, b: Array) -> float:
    spread = float(a.std() * b.std())
    return float(((a - a.mean()) * (b - b.mean())).mean() / spread) if spread > 1e-15 else float("nan")
