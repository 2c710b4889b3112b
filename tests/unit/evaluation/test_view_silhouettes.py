from __future__ import annotations

import math

import pytest
import torch
import trimesh

from toile.errors import InputError
from toile.evaluation.view_silhouettes import overlap_in_views, silhouettes
from toile.geometry.camera import Camera, looking_at
from toile.rendering.warp.renderer import WarpRenderer

PLAIN = Camera(80.0, 80.0, 32.0, 32.0, 64, 64)
UP = torch.tensor([0.0, 1.0, 0.0])
CAMERAS = [
    looking_at(PLAIN, torch.tensor([2 * math.sin(a), 0.0, 2 * math.cos(a)]), torch.zeros(3), UP)
    for a in (0.0, math.pi / 2, math.pi)
]
BOX = trimesh.creation.box((0.5, 0.5, 0.5))
POSITIONS = torch.from_numpy(BOX.vertices.copy())[None]
FACES = torch.from_numpy(BOX.faces.copy())


def test_a_moved_box_overlaps_where_the_move_is_not_seen() -> None:
    renderer = WarpRenderer()
    masks = [silhouettes(renderer, camera, POSITIONS, FACES) for camera in CAMERAS]
    same = overlap_in_views(renderer, CAMERAS, masks, POSITIONS, FACES)
    assert same.all_views == same.single_view == same.reference_views == 1
    # A quarter of a metre to the side: of the front face, 22.9 px wide at 1.75 m, 11.4 px leave.
    moved = POSITIONS + torch.tensor([0.25, 0.0, 0.0])
    found = overlap_in_views(renderer, CAMERAS, masks, moved, FACES, input_view=1)
    assert found.values[0] == pytest.approx(1 / 3, abs=0.02)
    assert found.values[2] == pytest.approx(1 / 3, abs=0.02)
    # From the side it only comes nearer: the ratio of the distances of the near faces, squared.
    assert found.single_view == pytest.approx((1.5 / 1.75) ** 2, abs=0.06)
    assert found.reference_views == pytest.approx(float(found.values[[0, 2]].mean()))
    assert found.all_views == pytest.approx(float(found.values.mean()))


def test_views_that_do_not_fit_are_named() -> None:
    with pytest.raises(InputError, match="Views do not fit"):
        overlap_in_views(WarpRenderer(), CAMERAS, [torch.zeros(1, 64, 64)], POSITIONS, FACES)
