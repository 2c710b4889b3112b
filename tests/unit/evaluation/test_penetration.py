"""Penetration of hand-made cloths and bodies."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from toile.errors import InputError
from toile.evaluation.penetration import penetration

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
BODY, BODY_FACES = np.asarray(BALL.vertices), np.asarray(BALL.faces, dtype=np.int64)


def sheet(z: float, n: int = 9, side: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """A square sheet at a height above the centre of the ball, facing up."""
    at = np.linspace(-side / 2, side / 2, n)
    x, y = np.meshgrid(at, at, indexing="ij")
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1)))
    return np.stack((x.ravel(), y.ravel(), np.full(n * n, z)), 1), faces


def test_depths_of_vertices_within_a_ball() -> None:
    # Steps of 5 cm; within 10 cm of the axis at 6 cm height lie the middle and its four neighbours (7.8 cm
    # from the centre), the four diagonals (9.27 cm) and nothing else.
    cloth, faces = sheet(0.06)
    found = penetration(cloth[None], faces, BODY[None], BODY_FACES)
    depths = np.sort(found.depths[0])[::-1]
    assert depths[0] == pytest.approx(0.04, abs=5e-4)
    assert depths[1:5] == pytest.approx([0.1 - np.hypot(0.05, 0.06)] * 4, abs=5e-4)
    assert depths[5:9] == pytest.approx([0.1 - np.sqrt(2 * 0.05**2 + 0.06**2)] * 4, abs=5e-4)
    assert not depths[9:].any()
    assert found.share == pytest.approx(9 / 81)
    assert found.mean == pytest.approx(depths.sum() / 81)
    assert found.mean_penetrating == pytest.approx(depths.sum() / 9)
    assert found.maximum == pytest.approx(depths[0])


def test_held_vertices_are_not_measured_and_parts_that_do_not_collide_do_not_count() -> None:
    cloth, faces = sheet(0.06)
    middle = np.array([40])
    found = penetration(cloth[None], faces, BODY[None], BODY_FACES, held=middle)
    assert np.isnan(found.depths[0, 40])
    assert found.maximum == pytest.approx(0.1 - np.hypot(0.05, 0.06), abs=5e-4)
    half = BODY[:, 0] > -1e-9
    found = penetration(cloth[None], faces, BODY[None], BODY_FACES, inactive=half)
    assert set(np.sign(cloth[found.depths[0] > 0, 0])) == {-1.0}


def test_a_vertex_of_the_body_sticks_out_between_vertices_of_the_cloth() -> None:
    # One large triangle cuts off the top of the ball: none of its vertices is within.
    cloth = np.array([[-1.0, -1, 0.098], [1, -1, 0.098], [0, 1.5, 0.098]])
    found = penetration(cloth[None], np.array([[0, 1, 2]]), BODY[None], BODY_FACES)
    assert found.maximum == 0
    assert found.body_maximum == pytest.approx(BODY[:, 2].max() - 0.098, abs=1e-9)
    assert set(np.flatnonzero(found.body_depths[0])) == set(np.flatnonzero(BODY[:, 2] > 0.098))
    above = penetration(cloth[None] + [0, 0, 0.003], np.array([[0, 1, 2]]), BODY[None], BODY_FACES)
    assert above.body_maximum == 0


def test_a_body_beside_the_rim_does_not_stick_out() -> None:
    # The rim of the half sheet ends within the ball; what lies beyond it is not covered at all.
    cloth = np.array([[-1.0, -1, 0.098], [0.0, -1, 0.098], [0, 1, 0.098], [-1.0, 1, 0.098]])
    found = penetration(cloth[None], np.array([[0, 1, 2], [0, 2, 3]]), BODY[None], BODY_FACES)
    out = np.flatnonzero(found.body_depths[0])
    assert len(out)
    assert (BODY[out, 0] < 1e-9).all()


def test_every_frame_counts() -> None:
    cloth, faces = sheet(0.06)
    clips = np.stack((cloth, cloth + np.array([0, 0, 0.5])))
    found = penetration(clips, faces, np.stack((BODY, BODY)), BODY_FACES)
    assert found.share == pytest.approx(9 / 162)
    assert found.body_share == 0.5


def test_frames_that_do_not_fit_are_named() -> None:
    cloth, faces = sheet(0.06)
    with pytest.raises(InputError, match="Cannot measure the penetration"):
        penetration(np.stack((cloth, cloth)), faces, BODY[None], BODY_FACES)
    with pytest.raises(InputError, match="finite"):
        penetration(cloth[None] * np.nan, faces, BODY[None], BODY_FACES)
