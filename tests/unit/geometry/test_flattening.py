"""Discs, and laying them flat."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from toile.errors import InputError
from toile.geometry.flattening import flatten, stretches
from toile.geometry.io import PolygonMesh
from toile.geometry.mesh import grid_faces
from toile.geometry.surface import (
    TriangleMesh,
    at_vertices,
    border_of_disc,
    nearest_points,
    triangle_mesh,
    without_unused_vertices,
)


def grid_mesh(H: int, W: int) -> PolygonMesh:
    i, j = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    vertices = torch.stack((i, j, torch.zeros_like(i)), -1).reshape(-1, 3).double()
    return PolygonMesh(vertices, tuple(map(tuple, grid_faces(H, W).tolist())))


def with_faces(mesh: PolygonMesh, keep) -> PolygonMesh:
    return PolygonMesh(mesh.vertices, tuple(f for k, f in enumerate(mesh.polygons) if keep(k)))


def border_of(mesh: PolygonMesh) -> np.ndarray:
    return border_of_disc(triangle_mesh(mesh, "here"), "here")


def test_border_of_a_grid() -> None:
    assert len(border_of(grid_mesh(5, 4))) == 2 * (4 + 3)


def test_quads_unused_and_repeated_vertices() -> None:
    # As in STL, where every face has vertices of its own.
    corners = torch.tensor(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0]]
    )
    vertices = torch.cat((corners.double(), torch.tensor([[9.0, 9, 9]])))
    mesh = triangle_mesh(PolygonMesh(vertices, ((0, 1, 2, 3), (4, 5, 6, 7))), "here")
    assert mesh.vertices.shape == (6, 3)
    assert len(border_of_disc(mesh, "here")) == 6


@pytest.mark.parametrize(
    ("keep", "said"),
    [
        (lambda k: k not in (2 * 8 + 4, 2 * 8 + 5), "2 borders"),  # a hole
        (lambda k: not 16 <= k < 24, "more than one component"),  # a row of cells missing
        (lambda k: k not in (0, 1, 8, 9), None),  # two cells missing at the border: still a disc
    ],
)
def test_what_is_no_disc(keep, said) -> None:
    mesh = with_faces(grid_mesh(6, 5), keep)
    if said is None:
        assert len(border_of(mesh)) > 0
        return
    with pytest.raises(InputError, match=said):
        border_of(mesh)


def test_branching_and_touching_surfaces_are_no_discs() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    with pytest.raises(InputError, match="more than two triangles"):
        border_of(PolygonMesh(vertices, ((0, 1, 2), (0, 1, 3), (0, 1, 4))))
    closed = PolygonMesh(vertices[:4], ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)))
    with pytest.raises(InputError, match="no border"):
        border_of(closed)


def test_not_finite_and_empty() -> None:
    mesh = grid_mesh(3, 3)
    with pytest.raises(InputError, match="no faces"):
        triangle_mesh(PolygonMesh(mesh.vertices, ()), "here")
    mesh.vertices[4] = torch.nan
    with pytest.raises(InputError, match="1 vertices"):
        triangle_mesh(mesh, "here")


def test_developable_surface_keeps_its_lengths(curved_sheet) -> None:
    mesh = without_unused_vertices(*curved_sheet.irregular_mesh())
    border = border_of_disc(mesh, "here")
    flat = flatten(mesh, border, "here")
    # A chord of the irregular mesh is shorter than its arc; that is all the stretching there is.
    assert np.abs(stretches(mesh, flat) - 1).mean() < 0.002
    assert np.ptp(np.linalg.norm(flat - flat.mean(0), axis=1)[border]) < 0.2


def test_mirrored_and_turned_input_is_laid_flat_alike(curved_sheet) -> None:
    vertices, faces = curved_sheet.irregular_mesh(200)
    for other in (vertices * [-1, 1, 1], vertices[:, [2, 0, 1]]):
        mesh = without_unused_vertices(other, faces)
        flat = flatten(mesh, border_of_disc(mesh, "here"), "here")
        assert np.abs(stretches(mesh, flat) - 1).max() < 0.1


def test_winding_ramp_overlaps_itself() -> None:
    # A flat ring sector of 1.5 turns, lifted so that it does not touch itself in space.
    turn, across = np.meshgrid(np.linspace(0, 3 * np.pi, 90), np.linspace(0, 1, 5), indexing="ij")
    radius = 1 + across.ravel()
    t = turn.ravel()
    vertices = np.column_stack((radius * np.cos(t), radius * np.sin(t), 0.01 * t))
    mesh = TriangleMesh(vertices, grid_faces(90, 5).numpy())
    with pytest.raises(InputError, match="overlaps itself"):
        flatten(mesh, border_of_disc(mesh, "ramp"), "ramp")


def test_points_on_a_surface() -> None:
    points = np.random.default_rng(0).uniform(size=(40, 2))
    faces = Delaunay(points).simplices.astype(np.int64)
    mesh = without_unused_vertices(np.column_stack((points, points @ [2, 3])), faces)
    vertex = np.array([3, 17])
    np.testing.assert_allclose(at_vertices(mesh, vertex).of(mesh.vertices), mesh.vertices[vertex])
    inside = mesh.vertices[mesh.faces[:5]].mean(1)
    found, distance = nearest_points(inside[:, :2], mesh.vertices[:, :2].copy(), mesh.faces)
    np.testing.assert_allclose(found.of(mesh.vertices), inside, atol=1e-12)
    np.testing.assert_allclose(distance, 0, atol=1e-12)
