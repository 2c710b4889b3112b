from __future__ import annotations

import math

import pytest
import torch

from toile.geometry.camera import Camera, looking_at
from toile.rendering.warp.renderer import WarpRenderer

PLAIN = Camera(100.0, 110.0, 64.0, 48.0, 96, 128)
UP = torch.tensor([0.0, 1.0, 0.0])


def rotation_about_y(degrees: float) -> torch.Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def test_a_camera_without_a_pose_projects_as_ever_bit_for_bit() -> None:
    points = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 1
    x, y, z = points.unbind(-1)
    assert torch.equal(PLAIN.project(points), torch.stack((100 * x / z + 64.0, 110 * y / z + 48.0), -1))
    assert PLAIN.from_world(points) is points


def test_a_pose_takes_the_world_to_the_camera_frame() -> None:
    camera = PLAIN.with_pose(rotation_about_y(90), torch.tensor([0.0, 0.0, 2.0]))
    # x of the world is -z of the camera frame, which begins 2 m behind the origin.
    seen = camera.from_world(torch.tensor([[0.5, 0.1, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(seen, torch.tensor([[0.0, 0.1, 1.5]], dtype=torch.float64))
    pixel = camera.project(torch.tensor([[0.5, 0.1, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(pixel, torch.tensor([[64.0, 48.0 + 11 / 1.5]], dtype=torch.float64))
    torch.testing.assert_close(camera.centre, torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64))


def test_crop_and_scale_keep_the_pose() -> None:
    camera = PLAIN.with_pose(rotation_about_y(30), torch.tensor([0.1, 0.2, 3.0]))
    point = torch.tensor([0.2, 0.3, 0.1], dtype=torch.float64)
    pixel = camera.project(point)
    torch.testing.assert_close(camera.crop(5, 7, 50, 60).project(point), pixel - torch.tensor([7.0, 5.0]))
    torch.testing.assert_close(camera.scaled(0.5).project(point), 0.5 * pixel)


def test_relative_pose_sees_the_same_from_the_others_frame() -> None:
    first = looking_at(PLAIN, torch.tensor([2.0, 1.0, 1.0]), torch.zeros(3), UP)
    second = looking_at(PLAIN, torch.tensor([-1.0, 1.5, 2.0]), torch.zeros(3), UP)
    points = torch.rand(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    relative = second.relative_to(first)
    torch.testing.assert_close(relative.project(first.from_world(points)), second.project(points))


def test_looking_at_puts_the_target_in_the_middle_and_up_on_top() -> None:
    camera = looking_at(PLAIN, torch.tensor([2.0, 1.0, -3.0]), torch.tensor([0.1, 0.9, 0.0]), UP)
    target = torch.tensor([0.1, 0.9, 0.0], dtype=torch.float64)
    torch.testing.assert_close(camera.project(target), torch.tensor([64.0, 48.0], dtype=torch.float64))
    assert camera.project(target + 0.1 * UP)[1] < 48
    assert torch.linalg.det(camera.R) == pytest.approx(1)
    torch.testing.assert_close(camera.centre, torch.tensor([2.0, 1.0, -3.0], dtype=torch.float64))


def test_the_renderer_honours_the_pose() -> None:
    generator = torch.Generator().manual_seed(1)
    vertices = torch.rand(1, 9, 3, dtype=torch.float64, generator=generator) - 0.5
    faces = torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    uv, texture = torch.rand(9, 2, generator=generator), torch.rand(8, 8, 3, generator=generator)
    camera = looking_at(PLAIN, torch.tensor([1.0, 1.0, 2.0]), torch.zeros(3), UP)
    renderer = WarpRenderer()
    posed = renderer.render(vertices, faces, uv, texture, camera)
    moved = renderer.render(camera.from_world(vertices), faces, uv, texture, camera.at_origin())
    assert posed.silhouette.sum() > 100
    assert torch.equal(posed.rgb, moved.rgb)
    assert torch.equal(posed.depth, moved.depth)
