"""How the cloth looks and moves: strain, curvature, modes, holders; no force is asked for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.learned.fields import Fields, mean
from toile.diagnosis.learned.motion import TEST_DEGREE, basis

Array = NDArray[np.float64]


def kinematic_features(fields: Fields) -> dict[str, float]:
    """Features of one clip; names begin with the group that they belong to."""
    return {
        **_shape(fields),
        **_holders(fields),
        **_modes(fields),
        **_extent(fields),
        **_recording(fields),
    }


def _shape(f: Fields) -> dict[str, float]:
    """Statistics of strains and curvatures: over the clip, over the cloth, over time, and by place."""
    result = {}
    low = basis().test[:, [1, 2, TEST_DEGREE + 1, TEST_DEGREE + 2, 2 * (TEST_DEGREE + 1)]]
    weighted = basis().weights[:, None] * low
    rough = {"shear": f.shear, "euu": f.euu, "evv": f.evv, "kuu": f.kuu, "kvv": f.kvv, "kuv": f.kuv}
    for name, field in rough.items():
        average = mean(field)
        spread = np.sqrt(mean((field - average[:, None]) ** 2))
        still = field.mean(0)
        result[f"shape.{name}.mean"] = float(average.mean())
        result[f"shape.{name}.first"] = float(average[0])
        result[f"shape.{name}.last"] = float(average[-len(average) // 3 :].mean())
        result[f"shape.{name}.over_time"] = float(average.std())
        result[f"shape.{name}.over_cloth"] = float(spread.mean())
        result[f"shape.{name}.over_cloth_first"] = float(spread[0])
        result[f"shape.{name}.drift"] = float(
            spread[-len(spread) // 3 :].mean() - spread[: len(spread) // 3].mean()
        )
        total = float(np.sqrt((field**2).mean())) + 1e-12
        result[f"shape.{name}.still"] = float(np.sqrt((still**2).mean()) / total)
        result[f"shape.{name}.sign"] = float(average.mean() / total)
        result[f"shape.{name}.fourth"] = float(((field / total) ** 4).mean())
        for k, value in enumerate(still @ weighted):
            result[f"shape.{name}.place{k}"] = float(value)
        moving = ((field - still) ** 2).mean(0)
        for k, value in enumerate(moving @ weighted):
            result[f"shape.{name}.moving{k}"] = float(value / (moving.mean() + 1e-15))
    for a, b in (("kuu", "kvv"), ("euu", "evv")):
        ratio = result[f"shape.{a}.over_cloth"] / (result[f"shape.{b}.over_cloth"] + 1e-12)
        result[f"shape.{a}.over_{b}"] = float(np.log(ratio + 1e-12))
    rates = np.sqrt([mean(r**2).mean() for r in (f.ruu, f.rvv, f.shear_rate)])
    speed = np.sqrt(mean((f.v**2).sum(-1)).mean()) + 1e-9
    for name, value in zip(("ruu", "rvv", "shear_rate"), rates, strict=True):
        result[f"shape.{name}.per_speed"] = float(np.log(value / speed + 1e-9))
    return result


def _holders(f: Fields) -> dict[str, float]:
    """Paths of the pinned vertices against one another."""
    m = f.motion
    order = np.argsort(m.pin_places[:, 0])
    pins = m.smoothed(m.pins, degree=2)[:, order]
    rough = m.pins[:, order] - pins
    noise = float(np.sqrt((rough**2).mean())) + 1e-9
    path = pins.mean(1) - pins[0].mean(0)
    result = {
        "holders.moved": float(np.sqrt((path**2).sum(-1).mean())),
        "holders.noise": float(np.log(noise)),
    }
    speed = np.gradient(path, m.interval, axis=0)
    result["holders.speed"] = float(np.sqrt((speed**2).sum(-1).mean()))
    if pins.shape[1] < 2:
        return result
    between = pins[:, -1] - pins[:, 0]
    change = between - between[0]
    along = between[0] / np.linalg.norm(between[0])
    part = max(len(change) // 4, 1)
    for k in range(4):
        piece = change[k * part : (k + 1) * part].mean(0)
        result[f"holders.apart{k}"] = float(np.linalg.norm(piece))
        result[f"holders.nearer{k}"] = float(-piece @ along)
        result[f"holders.lower{k}"] = float(np.abs(piece[1]))
    rates = np.linalg.norm(np.gradient(change, m.interval, axis=0), axis=-1)
    result["holders.apart_over_noise"] = float(np.log(result["holders.apart3"] / noise + 1e-3))
    result["holders.peak_rate"] = float(rates.max())
    result["holders.peak_over_mean"] = float(rates.max() / (rates.mean() + 1e-9))
    result["holders.apart_trend"] = float(np.abs(change[-1]).max() / (np.abs(change).max() + 1e-9))
    return result


def _modes(f: Fields) -> dict[str, float]:
    """The strongest modes of the motion: shares, frequencies, decay."""
    c = f.motion.coefficients(0)
    hand = f.motion.pins.mean(1)
    moved = (c - c.mean(0)).copy()
    # Relative to the hand: the first coefficient is the mean position.
    moved[:, 0] -= hand - hand.mean(0)
    u, s, _ = np.linalg.svd(moved.reshape(len(c), -1), full_matrices=False)
    share = s**2 / ((s**2).sum() + 1e-30)
    result = {"modes.amplitude": float(np.log(s[0] / np.sqrt(len(c)) + 1e-9))}
    half = len(c) // 2
    for k in range(4):
        series = u[:, k] * s[k]
        result[f"modes.share{k}"] = float(np.log(share[k] + 1e-9))
        spectrum = (
            np.abs(np.fft.rfft((series - series.mean()) * np.hanning(len(series)), 4 * len(series))) ** 2
        )
        hertz = np.fft.rfftfreq(4 * len(series), f.motion.interval)
        result[f"modes.frequency{k}"] = float(hertz[1:][spectrum[1:].argmax()])
        result[f"modes.mean_frequency{k}"] = float((hertz * spectrum).sum() / (spectrum.sum() + 1e-30))
        result[f"modes.decay{k}"] = float(np.log((series[half:].std() + 1e-9) / (series[:half].std() + 1e-9)))
        rate = np.gradient(series, f.motion.interval)
        result[f"modes.rate{k}"] = float(np.log((rate.std() + 1e-9) / (series.std() + 1e-9)))
    power = mean((f.v**2).sum(-1))
    part = max(len(power) // 4, 1)
    for k in range(4):
        result[f"modes.power{k}"] = float(np.log(power[k * part : (k + 1) * part].mean() + 1e-9))
    return result


def _extent(f: Fields) -> dict[str, float]:
    """How far the cloth reaches to both sides, how flat it is there; symmetry; the first moves."""
    result = {}
    ahead = f.x[..., 2] - mean(f.x[..., 2]).mean()
    for name, side in (("front", ahead), ("back", -ahead)):
        reach = side.max(1)
        top = np.sort(side, 1)[:, -10:]
        result[f"extent.{name}.reach"] = float(reach.max() - reach[0])
        result[f"extent.{name}.at_reach"] = float((reach > reach.max() - 0.02).mean())
        spread = top[reach > np.quantile(reach, 0.8)].std(1)
        result[f"extent.{name}.flat"] = float(np.log(spread.mean() + 1e-4))
        push = -f.a[..., 2] if name == "front" else f.a[..., 2]
        result[f"extent.{name}.push"] = float(np.quantile(push, 0.995))
        far = side > np.quantile(side, 0.9)
        result[f"extent.{name}.push_far"] = float(push[far].mean())
        result[f"extent.{name}.speed_far"] = float(np.abs(f.v[..., 2][far]).mean())
    middle = mean(ahead)
    scale = middle.std() + 1e-9
    result["extent.skewness"] = float((((middle - middle.mean()) / scale) ** 3).mean())
    flat_a = f.a[..., 2].ravel()
    result["extent.kurtosis"] = float(((flat_a - flat_a.mean()) ** 4).mean() / (flat_a.var() ** 2 + 1e-12))
    size = int(np.sqrt(f.x.shape[1]))
    grid = f.x.reshape(-1, size, size, 3)
    mirrored = grid[:, :, ::-1] * (-1, 1, 1)
    difference = (grid - mirrored) - (grid - mirrored).mean((1, 2), keepdims=True)
    for name, part in (("first", difference[:1]), ("all", difference)):
        result[f"extent.lopsided_{name}"] = float(np.log(np.sqrt((part**2).mean()) + 1e-4))
    grown = difference[-1] - difference[0]
    result["extent.lopsided_change"] = float(np.log(np.sqrt((grown**2).mean()) + 1e-4))
    x0 = f.motion.coefficients(0)
    early = max(3, round(0.12 * f.motion.fps))
    first = (x0[early] - x0[0]) / (0.5 * (early * f.motion.interval) ** 2)
    for k in (0, 1, 8):
        for c, axis in enumerate(("right", "down", "ahead")):
            result[f"early.{axis}{k}"] = float(first[k, c])
    return result


def _recording(f: Fields) -> dict[str, float]:
    """What the recording is like: noise, frame rate, size."""
    m = f.motion
    rough = np.sort(m.roughness[:16].ravel())
    return {
        "recording.noise": float(np.log(m.misfit + 1e-6)),
        "recording.roughness": float(np.log(rough.mean() + 1e-6)),
        "recording.acceleration_noise": float(np.log(m.acceleration_noise + 1e-6)),
        "recording.fps": m.fps,
        "recording.frames": float(len(m.raw)),
        "recording.width": m.width,
        "recording.ratio": m.sides[0] / m.sides[1],
        "recording.pins": float(m.pins.shape[1]),
    }
