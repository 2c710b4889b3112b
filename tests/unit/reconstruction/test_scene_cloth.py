"""From a scene to its cloth."""

from __future__ import annotations

import torch

from toile.reconstruction.scene_cloth import scene_cloth, scene_units, template, uniform
from toile.scenes.scene import Scene


def test_uniform_edges_add_up_to_the_sides(tiny_scene: Scene) -> None:
    cloth = scene_cloth(tiny_scene, 0.15, uniform)
    H, W = tiny_scene.grid
    expected = [tiny_scene.cloth_size[0] / (H - 1)] * ((H - 1) * W)
    expected += [tiny_scene.cloth_size[1] / (W - 1)] * (H * (W - 1))
    torch.testing.assert_close(cloth.rest_lengths, torch.tensor(expected, dtype=torch.float64))


def test_template_edges_are_measured(tiny_scene: Scene) -> None:
    cloth = scene_cloth(tiny_scene, 0.15, template)
    first = (tiny_scene.template[1, 0] - tiny_scene.template[0, 0]).norm()
    torch.testing.assert_close(cloth.rest_lengths[0], first)


def test_mass_and_units(tiny_scene: Scene) -> None:
    cloth, units = scene_cloth(tiny_scene, 0.15, uniform), scene_units(tiny_scene, 0.15)
    torch.testing.assert_close(cloth.masses.sum().item(), 0.15 * 0.5 * 0.4)
    torch.testing.assert_close(units.mass, float(cloth.masses.max()))
    torch.testing.assert_close(units.length, (0.1 * 0.1) ** 0.5)
    assert units.time == 0.02, "the published fit's, whatever the camera did"
    assert cloth.pinned.tolist() == list(tiny_scene.pinned_vertices)
