"""The Chamfer protocol on the published scene R1: known baselines must come out first.

The data is found in ``$TOILE_DATA`` (default ``./data``): phi_sft/R1 and phi_sft/ground_truth/R1.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from toile.evaluation.chamfer import CHAMFER_SCALE, chamfer_distance
from toile.evaluation.normals import cloud_normal_error
from toile.evaluation.point_to_surface import point_to_surface
from toile.geometry.mesh import grid_faces

DATA = Path(os.environ.get("TOILE_DATA", "data")) / "phi_sft"
TEMPLATE = DATA / "R1" / "0_R1_quad.obj"
CLOUDS = DATA / "ground_truth" / "R1"
N_FRAMES = 50
FACES = grid_faces(32, 32)

pytestmark = pytest.mark.skipif(
    not (TEMPLATE.is_file() and CLOUDS.is_dir()),
    reason=f"scene R1 with ground truth not found in {DATA} (set TOILE_DATA)",
)


def template() -> Tensor:
    """Template vertices (1024, 3) [m]; the file negates x and y against the camera frame."""
    lines = [line.split()[1:4] for line in TEMPLATE.read_text().splitlines() if line.startswith("v ")]
    return torch.from_numpy(np.array(lines, dtype=np.float64) * [-1.0, -1.0, 1.0])


def cloud(frame: int) -> Tensor:
    loaded = torch.load(CLOUDS / f"point_cloud_{frame:03d}.pt", weights_only=True)
    assert isinstance(loaded, Tensor)
    return loaded


def test_template_against_its_own_frame() -> None:
    assert CHAMFER_SCALE * chamfer_distance(template(), FACES, cloud(0), seed=0) == pytest.approx(
        0.19, abs=0.01
    )
    assert 1e3 * point_to_surface(cloud(0), template(), FACES) == pytest.approx(1.9, abs=0.1)


def test_template_held_still_over_all_frames() -> None:
    vertices = template()
    values = [chamfer_distance(vertices, FACES, cloud(f), seed=f) for f in range(N_FRAMES)]
    assert 84.0 <= CHAMFER_SCALE * np.mean(values) <= 86.0


@pytest.mark.parametrize("millimetres", [5, 10, 20])
def test_a_pure_depth_offset_costs_twice_its_square(millimetres: float) -> None:
    # The cloth hangs nearly parallel to the image in frame 0, tilted by a few degrees, hence up to 10 % less.
    vertices, offset = template(), millimetres * 1e-3
    vertices[:, 2] += offset
    increase = chamfer_distance(vertices, FACES, cloud(0), seed=0) - 0.19 / CHAMFER_SCALE
    assert 0.85 <= increase / (2 * offset**2) <= 1.0


def test_normals_of_the_clouds_agree_with_the_template() -> None:
    assert cloud_normal_error(template(), FACES, cloud(0), seed=0) < 10.0
