"""Nearest points on moving triangles against exact distances."""

import igl
import numpy as np
import trimesh

from toile.geometry.moving_surface import MovingSurface


def ball(centre: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(3, 0.1)
    return np.array(mesh.vertices) + centre, np.array(mesh.faces, np.int64)


def test_signed_distances_follow_the_surface_as_it_moves() -> None:
    generator = np.random.default_rng(0)
    vertices, faces = ball((0.0, 0.0, 0.0))
    surface = MovingSurface(len(vertices), faces)
    points = 0.1 * generator.normal(size=(300, 3))
    for shift in ((0.0, 0.0, 0.0), (2.0, -1.0, 5.0)):
        moved = vertices * (1.0, 1.5, 1.0) + shift
        surface.move(moved)
        found = surface.nearest(points + shift, 1.0)
        exact, _, closest = igl.signed_distance(points + shift, moved, faces)[:3]
        assert len(found.which) == 300
        np.testing.assert_allclose(found.distances, exact, rtol=0, atol=1e-7)
        np.testing.assert_allclose(found.points, closest, rtol=0, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0)
        on = found.points + found.distances[:, None] * found.normals
        np.testing.assert_allclose(on, points + shift, rtol=0, atol=1e-12)
        corners = moved[faces[found.faces]]
        np.testing.assert_allclose((found.weights[..., None] * corners).sum(1), found.points, atol=1e-12)


def test_what_is_out_of_reach_is_not_found() -> None:
    vertices, faces = ball((0.0, 0.0, 0.0))
    surface = MovingSurface(len(vertices), faces)
    surface.move(vertices)
    found = surface.nearest(np.array([[0.2, 0.0, 0.0], [0.11, 0.0, 0.0]]), 0.05)
    assert found.which.tolist() == [1]


def test_the_other_wall_of_a_crease_is_found_and_the_far_side_of_a_plate_is_not() -> None:
    # A valley along z: the floor of y = 0 meets a wall at x = 0 that faces +x.
    vertices = np.array(
        [[0.0, 0, -1], [0, 0, 1], [1, 0, -1], [1, 0, 1], [0, 1, -1], [0, 1, 1]], dtype=np.float64
    )
    faces = np.array([[0, 1, 2], [2, 1, 3], [0, 4, 1], [1, 4, 5]])
    surface = MovingSurface(6, faces)
    surface.move(vertices)
    point = np.array([[0.015, 0.005, 0.0]])
    first = surface.nearest(point, 0.1)
    np.testing.assert_allclose(first.normals[0], [0, 1, 0], atol=1e-9)
    other = surface.other_walls(point, first.points, first.normals, 0.02, 0.5)
    np.testing.assert_allclose(other.normals[0], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(other.distances, [0.015], atol=1e-9)
    plate = trimesh.creation.box((1.0, 0.01, 1.0))
    thin = MovingSurface(len(plate.vertices), np.array(plate.faces, np.int64))
    thin.move(np.array(plate.vertices))
    above = np.array([[0.1, 0.008, 0.05]])
    first = thin.nearest(above, 0.1)
    assert not len(thin.other_walls(above, first.points, first.normals, 0.02, 0.5).which)


def test_rays_hit_what_is_before_them() -> None:
    vertices, faces = ball((1.0, 0.0, 0.0))
    surface = MovingSurface(len(vertices), faces)
    surface.move(vertices)
    starts = np.zeros((2, 3))
    hits = surface.hits(starts, np.array([[1.0, 0, 0], [-1.0, 0, 0]]), 5.0)
    assert abs(hits[0] - 0.9) < 1e-3
    assert np.isinf(hits[1])


def test_answers_do_not_depend_on_where_the_surface_was_before() -> None:
    """The tree of boxes is made once; above edges and corners it meets the faces in an order of its own."""
    vertices, faces = ball((0.0, 0.0, 0.0))
    edges = vertices[np.unique(np.sort(faces[:, [0, 1]], 1), axis=0)].mean(1)
    points = 1.1 * np.concatenate((vertices, edges))
    turned = vertices[:, [1, 2, 0]] * (3.0, 0.2, 1.0)
    for signed in (True, False):
        answers = []
        for first in (vertices, turned):
            surface = MovingSurface(len(vertices), faces)
            surface.move(first)
            surface.move(vertices)
            answers.append(surface.nearest(points, 0.1, signed=signed))
        np.testing.assert_array_equal(answers[0].faces, answers[1].faces)
        np.testing.assert_array_equal(answers[0].normals, answers[1].normals)


def test_sides_are_told_halfway_between_two_bodies() -> None:
    """Edges of both are equally near, and their normals cancel each other; inside a thin one as well."""
    apart = [trimesh.creation.box((0.02, 0.4, 0.4)) for _ in range(2)]
    for box, side in zip(apart, (-1, 1), strict=True):
        box.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, (0, 1, 0)))
        box.apply_translation((0.2 * side, 0.0, 0.0))
    both = trimesh.util.concatenate(apart)
    surface = MovingSurface(len(both.vertices), np.array(both.faces, np.int64))
    surface.move(np.array(both.vertices))
    generator = np.random.default_rng(0)
    between = np.column_stack((np.zeros(50), generator.uniform(-0.15, 0.15, 50), np.full(50, 0.1414)))
    within = np.array(apart[0].triangles_center).mean(0) + np.zeros((50, 3))
    within[:, 1] = generator.uniform(-0.15, 0.15, 50)
    expected = igl.signed_distance(
        np.concatenate((between, within)), np.array(both.vertices), np.array(both.faces, np.int64)
    )[0]
    found = surface.nearest(np.concatenate((between, within)), 1.0)
    np.testing.assert_allclose(found.distances, expected, rtol=0, atol=1e-9)
    assert np.sign(expected).tolist() == [1.0] * 50 + [-1.0] * 50
