"""Garments made for the default subject, their attachment, and garments of a user's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import roma
import torch

from toile.capture.body.subject import Subject, load_subject
from toile.capture.garments import (
    Garment,
    attached_targets,
    check_garment,
    make_dress,
    make_skirt,
)
from toile.capture.garments.own_mesh import OwnMesh
from toile.capture.garments.patterns import waist_height, with_material
from toile.capture.garments.quality import clearance, crossing_edges, triangle_quality
from toile.capture.garments.sections import length_of, outline, section_support
from toile.errors import InputError
from toile.geometry.io import write_mesh
from toile.scenes.findings import Severity


@pytest.fixture(scope="module")
def subject() -> Subject:
    return load_subject()


@pytest.fixture(scope="module")
def skirt(subject: Subject) -> Garment:
    return make_skirt(subject, vertices=960)


@pytest.fixture(scope="module")
def dress(subject: Subject) -> Garment:
    return make_dress(subject, vertices=700)


@pytest.fixture(scope="module", params=["coarse skirt", "skirt", "dress"])
def garment(request: pytest.FixtureRequest, subject: Subject) -> Garment:
    if request.param == "coarse skirt":
        return make_skirt(subject, vertices=500)
    made: Garment = request.getfixturevalue(request.param)
    return made


def test_outside_the_body_by_every_measure(garment: Garment, subject: Subject) -> None:
    measured = clearance(
        garment.rest_vertices.numpy(),
        garment.faces.numpy(),
        subject.rest_vertices.numpy(),
        subject.faces_without("arms").numpy(),
    )
    assert measured.vertices.min() >= 0.004
    assert measured.body.min() >= 0.004
    assert measured.crossings == 0
    assert check_garment(garment, subject, "garment") == []


def test_measures_see_a_garment_that_is_moved_into_the_body(skirt: Garment, subject: Subject) -> None:
    """By 5 cm to the front: the back of the skirt is inside, and the seat sticks out through its faces."""
    moved = skirt.rest_vertices.numpy() + np.array([0, 0, 0.05])
    body = subject.rest_vertices.numpy()
    measured = clearance(moved, skirt.faces.numpy(), body, subject.faces_without("arms").numpy())
    assert measured.vertices.min() < -0.02
    assert measured.body.min() < -0.02
    assert body[measured.body.argmin(), 2] < 0
    assert measured.crossings > 50


def test_a_spike_through_a_face_is_seen_though_no_vertex_is_inside() -> None:
    triangle = np.array([[-1.0, 0, -1], [1, 0, -1], [0, 0, 1]])
    spike = np.array([[0.0, -1, 0], [0.1, -1, 0], [0, 1, 0]])
    face = np.array([[0, 1, 2]])
    assert crossing_edges(spike, face, triangle, face) == 2
    assert crossing_edges(spike + np.array([0, 1.1, 0]), face, triangle, face) == 0


def test_triangles_are_near_equilateral_and_of_one_size(garment: Garment) -> None:
    quality = triangle_quality(garment.rest_vertices.numpy(), garment.faces.numpy())
    corners = garment.rest_vertices[garment.faces]
    edges = (corners.roll(1, 1) - corners).norm(dim=2)
    assert quality.min() > 0.6
    assert quality.mean() > 0.93
    assert float(edges.max() / edges.min()) < 2.5


def test_number_of_vertices_is_that_asked_for(subject: Subject) -> None:
    for wanted in (600, 2500):
        assert len(make_skirt(subject, vertices=wanted).rest_vertices) == pytest.approx(wanted, rel=0.05)


def test_a_skirt_is_one_open_tube_with_normals_outward(skirt: Garment) -> None:
    faces = skirt.faces.numpy()
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    distinct, count = np.unique(edges, axis=0, return_counts=True)
    assert len(skirt.rest_vertices) - len(distinct) + len(faces) == 0  # Euler characteristic of a tube
    assert set(count) == {1, 2}
    corners = skirt.rest_vertices[skirt.faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(1) * torch.tensor([1.0, 0, 1.0]).double()
    assert bool(((middle * normal).sum(1) > 0).all())


def test_size_follows_the_settings(subject: Subject) -> None:
    """Hem at waist − length; its circumference grows by 2π for each metre the flare adds."""
    body, faces = subject.rest_vertices.numpy(), subject.faces_without("arms").numpy()
    narrow, wide = (make_skirt(subject, vertices=2500, length=0.4, flare=flare) for flare in (0.2, 0.6))
    waist = waist_height(subject)

    def around(height: float) -> float:
        return length_of(outline(section_support(body, faces, height)))

    assert around(waist) < around(waist - 0.2)
    for made in (narrow, wide):
        assert float(made.rest_vertices[:, 1].max()) == pytest.approx(waist, abs=1e-9)
        assert float(made.rest_vertices[:, 1].min()) == pytest.approx(waist - 0.4, abs=0.01)

    def hem(made: Garment) -> float:
        low = made.rest_vertices[made.rest_vertices[:, 1] < made.rest_vertices[:, 1].min() + 1e-6]
        return float((low - low.roll(1, 0)).norm(dim=1).sum())

    # The outlines hold those above, so the narrow one also goes around the hips.
    assert hem(wide) == pytest.approx(around(waist) + 2 * np.pi * 0.25, rel=0.01)
    assert hem(wide) > hem(narrow) + 2 * np.pi * 0.4 * 0.3


def test_attachment_follows_its_face_rigidly(garment: Garment, subject: Subject) -> None:
    at_rest = attached_targets(garment, subject.rest_vertices, subject.faces)
    assert float((at_rest - garment.rest_vertices[garment.attached]).abs().max()) < 1e-12
    turn = roma.rotvec_to_rotmat(torch.tensor([0.3, -1.1, 2.0], dtype=torch.float64))
    shift = torch.tensor([0.2, 1.0, -3.0], dtype=torch.float64)
    moved = torch.stack((subject.rest_vertices, subject.rest_vertices @ turn.T + shift))
    targets = attached_targets(garment, moved, subject.faces)
    assert float((targets[0] - at_rest).abs().max()) < 1e-12
    assert float((targets[1] - (at_rest @ turn.T + shift)).abs().max()) < 1e-12


def test_what_is_attached(skirt: Garment, dress: Garment, subject: Subject) -> None:
    top = skirt.rest_vertices[:, 1].max()
    assert bool((skirt.rest_vertices[skirt.attached, 1] > top - 0.021).all())
    assert bool(torch.isin((skirt.rest_vertices[:, 1] == top).nonzero().ravel(), skirt.attached).all())
    on_shoulders = dress.rest_vertices[dress.attached]
    assert bool((on_shoulders[:, 1] > 1.4).all())
    assert float(on_shoulders[:, 0].max()) > 0.06 > -0.06 > float(on_shoulders[:, 0].min())
    for made in (skirt, dress):
        assert not bool(subject.parts["arms"][subject.faces[made.attached_faces]].any())


def test_garment_round_trip(skirt: Garment, tmp_path: Path) -> None:
    first, second = (with_material(skirt, young=800.0).save(tmp_path / name) for name in ("a.npz", "b.npz"))
    again = Garment.load(first)
    assert first.read_bytes() == second.read_bytes()
    assert again.material.young == 800.0
    assert again.name == "skirt"
    for name in ("rest_vertices", "faces", "attached", "attached_barycentric", "attached_offsets"):
        assert torch.equal(getattr(again, name), getattr(skirt, name))


def test_a_garment_of_ones_own(skirt: Garment, subject: Subject, tmp_path: Path) -> None:
    """Normals inward and centimetres in the file: fixed at the same vertices, outward, in metres."""
    file = tmp_path / "mine.obj"
    write_mesh(file, 100 * skirt.rest_vertices, skirt.faces.flip(1).tolist())
    made = OwnMesh(str(file), scale=0.01).make(subject)
    assert made.name == "mine"
    assert made.rest_vertices.allclose(skirt.rest_vertices, atol=1e-12)
    assert {tuple(sorted(f)) for f in made.faces.tolist()} == {tuple(sorted(f)) for f in skirt.faces.tolist()}
    assert set(made.attached.tolist()) == set(skirt.attached.tolist())
    assert attached_targets(made, subject.rest_vertices, subject.faces).allclose(
        made.rest_vertices[made.attached], atol=1e-12
    )
    chosen = OwnMesh(str(file), scale=0.01, attached=(3, 5)).make(subject)
    assert chosen.attached.tolist() == [3, 5]


def _findings(subject: Subject, garment: Garment) -> dict[str, str]:
    found = check_garment(garment, subject, "mine")
    return {f.what: f.got for f in found if f.severity is Severity.ERROR}


def test_what_is_wrong_is_named(skirt: Garment, subject: Subject) -> None:
    far = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cases = {
        "Garment is not manifold": replace(
            skirt, faces=torch.cat((skirt.faces, torch.tensor([[*skirt.faces[0, :2].tolist(), 500]])))
        ),
        "Garment has other units than metres": replace(skirt, rest_vertices=1000 * skirt.rest_vertices),
        "Garment intersects the body at rest": replace(skirt, rest_vertices=skirt.rest_vertices + 0.05 * far),
        "Garment is not on the body": replace(skirt, rest_vertices=skirt.rest_vertices + far),
        "Garment has degenerate triangles": replace(
            skirt,
            rest_vertices=skirt.rest_vertices.index_copy(
                0, torch.tensor([300]), skirt.rest_vertices[301:302]
            ),
        ),
        "Garment has no two sides": replace(
            skirt, faces=torch.cat((skirt.faces[:1].flip(1), skirt.faces[1:]))
        ),
    }
    for what, garment in cases.items():
        assert what in _findings(subject, garment), what
    assert "millimetres" in _findings(subject, cases["Garment has other units than metres"]).popitem()[1]
    pinched = replace(skirt, faces=torch.cat((skirt.faces, torch.tensor([[0, 500, 700]]))))
    assert "only touches itself" in _findings(subject, pinched)["Garment is not manifold"]
    loose = check_garment(
        replace(
            skirt,
            attached=skirt.attached[:0],
            attached_faces=skirt.attached_faces[:0],
            attached_barycentric=skirt.attached_barycentric[:0],
            attached_offsets=skirt.attached_offsets[:0],
        ),
        subject,
        "mine",
    )
    assert [f.what for f in loose] == ["Garment is not fixed to the body"]


def test_bad_requests_are_named(skirt: Garment, subject: Subject, tmp_path: Path) -> None:
    for says, ask in (
        ("length", lambda: make_skirt(subject, length=1.3)),
        ("resolution", lambda: make_skirt(subject, vertices=20)),
        ("wrong shape", lambda: replace(skirt, attached=skirt.attached[1:])),
        ("out of range", lambda: replace(skirt, faces=skirt.faces + 500)),
        ("missing", lambda: Garment.load(tmp_path / "none.npz")),
        ("File none.obj is missing", lambda: OwnMesh(str(tmp_path / "none.obj")).make(subject)),
        ("another subject", lambda: attached_targets(skirt, subject.rest_vertices, subject.faces[:50])),
    ):
        with pytest.raises(InputError, match=says):
            ask()
    file = tmp_path / "mine.obj"
    write_mesh(file, 1000 * skirt.rest_vertices, skirt.faces.tolist())
    with pytest.raises(InputError, match="other units") as caught:
        OwnMesh(str(file)).make(subject)
    assert caught.value.where == str(file)
    with pytest.raises(InputError, match="no such vertex"):
        OwnMesh(str(file), scale=0.001, attached=(5000,)).make(subject)
