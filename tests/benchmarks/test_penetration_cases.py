"""Whether the measures of `make capture-layer` miss a penetration: cases made by hand, each 3 mm deep."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from toile.capture.garments.garment import Garment
from toile.capture.layer.layer import SimulationLayer

Array = NDArray[np.float64]

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
DEPTH = 0.003


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """benchmarks/capture_layer.py."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import capture_layer

    yield capture_layer
    del sys.modules["capture_layer"]


def garment_of(bench: ModuleType, vertices: Array, faces: Array) -> Garment:
    """A cloth of any shape that is held nowhere."""
    return replace(
        bench.sheet(1.0, 3, 0.0, 0.0), rest_vertices=torch.from_numpy(vertices), faces=torch.from_numpy(faces)
    )


def depths(
    bench: ModuleType, body: trimesh.Trimesh, cloth: Array, faces: Array
) -> tuple[float, float, float]:
    """What the measures say."""
    layer = SimulationLayer(garment_of(bench, cloth, faces), torch.from_numpy(np.array(body.faces, np.int64)))
    return bench.penetration(layer, np.array(body.vertices), cloth)


def flat(n: int, size: float, height: float) -> tuple[Array, Array]:
    """A horizontal square of n² vertices."""
    at = np.linspace(-size / 2, size / 2, n)
    z, x = np.meshgrid(at, at, indexing="ij")
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel()
    vertices = np.stack((x, np.full_like(x, height), z), -1).reshape(-1, 3)
    return vertices, np.concatenate((np.stack((a, b, c), 1), np.stack((c, b, d), 1)))


def block(divisions: int = 0) -> trimesh.Trimesh:
    """A cube of 10 cm whose upper side is at height 0."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    for _ in range(divisions):
        box = box.subdivide()
    box.apply_translation((0.0, -0.05, 0.0))
    return box


def test_what_touches_nothing_measures_nothing(bench: ModuleType) -> None:
    cloth, faces = flat(5, 0.08, 0.003)
    assert depths(bench, block(3), cloth, faces) == (0.0, 0.0, 0.0)


def test_a_vertex_at_a_flat_place(bench: ModuleType) -> None:
    cloth, faces = flat(5, 0.08, 0.003)
    cloth[12, 1] = -DEPTH
    found = depths(bench, block(3), cloth, faces)
    assert found.vertex == pytest.approx(DEPTH, abs=1e-6)
    assert found.surface == pytest.approx(DEPTH, abs=1e-6)


@pytest.mark.parametrize("divisions", [0, 5])
def test_a_face_cut_by_an_edge_between_its_vertices(bench: ModuleType, divisions: int) -> None:
    """A sheet over the block's edge, at 45 degrees and too deep: all its vertices are outside."""
    cloth, faces = flat(2, 0.06, 0.0)
    c = np.sqrt(0.5)
    over = np.array([[c, -c, 0.0], [c, c, 0.0], [0.0, 0.0, 1.0]])
    middle = np.array([0.05, 0.0, 0.0]) - DEPTH * over[1]
    placed = cloth @ over + middle
    found = depths(bench, block(divisions), placed, faces)
    assert found.vertex == 0.0
    # Along the way to the nearest side, which leans by 45 degrees.
    assert max(found) > 0.9 * c * DEPTH
    # Where the body is coarse no vertex of it is there to see.
    assert (found.through > 0.9 * c * DEPTH) == (divisions > 0)


def test_a_vertex_in_a_wall_of_a_crease(bench: ModuleType) -> None:
    """Two blocks make a groove; a cloth that lies in it has a vertex in one wall."""
    walls = [block(4) for _ in range(2)]
    for wall, side in zip(walls, (-1, 1), strict=True):
        wall.apply_transform(trimesh.transformations.rotation_matrix(side * np.deg2rad(60), (0, 0, 1)))
        wall.apply_translation((side * 0.06, 0.0, 0.0))
    body = trimesh.util.concatenate(walls)
    inside = walls[0].triangles_center[walls[0].face_normals @ [np.cos(np.pi / 6), 0.5, 0.0] > 0.9].mean(0)
    normal = np.array([np.sin(np.deg2rad(60)), np.cos(np.deg2rad(60)), 0.0])
    cloth, faces = flat(3, 0.02, 0.0)
    cloth = cloth @ np.array([[0.0, 1.0, 0.0], normal, [0.0, 0.0, 1.0]]) + inside + 0.004 * normal
    cloth[4] = inside - DEPTH * normal
    assert max(depths(bench, body, cloth, faces)) > 0.95 * DEPTH


def test_a_fold_through_the_other_leg(bench: ModuleType) -> None:
    """Two legs 10 mm apart: a sheet between them has its lower rim in one of them."""
    legs = [trimesh.creation.cylinder(0.05, 0.4, sections=48).subdivide() for _ in range(2)]
    for leg, side in zip(legs, (-1, 1), strict=True):
        leg.apply_translation((side * 0.055, 0.0, 0.0))
    body = trimesh.util.concatenate(legs)
    cloth, faces = flat(5, 0.04, 0.0)
    between = cloth @ np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert max(depths(bench, body, between, faces)) == 0.0
    between[10:15, 0] = 0.005 + DEPTH
    assert max(depths(bench, body, between, faces)) > 0.95 * DEPTH


def test_a_cloth_folded_twice(bench: ModuleType) -> None:
    """The lowest of four layers is in the body between its vertices; the others lie above it."""
    cloth, faces = flat(4, 0.09, 0.0)
    layers = [cloth + np.array([0.0, height, 0.0]) for height in (-DEPTH, 0.001, 0.002, 0.003)]
    # Only a face of the lowest one is deep; its vertices are beside the body.
    layers[0] = layers[0] * [1.6, 1.0, 1.6]
    every = np.concatenate(layers)
    all_faces = np.concatenate([faces + k * len(cloth) for k in range(4)])
    post = trimesh.creation.box((0.02, 0.1, 0.02))
    post.apply_translation((0.0, -0.05, 0.0))
    found = depths(bench, post, every, all_faces)
    # The nearest layer is outside of the body, and hides the one below but for rays.
    assert found.vertex == 0.0
    assert found.through > 0.95 * DEPTH
    assert found.surface == pytest.approx(DEPTH, abs=1e-6)
