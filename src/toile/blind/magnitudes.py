"""How large an effect is, in numbers that mean the same on both sides of a blind check.

The generators have effects in forms of their own, so most of their numbers have no counterpart in the
catalogue. These have one:

- ``frame_rate``: logarithm of true over nominal time between frames
- ``focal_error``: relative error (the out-of-family generator's two axes differ by less than 5 % of it)
- ``lens_distortion``: radial term of second order (the out-of-family generator's lens has a tangential part
beside it)
- ``mask_bias``: mean growth [px]; ``motion_blur``: exposure over the frame interval
- ``shading``: D l / (mean brightness of frame 0) across the viewing direction, for a light that stays; along
  it brightness changes in second order only
- ``gravity_tilt``: angle; ``anchor_slip``: distance once the slip is over
- ``anisotropic_stiffness``: logarithms of both ratios, of the out-of-family generator; Blender's is one of
spring lengths
- ``internal_damping``: relaxation time of bending, of the out-of-family generator, whose other times depend
on the rate

Other laws altogether, with no common number: ``air_drag`` (|v|^1.5 instead of linear and quadratic),
``gusts`` (noise and pulses instead of cosines), ``strain_stiffening`` (exponential instead of quadratic),
``nonuniform_density`` and ``nonuniform_stiffness`` (patches instead of cosines), ``rest_curvature`` (the
curvature of a band or a sheet instead of moments), ``contact`` (depth instead of stiffness). Their magnitudes
are not marked: a diagnosis does not say how far an effect moves the cloth over the whole clip.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from toile.blind.sealing import Sealed
from toile.diagnosis.record import EffectReport
from toile.effects.catalogue import CATALOGUE
from toile.geometry.mesh import grid_faces, vertex_normals


@dataclass(frozen=True)
class Comparison:
    """One number of an effect, as it is and as it was estimated.

    Attributes:
        name: of the parameter, or "|a, b|" for the length of several.
        truth: from the label.
        estimate, low, high: of the diagnosis.
        scale: prior deviation of the parameter, in which numbers of several kinds are added up.
        unit: of all of them.
    """

    name: str
    truth: float
    estimate: float
    low: float
    high: float
    scale: float
    unit: str

    @property
    def covered(self) -> bool:
        """Whether the truth lies within the interval."""
        return self.low <= self.truth <= self.high


def comparisons(effect: EffectReport, sealed: Sealed) -> tuple[Comparison, ...]:
    """All numbers of one effect that both sides have; none where the laws differ.

    Args:
        effect: the true effect as the diagnosis reports it.
        sealed: the open label.
    """
    found = tuple(_compared(effect, names, truth) for names, truth in _truths(effect.name, sealed).items())
    return tuple(c for c in found if c is not None)


def relative_error(found: tuple[Comparison, ...]) -> float:
    """Distance from estimate to truth over the length of the truth, every number in its prior deviation."""
    missed = math.sqrt(sum(((c.estimate - c.truth) / c.scale) ** 2 for c in found))
    length = math.sqrt(sum((c.truth / c.scale) ** 2 for c in found))
    return missed / length if length > 0 else math.nan


def coverage(found: tuple[Comparison, ...]) -> float:
    """Share of the numbers whose interval holds the truth; NaN for none."""
    return sum(c.covered for c in found) / len(found) if found else math.nan


def _truths(name: str, sealed: Sealed) -> dict[tuple[str, ...], float]:
    """True numbers by parameters of the catalogue; several of those stand for the length of their vector."""
    label = sealed.label
    own = label.get("parameters", {})
    if label.get("generator") == "blender":
        forms = _BLENDER.get(name, {})
    else:
        forms = _OUT_OF_FAMILY.get(name, {})
        own = {**own.get(name, {}), **label.get("comparable", {}).get(name, {})}
        if name == "shading" and "light" in own:
            own["mean"] = _mean_brightness(own, sealed)
    try:
        return {names: float(form(own)) for names, form in forms.items()}
    except KeyError:
        return {}


_Forms = Mapping[str, Mapping[tuple[str, ...], Callable[[Mapping[str, Any]], float]]]

_OUT_OF_FAMILY: _Forms = {
    "frame_rate": {("log_factor",): lambda own: math.log(own["interval_ratio"])},
    "focal_error": {("relative",): lambda own: own["ratio"] - 1},
    "lens_distortion": {("k1",): lambda own: own["k1"]},
    "mask_bias": {("growth",): lambda own: own["growth"]},
    "motion_blur": {("fraction",): lambda own: own["exposure"]},
    "gravity_tilt": {("about_x", "about_z"): lambda own: abs(own["degrees"])},
    "anchor_slip": {("x", "y", "z"): lambda own: abs(own["slip"])},
    "anisotropic_stiffness": {
        ("stretching",): lambda own: math.log(own["stretching_ratio"]),
        ("bending",): lambda own: math.log(own["bending_ratio"]),
    },
    "internal_damping": {("bending",): lambda own: own["times"][2]},
    "shading": {
        ("x",): lambda own: own["lambert"] * own["light"][0] / own["mean"],
        ("y",): lambda own: own["lambert"] * own["light"][1] / own["mean"],
    },
}
"""Labels of the package's out-of-family generator in numbers of the catalogue."""

_BLENDER: _Forms = {
    # A camera that is faster than declared leaves less time between frames.
    "frame_rate": {("log_factor",): lambda own: -math.log1p(own["error"])},
    "focal_error": {("relative",): lambda own: own["error"]},
    "lens_distortion": {("k1",): lambda own: own["k1"]},
    "mask_bias": {("growth",): lambda own: own["pixels"]},
    "motion_blur": {("fraction",): lambda own: own["shutter"]},
    "gravity_tilt": {("about_x", "about_z"): lambda own: abs(own["angle"])},
    "anchor_slip": {("x", "y", "z"): lambda own: abs(own["distance"])},
}
"""Labels of scenes from Blender in numbers of the catalogue."""


def _mean_brightness(own: Mapping[str, Any], sealed: Sealed) -> float:
    """Mean of ambient and diffuse light over the cloth in frame 0, which the camera's exposure is set by."""
    first = torch.from_numpy(sealed.vertices[0]).to(torch.float64)
    height, width, _ = first.shape
    points = first.reshape(-1, 3)
    normals = vertex_normals(points, grid_faces(height, width))
    away = (normals * points).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -normals, normals)
    light = torch.tensor(own["light"], dtype=torch.float64)
    mean = (own["ambient"] + own["lambert"] * (normals @ light).clamp(min=0)).mean()
    return max(float(mean), 0.05)


def _compared(effect: EffectReport, names: tuple[str, ...], truth: float) -> Comparison | None:
    """Estimates beside the truth; None where the diagnosis has none."""
    if any(name not in effect.parameters for name in names):
        return None
    kind = CATALOGUE[effect.name]
    scales = {parameter.name: parameter.scale for parameter in kind.PARAMETERS}
    parts = [effect.parameters[name] for name in names]
    if len(names) == 1:
        part = parts[0]
        name, scale = names[0], scales[names[0]]
        return Comparison(name, truth, part.estimate, part.low, part.high, scale, part.unit)
    # Shortest and longest vector of the box of intervals: too wide rather than too narrow.
    nearest = [0.0 if p.low <= 0 <= p.high else min(abs(p.low), abs(p.high)) for p in parts]
    farthest = [max(abs(p.low), abs(p.high)) for p in parts]
    return Comparison(
        f"|{', '.join(names)}|",
        truth,
        math.hypot(*(p.estimate for p in parts)),
        math.hypot(*nearest),
        math.hypot(*farthest),
        scales[names[0]],
        parts[0].unit,
    )
