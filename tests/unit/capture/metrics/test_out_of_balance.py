"""Out-of-balance force with contact of sheets whose forces are known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from toile.capture.garments.garment import Garment, Material
from toile.capture.metrics.out_of_balance import balance_with_contact, on_cone
from toile.physics.cloth import mesh_cloth

FPS = 50.0


def flat_garment(friction: float = 0.3) -> Garment:
    """A flat square of 5 x 5 vertices, one corner fixed."""
    at = torch.linspace(-0.2, 0.2, 5, dtype=torch.float64)
    x, z = torch.meshgrid(at, at, indexing="ij")
    k = torch.arange(25).reshape(5, 5)
    a, b, c, d = (q.reshape(-1) for q in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = torch.cat((torch.stack((a, c, b), 1), torch.stack((a, d, c), 1)))
    return Garment(
        torch.stack((x.reshape(-1), torch.zeros(25, dtype=torch.float64), z.reshape(-1)), 1),
        faces,
        torch.tensor([0]),
        torch.tensor([0]),
        torch.tensor([[1.0, 0, 0]], dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
        Material(friction=friction),
    )


def measured(garment: Garment, shift: np.ndarray, height: float = 0.003, tilt: float = 0.0):
    """Balance of the sheet, shifted in each frame (F, 3), on or over a large block that leans by ``tilt``."""
    cloth = mesh_cloth(garment.rest_vertices, garment.faces, garment.material.density, (0,))
    block = trimesh.creation.box((4.0, 1.0, 4.0))
    block.apply_translation([0, -0.5, 0])
    c, s = math.cos(tilt), math.sin(tilt)
    lean = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    sheet = garment.rest_vertices.numpy() + np.array([0, height, 0])
    x = (sheet @ lean.T)[None] + shift[:, None]
    body = np.repeat((np.asarray(block.vertices) @ lean.T)[None], len(x), 0)
    return balance_with_contact(garment, cloth, x, body, np.asarray(block.faces, dtype=np.int64), FPS)


def test_at_rest_on_the_floor_contact_carries_the_weight() -> None:
    found = measured(flat_garment(), np.zeros((4, 3)))
    assert found.maximum < 1e-12
    assert found.without_contact.mean == pytest.approx(1.0)


def test_hovering_above_the_floor_misses_exactly_its_weight() -> None:
    found = measured(flat_garment(), np.zeros((4, 3)), height=0.02)
    assert found.average_weights == pytest.approx(1.0)
    weight = 0.15 * 0.4**2 * 9.81
    held = weight / 16 / 3  # of the corner with one triangle's, or two triangles', third
    assert found.average * 24 == pytest.approx(weight, abs=2.1 * held)
    assert found.mean_weight * 24 == pytest.approx(found.average * 24)


def test_free_fall_misses_nothing() -> None:
    t = np.arange(5) / FPS
    fall = np.stack((0 * t, 0.5 - 0.5 * 9.81 * t**2, 0 * t), 1)
    assert measured(flat_garment(), fall, height=0.3).maximum < 1e-10


def test_falling_slower_than_free_through_the_floor_of_a_body_is_pushed_but_never_pulled() -> None:
    t = np.arange(5) / FPS
    # Leaves the floor with twice gravity downwards: a contact would have to pull.
    found = measured(flat_garment(), np.stack((0 * t, -9.81 * t**2 * 0.5 * 2, 0 * t), 1) * 0.01, height=0.003)
    assert found.average_weights < 1e-6  # nearly at rest: the push is less than the weight but still a push
    pulled = measured(flat_garment(), np.stack((0 * t, -9.81 * t**2, 0 * t), 1), height=0.003)
    assert pulled.average_weights == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(("friction", "left"), [(0.5, 0.0), (0.1, None)])
def test_on_an_inclined_plane_friction_holds_up_to_coulombs_law(friction: float, left: float | None) -> None:
    tilt = math.radians(20)  # tan 20° = 0.364
    found = measured(flat_garment(friction), np.zeros((4, 3)), tilt=tilt)
    if left is None:
        # The distance of (cos, sin) from the cone of slope μ.
        left = (math.sin(tilt) - friction * math.cos(tilt)) / math.hypot(1, friction)
    assert found.average_weights == pytest.approx(left, abs=1e-9)


def test_projection_on_the_cone() -> None:
    n = np.array([[0.0, 1, 0]])
    assert on_cone(np.array([[0.2, 1, 0]]), n, 0.3).tolist() == [[0.2, 1, 0]]
    assert on_cone(np.array([[0.0, -1, 0]]), n, 0.3).tolist() == [[0, 0, 0]]
    # Without friction only the push is left; with μ = 1 a force along the floor is halved.
    assert on_cone(np.array([[3.0, 2, 0]]), n, 0.0) == pytest.approx(np.array([[0, 2, 0]]))
    assert on_cone(np.array([[1.0, 0, 0]]), n, 1.0) == pytest.approx(np.array([[0.5, 0.5, 0]]))
