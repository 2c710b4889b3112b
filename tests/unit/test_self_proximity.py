"""Pairs of a mesh that come near itself, against all pairs; a motion is stopped before anything meets."""

import numpy as np
import pytest

from toile.geometry.self_proximity import SelfProximity


def soup(n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Single triangles at random: vertices (3 n, 3), faces, edges."""
    generator = np.random.default_rng(seed)
    centres = generator.uniform(0, 0.1, (n, 1, 3))
    faces = np.arange(3 * n).reshape(n, 3)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return (centres + 0.01 * generator.normal(size=(n, 3, 3))).reshape(-1, 3), faces, edges


def sampled(x: np.ndarray, vertices: np.ndarray, first: int) -> float:
    """Distance of a pair by many places on either side: a little above the true one."""
    share = np.linspace(0, 1, 60)
    if first == 1:
        u, v = np.meshgrid(share, share)
        inside = u + v <= 1
        w = np.stack((1 - u - v, u, v), -1)[inside]
        return float(np.linalg.norm(x[vertices[0]] - w @ x[vertices[1:]], axis=1).min())
    a, b = (np.stack((1 - share, share), 1) @ x[vertices[k : k + 2]] for k in (0, 2))
    return float(np.linalg.norm(a[:, None] - b[None], axis=-1).min())


def test_near_pairs_are_all_that_are_near() -> None:
    x, faces, edges = soup(25, 0)
    proximity = SelfProximity(len(x), faces, edges, np.zeros(0, np.int64), 0.02)
    pairs = proximity.near(x, 0.01)
    found = {(int(k), *map(int, v)) for k, v in zip(pairs.first, pairs.vertices, strict=True)}
    assert len(found) == len(pairs.first)
    assert {1, 2} == set(pairs.first.tolist())
    every = [(1, i, *map(int, f)) for i in range(len(x)) for f in faces if i not in f]
    ends = [tuple(map(int, e)) for e in edges]
    every += [(2, *p, *q) for i, p in enumerate(ends) for q in ends[i + 1 :] if not set(p) & set(q)]
    for pair in every:
        distance = sampled(x, np.array(pair[1:]), pair[0])
        if distance < 0.01:
            assert pair in found
        elif pair in found:
            # What sampling finds too far by its own spacing.
            assert distance < 0.0105
    signs = np.where(np.arange(4) < pairs.first[:, None], 1.0, -1.0)
    between = np.einsum("ma,mak->mk", signs * pairs.weights, x[pairs.vertices])
    np.testing.assert_allclose(np.linalg.norm(between, axis=1), pairs.distances, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_a_motion_is_stopped_before_anything_meets(seed: int) -> None:
    x, faces, edges = soup(12, seed)
    proximity = SelfProximity(len(x), faces, edges, np.zeros(0, np.int64), 0.05)
    moves = 0.03 * np.random.default_rng(seed + 100).normal(size=x.shape)
    start = proximity.crossings(x)
    shares = proximity.free_way(x, moves)
    assert 0.0 < shares.min() < 1.0
    # What meets nothing goes farther than what would.
    assert shares.max() > 2 * shares.min()
    for part in np.linspace(0, 1, 80):
        assert proximity.crossings(x + part * shares[:, None] * moves) == start


def test_two_edges_that_cross_in_one_large_step_are_stopped() -> None:
    x = np.array([[-1.0, 0, 0], [1, 0, 0], [0, -5, 5], [0, 0.1, -1], [0, 0.1, 1], [5, 5, 0]]) * 0.05
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    edges = np.array([[0, 1], [1, 2], [0, 2], [3, 4], [4, 5], [3, 5]])
    proximity = SelfProximity(6, faces, edges, np.zeros(0, np.int64), 1.0)
    moves = np.zeros((6, 3))
    moves[3:, 1] = -0.1
    shares = proximity.free_way(x, moves)
    # They are 5 mm apart, and stop at a quarter of it.
    np.testing.assert_allclose(shares[[3, 4]], 0.75 * 0.005 / 0.1, rtol=0.02)
    away = moves.copy()
    away[3:, 1] = 0.1
    assert proximity.free_way(x, away).min() == 1.0
    # All together is no motion at all.
    assert proximity.free_way(x, np.full((6, 3), 0.4)).min() == 1.0


def test_pairs_of_held_vertices_alone_are_left_out() -> None:
    x, faces, edges = soup(25, 1)
    free = SelfProximity(len(x), faces, edges, np.zeros(0, np.int64), 0.02).near(x, 0.01)
    held = np.arange(30)
    some = SelfProximity(len(x), faces, edges, held, 0.02).near(x, 0.01)
    expected = (~np.isin(free.vertices, held).all(1)).sum()
    assert len(some.distances) == expected < len(free.distances)
