"""Numbers of sealed labels in those of the catalogue."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from toile.blind.magnitudes import comparisons, coverage, relative_error
from toile.blind.sealing import Sealed
from toile.diagnosis.record import EffectReport, Estimate
from toile.effects.base import Parameter, Surroundings
from toile.effects.catalogue import CATALOGUE, STAGES
from toile.effects.gravity_tilt import GravityTilt
from toile.effects.lens_distortion import LensDistortion
from toile.effects.shading import Shading
from toile.generation.out_of_family.catalogue import INSIDE, out_of_family_effect
from toile.generation.out_of_family.interface import OutOfFamilyEffect, Reference
from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces, vertex_normals

GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)


def sheet() -> torch.Tensor:
    """A curved sheet (H, W, 3) before the camera, float64."""
    u, v = torch.meshgrid(*(torch.linspace(-0.3, 0.3, 6, dtype=torch.float64),) * 2, indexing="ij")
    return torch.stack((u, v, 1.5 + 0.3 * u**2 + 0.2 * v), -1)


def drawn(name: str, strength: float = 1.0) -> OutOfFamilyEffect:
    """An effect of the out-of-family generator."""
    motion = sheet().repeat(8, 1, 1, 1) + 0.01 * torch.arange(8, dtype=torch.float64)[:, None, None, None]
    reference = Reference(motion, (0.6, 0.6), GRAVITY, 25.0, (0, 30))
    effect = out_of_family_effect(name)(np.random.default_rng(2), reference).scaled(strength)
    if name == "mask_bias":
        effect.pixels_per_percent = 2.0  # type: ignore[attr-defined]
    return effect


def sealed(effect: OutOfFamilyEffect) -> Sealed:
    """A label as the package's out-of-family generator writes it, as far as magnitudes go."""
    label = {
        "generator": "toile",
        "parameters": {effect.NAME: effect.parameters()},
        "comparable": {effect.NAME: effect.comparable()},
        "magnitude": {"alone": {effect.NAME: {"value": 3.0, "measure": "motion"}}},
    }
    vertices = sheet().float().numpy()[None]
    return Sealed(label, vertices, vertices)


def of_blender(name: str, **parameters: float) -> Sealed:
    """A label of a scene from Blender."""
    label: dict[str, Any] = {"generator": "blender", "parameters": parameters, "magnitude": {"alone": {}}}
    return Sealed(label, np.zeros((1, 2, 2, 3), np.float32), np.zeros((1, 2, 2, 3), np.float32))


def report(name: str, values: dict[str, float], half: float = 1e-6):
    units = {p.name: p.unit for p in CATALOGUE[name].PARAMETERS}
    numbers = {k: Estimate(v, v - half, v + half, units[k]) for k, v in values.items()}
    return EffectReport(name, STAGES[name].value, 0.9, numbers)


def parameters_of(name: str) -> tuple[Parameter, ...]:
    return CATALOGUE[name].PARAMETERS


def test_every_name_is_a_parameter_of_the_catalogue() -> None:
    """Where labels have a number at all, an estimate of all parameters is compared with it."""
    compared = set()
    for name in INSIDE:
        estimates = dict.fromkeys((p.name for p in parameters_of(name)), 0.1)
        if comparisons(report(name, estimates), sealed(drawn(name, 0.5))):
            compared.add(name)
    assert compared == {
        "anchor_slip",
        "anisotropic_stiffness",
        "focal_error",
        "frame_rate",
        "gravity_tilt",
        "internal_damping",
        "lens_distortion",
        "mask_bias",
        "motion_blur",
        "shading",
    }


def test_labels_name_exposure_growth_and_interval_otherwise_than_the_effects() -> None:
    blur = comparisons(report("motion_blur", {"fraction": 0.55}, 0.1), sealed(drawn("motion_blur", 0.5)))
    assert relative_error(blur) == pytest.approx(0.1)
    assert coverage(blur) == 1.0
    mask = drawn("mask_bias", 1.5)
    assert abs(mask.comparable()["growth"]) == 3.0
    found = comparisons(report("mask_bias", {"growth": -mask.comparable()["growth"]}), sealed(mask))
    assert relative_error(found) == pytest.approx(2.0)  # the wrong sign is no small error
    rate = drawn("frame_rate", 2.0)
    truth = math.log(rate.frame_interval(1.0))
    found = comparisons(report("frame_rate", {"log_factor": truth}), sealed(rate))
    assert relative_error(found) == pytest.approx(0.0, abs=1e-12)
    assert abs(truth) == pytest.approx(0.06)


def test_frame_rate_of_a_camera_that_runs_fast() -> None:
    found = comparisons(report("frame_rate", {"log_factor": -0.06}), of_blender("frame_rate", error=0.06))
    assert found[0].truth == pytest.approx(-math.log(1.06))


def test_lens_moves_points_as_the_catalogue_says() -> None:
    """Without its tangential part and second order, our generator's lens is the catalogue's with that k1."""
    lens = drawn("lens_distortion", 0.7)
    lens.second, lens.tangential = 0.0, np.zeros(2)  # type: ignore[attr-defined]
    (found,) = comparisons(report("lens_distortion", {"k1": 0.0, "k2": 0.0}), sealed(lens))
    camera = Camera(300.0, 310.0, 50.0, 40.0, 100, 80)
    points = torch.tensor([[10.0, 20.0], [90.0, 70.0]], dtype=torch.float64)
    ours = LensDistortion({"k1": found.truth, "k2": 0.0}).pixels(points, camera)
    torch.testing.assert_close(ours, lens.pixels(points, camera))


def test_shading_is_lambert_to_first_order() -> None:
    """The catalogue's factor with the true numbers changes as the out-of-family generator's light does."""
    light = drawn("shading", 0.6)
    found = {c.name: c.truth for c in comparisons(report("shading", {"x": 0, "y": 0}), sealed(light))}
    assert set(found) == {"x", "y"}
    first = sheet().reshape(-1, 3)
    normals = vertex_normals(first, grid_faces(6, 6))
    normals = torch.where((normals * first).sum(-1, keepdim=True) > 0, -normals, normals)
    mean = light.brightness(normals).mean()  # type: ignore[union-attr]
    shading = Shading({**found, "z": 0.0})
    for axis in (0, 1):
        turned = normals.clone()
        turned[:, axis] += 1e-3
        true = (light.brightness(turned) - light.brightness(normals)) / mean  # type: ignore[operator]
        torch.testing.assert_close(true, shading.brightness(turned, normals) - 1, rtol=1e-6, atol=1e-9)


def test_tilt_is_the_angle_of_both_axes() -> None:
    tilt = drawn("gravity_tilt", 1.5)  # 3°
    gravity = GravityTilt({"about_x": 1.8, "about_z": -2.4})
    cloth: Any = None
    turned = (
        GRAVITY + gravity.acceleration(torch.zeros(1), Surroundings(cloth, (1, 1), GRAVITY, 25.0, 2))[0, 0]
    )
    angle = math.degrees(math.acos(float(turned @ GRAVITY) / 9.81**2))
    assert angle == pytest.approx(3.0, rel=1e-3)
    (found,) = comparisons(report("gravity_tilt", {"about_x": 1.8, "about_z": -2.4}, 0.5), sealed(tilt))
    assert found.truth == pytest.approx(3.0)
    assert found.estimate == pytest.approx(3.0)
    assert (found.low, found.high) == (
        pytest.approx(math.hypot(1.3, 1.9)),
        pytest.approx(math.hypot(2.3, 2.9)),
    )
    # A box around zero holds vectors of no length.
    (wide,) = comparisons(report("gravity_tilt", {"about_x": 0.1, "about_z": 0.2}, 1.0), sealed(tilt))
    assert wide.low == 0.0
    assert not wide.covered


def test_several_numbers_count_in_prior_deviations() -> None:
    both = drawn("anisotropic_stiffness")
    own = both.parameters()
    stretching, bending = (math.log(float(own[k])) for k in ("stretching_ratio", "bending_ratio"))  # type: ignore[arg-type]
    found = comparisons(
        report("anisotropic_stiffness", {"stretching": 0.0, "bending": bending}, 0.01), sealed(both)
    )
    assert relative_error(found) == pytest.approx(abs(stretching) / math.hypot(stretching, bending))
    assert coverage(found) == 0.5


def test_other_laws_have_no_number_in_common() -> None:
    drag = sealed(drawn("air_drag"))
    estimates = {"linear": 1.0, "normal": 1.0, "quadratic": 1.0}
    assert comparisons(report("air_drag", estimates), drag) == ()
    assert comparisons(report("air_drag", estimates), of_blender("air_drag", air_damping=0.3)) == ()
