"""What between its vertices touches the body: edges of folds that stand upright on it."""

import numpy as np
import torch
import trimesh

from toile.physics.contact.body import BodyContact, ContactSettings, StepContact
from toile.physics.topology import Topology

RADIUS = 0.1
SETTINGS = ContactSettings()


def contacts(triangle: np.ndarray, mesh: trimesh.Trimesh) -> StepContact:
    """Of a cloth of one triangle (3, 3) [m] with a still body."""
    body = np.array(mesh.vertices)
    contact = BodyContact(
        Topology(3, torch.tensor([[0, 1, 2]])),
        np.full(3, 1e-4),
        np.zeros(0, np.int64),
        np.array(mesh.faces, np.int64),
        np.zeros(len(body), np.bool_),
        SETTINGS,
    )
    return contact.begin(triangle, body, body, 0.0, 1 / 120)


def test_the_edge_of_an_upright_face_is_pushed_out_of_the_body() -> None:
    low = RADIUS - 0.002
    x = np.array([[-0.04, low, 0.001], [0.04, low, 0.001], [0.0, low + 0.03, 0.001]])
    # Its ends are outside: nothing but the edge can tell.
    assert np.linalg.norm(x, axis=1).min() > RADIUS + SETTINGS.thickness
    contact = contacts(x, trimesh.creation.icosphere(4, RADIUS))
    planes, force = contact.potential.planes, -contact.gradient(x)
    deepest = int(planes.depths(x).argmax())
    assert abs(planes.depths(x)[deepest] - (0.002 + SETTINGS.body_thickness)) < 5e-4
    assert planes.normals[deepest][1] > 0.99
    assert (force[:2, 1] > 0.0).all()
    np.testing.assert_allclose(force[2], 0.0, atol=1e-12)


def test_a_face_that_hangs_beside_the_body_is_let_alone() -> None:
    """Its lower edge is below the tangent planes of what it is seen edge-on from, but outside."""
    box = trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().subdivide().subdivide().subdivide()
    beside = 0.1 + SETTINGS.thickness + 0.002
    x = np.array([[beside, 0.06, -0.03], [beside, 0.06, 0.03], [beside, 0.15, 0.0]])
    contact = contacts(x, box)
    assert len(contact.potential.planes.offsets) > 3
    assert contact.total(x, np.ones(x.shape)) == 0.0
