"""Contact of a cloth with itself, as planes between what comes near.

Of every pair of a vertex and a face, or of two edges, that is nearer than twice the thickness, both sides
keep half the thickness from a plane midway between their nearest places, across the way between them. Planes
are frozen within a solve and renewed in between, like those with a body; so pairs couple no vertices that the
cloth does not couple already, and the linear solver stays as it is. Where passes come to rest the plane is
midway again, and the forces on both sides are equal and opposite. What planes let pass, continuous detection
stops on its way from where the step began, vertex by vertex (``SelfProximity.free_way``).

Between two walls of a body that leave no room for two layers nothing could keep both out of the body and
apart; there the body counts, and layers may pass. What has passed is let go until it is free again: detection
would hold it where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.geometry.self_proximity import SelfProximity
from toile.limits import Positive
from toile.physics.contact.planes import ContactPlanes, Penalty, Places
from toile.physics.topology import Topology

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Pairs up to this multiple of the thickness have a plane.
_WITHIN = 2.0
# Pairs up to this multiple of the reach are listed: the list is good for a while.
_WATCHED = 1.5
# A pair nearer than this has no direction [m].
_TOUCHING = 1e-9


@dataclass(frozen=True)
class OwnContactSettings:
    """Settings of the contact of a cloth with itself.

    Attributes:
        thickness: distance that layers keep from each other [m].
        stiffness: force per depth and mass [1/s²].
        reach: how far apart what meets within a step may be [m].
    """

    thickness: Positive = 0.002
    stiffness: Positive = 6e5
    reach: Positive = 0.015


class OwnContact:
    """Finds contacts of a cloth with itself.

    Args:
        topology: of the cloth, N vertices.
        masses: of its vertices (N,) [kg].
        free: (N,) bool; the others' motion is given.
        penalty: φ of the planes.
        settings: see OwnContactSettings.

    Attributes:
        proximity: what is near.
    """

    def __init__(
        self,
        topology: Topology,
        masses: Array,
        free: NDArray[np.bool_],
        penalty: Penalty,
        settings: OwnContactSettings,
    ) -> None:
        self.settings, self._penalty = settings, penalty
        self._masses, self._free = masses, free
        self.proximity = SelfProximity(
            topology.n_vertices,
            topology.faces.numpy(),
            topology.edges.numpy(),
            np.flatnonzero(~free),
            _WATCHED * settings.reach,
        )

    def begin(self, x: Array, squeezed: Indices) -> None:
        """Begin a step at x (N, 3) [m], in which some vertices and what goes through itself may pass."""
        passing = self.proximity.crossing_vertices(x)
        passing[squeezed] = True
        self.proximity.passing[:] = passing

    def planes(self, x: Array, ends: Array, starts: Array) -> ContactPlanes:
        """Planes between what is near at x.

        Args:
            x: (N, 3) [m].
            ends: (N, 3) [m], where the step is expected to end; the planes lie midway there.
            starts: (N, 3) [m], where it begins.
        """
        settings = self.settings
        pairs = self.proximity.near(x, settings.reach)
        # Those that are near, or would be where the step ends.
        signs = np.where(np.arange(4) < pairs.first[:, None], pairs.weights, -pairs.weights)
        between, apart = (np.einsum("pa,pak->pk", signs, p[pairs.vertices]) for p in (x, ends))
        ahead = np.einsum("pk,pk->p", between, apart) / pairs.distances.clip(min=_TOUCHING)
        pairs = pairs.some(np.minimum(ahead, pairs.distances) < _WITHIN * settings.thickness)
        of_face = pairs.first == 1
        zero = np.zeros_like(pairs.distances)
        v, w = pairs.vertices, pairs.weights
        one = Places(
            np.where(of_face[:, None], v[:, [0, 0, 0]], v[:, [0, 1, 1]]),
            np.column_stack((w[:, 0], np.where(of_face, 0.0, w[:, 1]), zero)),
        )
        other = Places(
            np.where(of_face[:, None], v[:, [1, 2, 3]], v[:, [2, 3, 3]]),
            np.where(of_face[:, None], w[:, [1, 2, 3]], np.column_stack((w[:, 2], w[:, 3], zero))),
        )
        normals = (one.points(x) - other.points(x)) / pairs.distances.clip(min=_TOUCHING)[:, None]
        at_ends = one.points(ends), other.points(ends)
        middle = 0.5 * np.einsum("pk,pk->p", normals, at_ends[0] + at_ends[1])
        drags = at_ends[1] - other.points(starts), at_ends[0] - one.points(starts)
        masses = [(side.weights * self._masses[side.vertices]).sum(1) for side in (one, other)]
        # The same for both sides, so that the forces are.
        stiffness = settings.stiffness * 0.5 * (masses[0] + masses[1])
        pushing = stiffness * self._penalty.slope(0.5 * (settings.thickness - pairs.distances))
        places = one.joined(other)
        movable = (places.weights * self._free[places.vertices]).sum(1) > 0.0
        kept = np.flatnonzero(movable & np.tile(pairs.distances > _TOUCHING, 2))
        half = 0.5 * settings.thickness
        return ContactPlanes(
            vertices=places.vertices[kept],
            weights=places.weights[kept],
            normals=np.concatenate((normals, -normals))[kept],
            offsets=np.concatenate((middle + half, half - middle))[kept],
            stiffness=np.tile(stiffness, 2)[kept],
            normal_forces=np.tile(pushing, 2)[kept],
            drags=np.concatenate(drags)[kept],
            own=len(kept),
        )
