"""Contact of a cloth with a body of triangles whose motion is given, seen from both sides.

A vertex of the cloth keeps a thickness from the plane through the nearest point of the body, across the
direction to it. A vertex of the body keeps the nearest face of the cloth before the plane across its own
normal: with that a coarse cloth can't be cut by what lies between its vertices. Where that face is seen
edge-on, as the wall of a fold is, or ends, the plane says nothing; there its edges keep out of the body like
vertices, at their places beside the body's vertex. Planes are frozen within a solve; the first ones are those
of where the step begins, carried along with the body, so that a fast limb can't jump through the cloth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.geometry.mesh import vertex_normals
from toile.geometry.moving_surface import MovingSurface, Nearest
from toile.limits import NonNegative, Positive
from toile.physics.contact.own import OwnContact, OwnContactSettings
from toile.physics.contact.pairs import ContactPairs, Rules, contact_forces
from toile.physics.contact.planes import ContactPlanes, ContactPotential, Penalty, Places
from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.renewed import RenewedPotential
from toile.physics.topology import Topology

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Rings of inactive faces around the active ones in which nearest points are looked for as well.
_RINGS = 8
# A cloth seen edge-on from a body vertex (sine of the angle) says nothing about which side that is on.
_EDGE_ON = 0.3
# Cosine between the normals of two walls below which they make a crease.
_OTHER_WALL = 0.5
# Share of its free vertices' weights below which a place on a face cannot be moved.
_MOVABLE = 0.2
# A nearest point is on the rim of the cloth if its weight opposite to the rim's edge is below this.
_ON_RIM = 1e-4
# Share of an edge at its ends that counts as the vertex.
_AT_END = 0.02
# Edges by their corners.
_EDGES = ((1, 2), (2, 0), (0, 1))


@dataclass(frozen=True)
class ContactSettings:
    """Settings of the contact.

    Attributes:
        stiffness: force per depth and mass [1/s²]; g / k deep under its own weight.
        thickness: distance that vertices of the cloth keep from the body [m].
        body_thickness: distance that faces of the cloth keep from vertices of the body [m].
        smoothing: depth over which the force begins [m].
        hardening: depth where the force is twice that of the parabola [m].
        sticking_speed: below this speed along the body the cloth sticks [m/s].
        reach: how far from the body contacts are looked for [m].
        body_reach: how far from the cloth vertices of the body are looked for [m].
        crease_reach: how far from a vertex of the cloth a second wall of a crease is looked for [m].
    """

    stiffness: Positive = 6e5
    thickness: NonNegative = 0.003
    body_thickness: NonNegative = 0.0015
    smoothing: Positive = 5e-4
    hardening: Positive = 1e-3
    sticking_speed: Positive = 5e-3
    reach: Positive = 0.05
    body_reach: Positive = 0.02
    crease_reach: Positive = 0.02


class BodyContact:
    """Finds contacts between a cloth and a body.

    Args:
        topology: of the cloth, N vertices.
        masses: of its vertices (N,) [kg].
        held: (n,) vertices whose motion is prescribed; they collide with nothing.
        body_faces: (T, 3) of all the body.
        inactive: (V,) bool, vertices of the body whose faces collide with nothing.
        settings: see ContactSettings.
        own: contact of the cloth with itself; none if None.
    """

    def __init__(
        self,
        topology: Topology,
        masses: Array,
        held: Indices,
        body_faces: Indices,
        inactive: NDArray[np.bool_],
        settings: ContactSettings,
        own: OwnContactSettings | None = None,
    ) -> None:
        self.settings = settings
        self.penalty = Penalty(settings.smoothing, settings.hardening)
        self.masses = masses
        self.free = np.ones(topology.n_vertices, np.bool_)
        self.free[held] = False
        self.loose = np.flatnonzero(self.free)
        # Some of what is inactive stays, so that the rest has no rim where sides can't be told.
        near = ~inactive
        for _ in range(_RINGS):
            near[body_faces[near[body_faces].any(1)]] = True
        kept = body_faces[near[body_faces].all(1)]
        self.body = MovingSurface(len(inactive), kept)
        self._acting: NDArray[np.bool_] = np.logical_not(np.any(inactive[kept], axis=1))
        faces = topology.faces.numpy()
        faces = faces[self.free[faces].any(1)]
        self.cloth = MovingSurface(topology.n_vertices, faces)
        self._body_faces = torch.from_numpy(self.body.faces)
        self.active = np.unique(kept[self._acting])
        self._rim = _rims(topology.n_vertices, topology.faces.numpy(), faces)
        self._kept: tuple[Array, Array] | None = None
        self.rules = Rules(
            settings.stiffness,
            settings.thickness,
            settings.body_thickness,
            self.penalty,
            torch.from_numpy(masses),
            self._body_faces,
        )
        self.own = None if own is None else OwnContact(topology, masses, self.free, self.penalty, own)

    def begin(
        self,
        positions: Array,
        body: Array | Tensor,
        next_body: Array | Tensor,
        friction: float | Tensor,
        time_step: float,
        expected: Array | None = None,
    ) -> StepContact:
        """Contacts of a step; their forces are differentiable by what are tensors here.

        Args:
            positions: x_n (N, 3) [m].
            body: (V, 3) at the step's begin [m].
            next_body: (V, 3) at its end [m].
            friction: μ.
            time_step: h [s].
            expected: where the step may lead (N, 3) [m], for contact of the cloth with itself; x_n if None.
        """
        ends = positions if expected is None else expected
        return StepContact(self, positions, body, next_body, friction, time_step, ends)

    def normals(self, body: Array) -> Array:
        """Unit normals (V, 3) of the body."""
        if self._kept is None or self._kept[0] is not body:
            self._kept = body, vertex_normals(torch.from_numpy(body), self._body_faces).numpy()
        return self._kept[1]

    def facing(self, points: Array, normals: Array, reach: float) -> tuple[Nearest, Array]:
        """Nearest places on the cloth to points (P, 3) of the body that see it face on, and gaps (M,) [m].

        The gap lies along the point's normal and is negative where the cloth is behind it. ``cloth.move``
        goes before.
        """
        return self._facing(points, normals, self.cloth.nearest(points, reach, signed=False))[:2]

    def faces_and_edges(
        self, points: Array, normals: Array, reach: float, x: Array
    ) -> tuple[Nearest, Array, Places, Indices]:
        """See ``facing``; and places beside the points on edges of faces that are seen edge-on, or end there.

        The cloth is at x (N, 3) [m]. The last are the points that those places are beside.
        """
        found = self.cloth.nearest(points, reach, signed=False)
        some, gaps, face_on = self._facing(points, normals, found)
        across = np.flatnonzero(~face_on)
        which, faces = found.which[across], self.cloth.faces[found.faces[across]]
        places, kept = self._beside(points[which], normals[which], faces, x)
        return some, gaps, places, which[kept]

    def _facing(
        self, points: Array, normals: Array, found: Nearest
    ) -> tuple[Nearest, Array, NDArray[np.bool_]]:
        n = normals[found.which]
        aligned = np.abs(np.einsum("mk,mk->m", found.normals, n)) > _EDGE_ON
        gaps: Array = np.einsum("mk,mk->m", found.points - points[found.which], n)
        face = self.cloth.faces[found.faces]
        movable = (found.weights * self.free[face]).sum(1) > _MOVABLE
        face_on: NDArray[np.bool_] = np.logical_and(aligned, ~self._on_rim(found))
        kept = np.flatnonzero(face_on & movable)
        return found.some(kept), gaps[kept], face_on

    def _beside(self, points: Array, normals: Array, faces: Indices, x: Array) -> tuple[Places, Indices]:
        """Where the edges of faces (M, 3) pass the lines through points (M, 3) along normals, if below.

        With each the number of its point.
        """
        edges = faces[:, _EDGES].reshape(-1, 2)
        p, n = np.repeat(points, 3, 0), np.repeat(normals, 3, 0)
        first, second = (x[edges[:, k]] for k in range(2))
        along, to = second - first, p - first
        # Seen along the normal.
        flat = along - np.einsum("ek,ek->e", along, n)[:, None] * n
        length = np.square(flat).sum(1).clip(min=1e-30)
        share = (np.einsum("ek,ek->e", flat, to) / length).clip(0.0, 1.0)
        low = np.einsum("ek,ek->e", share[:, None] * along - to, n) < self.settings.body_thickness
        weights = np.column_stack((1.0 - share, share, np.zeros_like(share)))
        movable = (weights[:, :2] * self.free[edges]).sum(1) > _MOVABLE
        # At their ends the vertices take part themselves.
        kept = low & movable & (share > _AT_END) & (share < 1.0 - _AT_END)
        return Places(edges[:, [0, 1, 1]][kept], weights[kept]), np.flatnonzero(kept) // 3

    def walls(self, points: Array) -> Nearest:
        """Nearest points of the body, in a crease of its other wall as well; ``body.move`` goes before."""
        first = self.surface(points, self.settings.reach)
        close = np.flatnonzero(first.distances < self.settings.crease_reach)
        asked = first.which[close]
        other = self.body.other_walls(
            points[asked], first.points[close], first.normals[close], self.settings.crease_reach, _OTHER_WALL
        )
        return first.joined(other, asked[other.which])

    def squeezed(self, walls: Nearest) -> Indices:
        """Vertices of the cloth that have less room between two walls than two layers need."""
        rooms, counts = np.zeros(len(self.loose)), np.zeros(len(self.loose), np.int64)
        np.add.at(rooms, walls.which, walls.distances)
        np.add.at(counts, walls.which, 1)
        needed = 2 * self.settings.thickness + (0.0 if self.own is None else 2 * self.own.settings.thickness)
        return self.loose[(counts > 1) & (rooms < needed)]

    def surface(self, points: Array, reach: float) -> Nearest:
        """Nearest points (with a sign) of those whose nearest face collides; ``body.move`` goes before."""
        found = self.body.nearest(points, reach)
        return found.some(np.flatnonzero(self._acting[found.faces]))

    def _on_rim(self, found: Nearest) -> NDArray[np.bool_]:
        edges, corners = self._rim
        low = found.weights < _ON_RIM
        at_edge = np.any(low & edges[found.faces], axis=1)
        alone = found.weights > 1.0 - 2.0 * _ON_RIM
        at_corner = np.any(alone & corners[self.cloth.faces[found.faces]], axis=1)
        on_rim: NDArray[np.bool_] = np.logical_or(at_edge, at_corner)
        return on_rim


class StepContact(RenewedPotential):
    """Contacts of one step.

    Attributes:
        potential: of the planes as they are.
        pairs: what the planes follow from.
    """

    def __init__(
        self,
        contact: BodyContact,
        positions: Array,
        body: Array | Tensor,
        next_body: Array | Tensor,
        friction: float | Tensor,
        time_step: float,
        expected: Array,
    ) -> None:
        self._contact = contact
        self._x = positions
        self._given = torch.as_tensor(body), torch.as_tensor(next_body)
        self._body, self._next = (given.detach().numpy() for given in self._given)
        self._friction = torch.as_tensor(friction, dtype=torch.float64)
        self._sticking = contact.settings.sticking_speed * time_step
        self._candidates = self._near(positions)
        # The cloth is where the step begins already.
        self.potential, self.pairs = self._planes_at(positions, self._body, expected)

    def total(self, x: Array, free: Array) -> float:
        """See StepPotential."""
        return self.potential.total(x, free)

    def gradient(self, x: Array) -> Array:
        """See StepPotential."""
        return self.potential.gradient(x)

    def add_hessian(self, blocks: Array, pattern: BlockPattern, x: Array, *, convex: bool) -> None:
        """See StepPotential."""
        self.potential.add_hessian(blocks, pattern, x, convex=convex)

    @property
    def differentiable(self) -> bool:
        """See RenewedPotential: by body or μ."""
        return any(given.requires_grad for given in (*self._given, self._friction))

    def forces(self, x: Tensor, positions: Tensor, renewed: Tensor) -> Tensor:
        """See RenewedPotential; differentiable by body and μ as well.

        Raises:
            ValueError: planes between parts of the cloth itself have no gradients.
        """
        if self.potential.planes.own:
            raise ValueError("contact of a cloth with itself: expected none where gradients are asked for")
        contact = self._contact
        planes = self.pairs.planes(renewed, *self._given, contact.rules)
        return contact_forces(planes, x, positions, self._friction, contact.penalty, self._sticking)

    def pushing(self, x: Array) -> int:
        """Contacts that push."""
        return int((self.potential.normal_forces(x) > 0.0).sum())

    def outside(self, x: Array) -> Array:
        """Positions (N, 3) [m] with single vertices moved out of what they penetrate: where to begin."""
        planes = self.potential.planes
        single = planes.weights[:, 0] == 1.0
        # What is near itself has many planes at once.
        single[len(single) - planes.own :] = False
        vertex = planes.vertices[single, 0]
        moved = x.copy()
        np.add.at(moved, vertex, planes.depths(x)[single].clip(min=0.0)[:, None] * planes.normals[single])
        return moved

    def renew(self, x: Array) -> None:
        """See RenewedPotential."""
        self.potential, self.pairs = self._planes_at(x, self._next, x)

    def reachable(self, x: Array) -> Array:
        """See RenewedPotential: the cloth does not pass through itself on the way."""
        own = self._contact.own
        if own is None:
            return x
        moves = x - self._x
        shares = own.proximity.free_way(self._x, moves)
        return x if shares.min() == 1.0 else self._x + shares[:, None] * moves

    def _near(self, x: Array) -> Indices:
        """Vertices of the body that may meet the cloth within the step."""
        contact = self._contact
        reach = 2 * contact.settings.body_reach
        points = self._body[contact.active]
        within = ((points > x.min(0) - reach) & (points < x.max(0) + reach)).all(1)
        candidates = contact.active[within]
        contact.cloth.move(x)
        near = contact.cloth.nearest(self._body[candidates], reach, signed=False)
        found: Indices = candidates[near.which]
        return found

    def _planes_at(self, x: Array, body: Array, ends: Array) -> tuple[ContactPotential, ContactPairs]:
        """Planes of a cloth x (N, 3) and a body (V, 3) as they are at the begin or end, carried to the end.

        The cloth is expected to end at (N, 3) [m].
        """
        contact, settings = self._contact, self._contact.settings
        contact.cloth.move(x)
        points, here = body[self._candidates], contact.normals(body)[self._candidates]
        facing, gaps, edges, beside_of = contact.faces_and_edges(points, here, settings.body_reach, x)
        contact.body.move(body)
        vertices = contact.walls(x[contact.loose])
        beside = contact.surface(edges.points(x), settings.body_reach)
        found = vertices.joined(beside, beside.which)
        places = Places.at(contact.loose[vertices.which]).joined(
            edges.some(beside.which), Places(contact.cloth.faces[facing.faces], facing.weights)
        )
        thickness = np.repeat(
            [settings.thickness, settings.body_thickness], [len(vertices.which), len(beside.which)]
        )
        corners = contact.body.faces[found.faces]
        normals, feet = found.normals, found.points
        if body is not self._next:
            turn = _frames(self._next[corners]) @ _frames(body[corners]).transpose(0, 2, 1)
            normals = np.einsum("cij,cj->ci", turn, normals)
            feet = np.einsum("ca,cak->ck", found.weights, self._next[corners])
        drags = np.einsum("ca,cak->ck", found.weights, self._next[corners] - self._body[corners])
        own = self._candidates[facing.which]
        body_normals = contact.normals(self._next)[own]
        offsets = np.einsum("ck,ck->c", normals, feet) + thickness
        body_offsets = np.einsum("ck,ck->c", body_normals, self._next[own]) + settings.body_thickness
        stiffness = settings.stiffness * (places.weights * contact.masses[places.vertices]).sum(1)
        lacking = np.concatenate((thickness - found.distances, settings.body_thickness - gaps))
        planes = ContactPlanes(
            vertices=places.vertices,
            weights=places.weights,
            normals=np.concatenate((normals, body_normals)),
            offsets=np.concatenate((offsets, body_offsets)),
            stiffness=stiffness,
            normal_forces=stiffness * contact.penalty.slope(lacking),
            drags=np.concatenate((drags, self._next[own] - self._body[own])),
        )
        pairs = ContactPairs(
            vertices=contact.loose[vertices.which],
            edges=edges.vertices[beside.which][:, :2],
            beside=self._candidates[beside_of[beside.which]],
            corners=corners,
            weights=found.weights,
            distances=found.distances,
            facing=own,
            faces=contact.cloth.faces[facing.faces],
            places=facing.weights,
            carried=body is not self._next,
        )
        itself = contact.own
        if itself is not None:
            if body is self._body:
                itself.begin(x, contact.squeezed(vertices))
            planes = planes.with_own(itself.planes(x, ends, self._x))
        friction = float(self._friction.detach())
        return ContactPotential(planes, self._x, friction, contact.penalty, self._sticking), pairs


def _frames(corners: Array) -> Array:
    """Orthonormal frames (C, 3, 3) of triangles (C, 3, 3): first edge, across it, normal, as columns."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    along = first / np.linalg.norm(first, axis=1, keepdims=True).clip(min=1e-30)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True).clip(min=1e-30)
    return np.stack((along, np.cross(normal, along), normal), -1)


def _rims(n: int, every: Indices, faces: Indices) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether the edge opposite to each corner of faces (T, 3) is on the rim, and whether vertices (N,) are.

    Args:
        n: vertices N.
        every: faces that make the surface.
        faces: those asked for.
    """

    def keys(of: Indices) -> Indices:
        ends = np.stack([of[:, pair] for pair in _EDGES], 1)
        return ends.min(2) * n + ends.max(2)

    edges, counts = np.unique(keys(every), return_counts=True)
    alone = edges[counts == 1]
    corners = np.zeros(n, np.bool_)
    corners[alone // n] = True
    corners[alone % n] = True
    return np.isin(keys(faces), alone), corners
