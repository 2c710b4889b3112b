"""The outline of frame 0 tells a wrong camera and a wrong mask apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, gaussian_filter

from toile.diagnosis.outline_cue import OutlineSettings, outline_evidence, template_outline
from toile.effects.catalogue import CATALOGUE
from toile.generation.generator import GeneratorSettings, generate
from toile.generation.textures import procedural_texture
from toile.scenes.scene import Scene

NAMES = ("focal_error", "lens_distortion", "mask_bias")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """One frame of a cloth that fills most of a 240 px image."""
    settings = GeneratorSettings(
        grid=(10, 10),
        refinement=1,
        substeps=1,
        n_frames=2,
        image_size=(240, 240),
        focal_length=330.0,
        noise=0.0,
    )
    return generate(settings, procedural_texture(200, 200, 0))[0]


def evidence(scene: Scene) -> dict[str, float]:
    outline = template_outline(scene)
    return {name: outline_evidence(CATALOGUE[name](), scene, outline).log_evidence for name in NAMES}


def test_a_right_scene_speaks_for_nothing(scene: Scene) -> None:
    assert max(evidence(scene).values()) < 0
    assert abs(float(template_outline(scene).distances.mean())) < 0.25


@pytest.mark.parametrize("pixels", [3, -3])
def test_a_grown_or_shrunken_mask(scene: Scene, pixels: int) -> None:
    change = binary_dilation if pixels > 0 else binary_erosion
    masks = torch.from_numpy(change(scene.masks[0].numpy() > 0.5, iterations=abs(pixels))).float()
    wrong = replace(scene, masks=masks[None].expand_as(scene.masks))
    found = evidence(wrong)
    assert max(found, key=lambda name: found[name]) == "mask_bias"
    assert found["mask_bias"] > 20
    fit = outline_evidence(CATALOGUE["mask_bias"](), wrong, template_outline(wrong))
    assert float(fit.mean[0]) * CATALOGUE["mask_bias"]().scales[0] == pytest.approx(pixels, abs=1)


def test_a_wrong_focal_length(scene: Scene) -> None:
    camera = replace(scene.camera, fx=scene.camera.fx / 1.06, fy=scene.camera.fy / 1.06)
    wrong = replace(scene, camera=camera)
    found = evidence(wrong)
    assert max(found, key=lambda name: found[name]) == "focal_error"
    fit = outline_evidence(CATALOGUE["focal_error"](), wrong, template_outline(wrong))
    assert float(fit.mean[0]) * CATALOGUE["focal_error"]().scales[0] == pytest.approx(0.06, abs=0.01)


def test_a_mask_far_too_wide(scene: Scene) -> None:
    """Many prior deviations away, and still neither camera nor lens."""
    masks = torch.from_numpy(binary_dilation(scene.masks[0].numpy() > 0.5, iterations=9)).float()
    found = evidence(replace(scene, masks=masks[None].expand_as(scene.masks)))
    assert max(found, key=lambda name: found[name]) == "mask_bias"


def test_a_ragged_mask_counts_by_its_mean(scene: Scene) -> None:
    """Its nearest edges are nearer than that. Pixels whose distance is up to 6 reach 5.5 beyond the edge."""
    mask = scene.masks[0].numpy() > 0.5
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(mask.shape), 3.0)
    ragged = distance_transform_edt(~mask) <= 6.0 * (1 + 0.5 * noise / noise.std())
    masks = torch.from_numpy(mask | ragged).float()
    wrong = replace(scene, masks=masks[None].expand_as(scene.masks))
    assert float(template_outline(wrong).distances.mean()) == pytest.approx(5.5, abs=0.8)
    effect = CATALOGUE["mask_bias"]()
    fit = outline_evidence(effect, wrong, template_outline(wrong))
    assert float(fit.mean[0] * effect.scales[0]) == pytest.approx(5.5, abs=0.8)


def test_a_lens_many_prior_deviations_from_none(scene: Scene) -> None:
    effect = CATALOGUE["lens_distortion"]().with_values(torch.tensor([-0.6, 0.0], dtype=torch.float64))
    axes = [torch.arange(n, dtype=torch.float64) + 0.5 for n in scene.masks[0].shape]
    rows, columns = torch.meshgrid(*axes, indexing="ij")
    seen = effect.pixels(torch.stack((columns, rows), -1).reshape(-1, 2), scene.camera)
    shape = scene.masks[0].shape
    mask = np.zeros(shape)
    at = seen[(scene.masks[0] > 0.5).reshape(-1)].floor().long().numpy()
    mask[at[:, 1].clip(0, shape[0] - 1), at[:, 0].clip(0, shape[1] - 1)] = 1
    mask = binary_erosion(binary_dilation(mask > 0.5), iterations=1)
    masks = torch.from_numpy(mask).float()
    found = evidence(replace(scene, masks=masks[None].expand_as(scene.masks)))
    assert max(found, key=lambda name: found[name]) == "lens_distortion"


def test_the_outline_is_judged_by_the_settings(scene: Scene) -> None:
    fine, coarse = (
        template_outline(scene, OutlineSettings(correlation=length, fewest=1.0)) for length in (40.0, 80.0)
    )
    assert coarse.independent == pytest.approx(0.5 * fine.independent)
    assert template_outline(scene, OutlineSettings(fewest=50.0)).independent == 50.0
    camera = replace(scene.camera, fx=scene.camera.fx / 1.06, fy=scene.camera.fy / 1.06)
    wrong = replace(scene, camera=camera)
    outline, effect = template_outline(wrong), CATALOGUE["focal_error"]()
    # Three times the prior deviation is wanted here; without the choice nothing is penalised for it.
    fits = {
        strengths: outline_evidence(effect, wrong, outline, OutlineSettings(strengths=strengths))
        for strengths in ((1.0,), (1.0, 3.0, 10.0), (3.0,))
    }
    assert fits[3.0,].log_evidence == pytest.approx(fits[1.0, 3.0, 10.0].log_evidence + np.log(3))
    assert fits[1.0,].log_evidence != fits[3.0,].log_evidence
