"""What frozen planes follow from: which places of cloth and body were paired when they were made.

Within a solve planes are numbers. They follow from where the cloth was when they were renewed and from the
body's vertices, and so do the normal forces of the friction; with the pairs given (which face, edge or corner
is nearest to which vertex) these are smooth functions, written here once more in torch. Where pairs change,
the step has no derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.geometry.mesh import vertex_normals
from toile.physics.contact.planes import Penalty

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Nearer than this a place has the normal of its face, as in the search [m].
_CLOSE = 1e-7


@dataclass(frozen=True)
class Planes:
    """ContactPlanes as tensors, with gradients.

    Attributes:
        vertices: (C, 3) int64.
        weights: (C, 3).
        normals: (C, 3).
        offsets: (C,) [m].
        stiffness: (C,) [N/m].
        normal_forces: (C,) [N].
        drags: (C, 3) [m].
    """

    vertices: Tensor
    weights: Tensor
    normals: Tensor
    offsets: Tensor
    stiffness: Tensor
    normal_forces: Tensor
    drags: Tensor


@dataclass(frozen=True)
class Rules:
    """What planes are made by; see ContactSettings and Penalty."""

    stiffness: float
    thickness: float
    body_thickness: float
    penalty: Penalty
    masses: Tensor
    body_faces: Tensor


@dataclass(frozen=True)
class ContactPairs:
    """Pairs of a cloth and a body, in the order of their planes: W vertices, E edges, M places on faces.

    Attributes:
        vertices: (W,) of the cloth, each before a place on the body.
        edges: (E, 2) of the cloth, each beside a vertex of the body and before a place on it.
        beside: (E,) that vertex.
        corners: (W + E, 3) of the body's faces that the places lie in.
        weights: (W + E, 3) places in them; zeros tell edges and corners.
        distances: (W + E,) with their signs [m].
        facing: (M,) vertices of the body.
        faces: (M, 3) corners of the cloth's faces before them.
        places: (M, 3) nearest places in them; zeros tell edges and corners.
        carried: whether they were found at the step's begin and carried along with the body to its end.
    """

    vertices: Indices
    edges: Indices
    beside: Indices
    corners: Indices
    weights: Array
    distances: Array
    facing: Indices
    faces: Indices
    places: Array
    carried: bool

    def planes(self, cloth: Tensor, body: Tensor, next_body: Tensor, rules: Rules) -> Planes:
        """The planes again, as functions of what they follow from.

        Args:
            cloth: where it was when they were made (N, 3) [m].
            body: at the step's begin (V, 3) [m].
            next_body: and at its end (V, 3) [m].
            rules: see Rules.
        """
        there = body if self.carried else next_body
        normals_there = vertex_normals(there, rules.body_faces)
        normals_after = vertex_normals(next_body, rules.body_faces) if self.carried else normals_there
        one = torch.tensor([1.0, 0.0, 0.0], dtype=cloth.dtype).expand(len(self.vertices), 3)
        along_edges = self._along_edges(cloth, there, normals_there)
        wall_vertices = torch.from_numpy(
            np.concatenate((np.repeat(self.vertices[:, None], 3, 1), self.edges[:, [0, 1, 1]]))
        )
        wall_weights = torch.cat((one, along_edges))
        points = _points(wall_weights, wall_vertices, cloth)
        corners = torch.from_numpy(self.corners)
        places = _places(points, there[corners], self.weights)
        feet = (places[..., None] * there[corners]).sum(1)
        normals, distances = self._ways(points, feet, there[corners])
        if self.carried:
            turn = _frames(next_body[corners]) @ _frames(there[corners]).transpose(1, 2)
            normals = (turn @ normals[..., None])[..., 0]
        ends = (places[..., None] * next_body[corners]).sum(1)
        drags = (places[..., None] * (next_body - body)[corners]).sum(1)
        facing, faces = torch.from_numpy(self.facing), torch.from_numpy(self.faces)
        face_weights = _places(there[facing], cloth[faces], self.places)
        away = _points(face_weights, faces, cloth) - there[facing]
        gaps = (away * normals_there[facing]).sum(1)
        after = normals_after[facing]
        vertices = torch.cat((wall_vertices, faces))
        weights = torch.cat((wall_weights, face_weights))
        thickness = torch.full_like(distances, rules.body_thickness)
        thickness[: len(self.vertices)] = rules.thickness
        stiffness = rules.stiffness * (weights * rules.masses[vertices]).sum(1)
        lacking = torch.cat((thickness - distances, rules.body_thickness - gaps))
        return Planes(
            vertices=vertices,
            weights=weights,
            normals=torch.cat((normals, after)),
            offsets=torch.cat(
                (
                    (normals * ends).sum(1) + thickness,
                    (after * next_body[facing]).sum(1) + rules.body_thickness,
                )
            ),
            stiffness=stiffness,
            normal_forces=stiffness * rules.penalty.slope_of(lacking),
            drags=torch.cat((drags, (next_body - body)[facing])),
        )

    def _along_edges(self, cloth: Tensor, body: Tensor, normals: Tensor) -> Tensor:
        """Weights (E, 3) where the edges pass the lines through their vertices of the body."""
        beside = torch.from_numpy(self.beside)
        first, second = (cloth[torch.from_numpy(self.edges[:, k])] for k in range(2))
        n, along = normals[beside], second - first
        flat = along - (along * n).sum(1, keepdim=True) * n
        share = (flat * (body[beside] - first)).sum(1) / flat.square().sum(1)
        return torch.stack((1.0 - share, share, torch.zeros_like(share)), 1)

    def _ways(self, points: Tensor, feet: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
        """Unit normals (C, 3) towards points before the body, and signed distances (C,)."""
        across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat = torch.nn.functional.normalize(across, dim=1)
        away = points - feet
        sign = torch.from_numpy(np.sign(self.distances))
        inside = torch.from_numpy((self.weights > 0.0).all(1) | (np.abs(self.distances) <= _CLOSE))
        # Where a face's normal counts the length is not asked for: at 0 it has no gradient.
        length = torch.where(inside[:, None], torch.ones_like(away), away).norm(dim=1)
        normals = torch.where(inside[:, None], flat, away * (sign / length)[:, None])
        return normals, torch.where(inside, (away * flat).sum(1), sign * length)


def contact_forces(
    planes: Planes, x: Tensor, positions: Tensor, friction: Tensor, penalty: Penalty, sticking: float
) -> Tensor:
    """Force (N, 3) [N] on the cloth at x, differentiable by all that planes and friction know.

    Args:
        planes: see Planes.
        x: x_{n+1} (N, 3) [m].
        positions: x_n (N, 3) [m].
        friction: μ ().
        penalty: φ.
        sticking: displacement below which the cloth sticks [m].
    """
    here, start = (_points(planes.weights, planes.vertices, p) for p in (x, positions))
    n = planes.normals
    pushing = planes.stiffness * penalty.slope_of(planes.offsets - (n * here).sum(1))
    moved = here - start - planes.drags
    u = moved - (moved * n).sum(1, keepdim=True) * n
    square = u.square().sum(1)
    inside = square < sticking**2
    # Beyond the other branch's values, whose gradients would be lost in 0 times infinity.
    s = torch.where(inside, torch.full_like(square, sticking), square.clamp(min=1e-30).sqrt())
    below = torch.where(square > 0.0, square, torch.ones_like(square)).sqrt() * (square > 0.0)
    by_length = torch.where(inside, (2 - below / sticking) / sticking, 1 / s)
    on_places = pushing[:, None] * n - (friction * planes.normal_forces * by_length)[:, None] * u
    out = torch.zeros_like(x)
    for corner in range(3):
        shares = planes.weights[:, corner : corner + 1] * on_places
        out = out.index_add(0, planes.vertices[:, corner], shares)
    return out


def _points(weights: Tensor, vertices: Tensor, x: Tensor) -> Tensor:
    return (weights[..., None] * x[vertices]).sum(1)


def _places(points: Tensor, corners: Tensor, weights: Array) -> Tensor:
    """Weights (C, 3) of the nearest places to points (C, 3) in triangles (C, 3, 3), each on its feature."""
    on = weights > 0.0
    found = torch.from_numpy(weights)
    inner = torch.from_numpy(np.flatnonzero(on.all(1)))
    a, b, c = corners[inner].unbind(1)
    u, v, p = b - a, c - a, points[inner] - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    pu, pv = (p * u).sum(1), (p * v).sum(1)
    scale = 1 / (uu * vv - uv * uv)
    second, third = (vv * pu - uv * pv) * scale, (uu * pv - uv * pu) * scale
    found = found.index_copy(0, inner, torch.stack((1 - second - third, second, third), 1))
    rows = np.flatnonzero(on.sum(1) == 2)
    if len(rows):
        first, last = (torch.from_numpy(k) for k in np.nonzero(on[rows])[1].reshape(-1, 2).T)
        edge = torch.from_numpy(rows)
        k = torch.arange(len(rows))
        begin, end = corners[edge][k, first], corners[edge][k, last]
        way = end - begin
        share = ((points[edge] - begin) * way).sum(1) / way.square().sum(1)
        pair = torch.zeros(len(rows), 3, dtype=points.dtype)
        pair = pair.index_put((k, first), 1 - share).index_put((k, last), share)
        found = found.index_copy(0, edge, pair)
    return found


def _frames(corners: Tensor) -> Tensor:
    """Orthonormal frames (C, 3, 3) of triangles (C, 3, 3): first edge, across it, normal, as columns."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    along = torch.nn.functional.normalize(first, dim=1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=1)
    return torch.stack((along, torch.linalg.cross(normal, along), normal), -1)
