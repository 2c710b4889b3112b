"""Final collision resolution: the garment leaves the body, and moves as little as it can.

Li et al. (3DV 2021, section 4) run a resolution step on what the networks predict and say no more about it.
Ours finds contacts as the simulation layer does, seen from both sides, and solves

    min_u  ½ uᵀ (M + ℓ² L) u   such that  n_c · (y_c + u_c) >= offset_c  for every contact c,

and u of the attached vertices such that they are where the body holds them. M are the vertices' areas, L is
the cotangent Laplacian: where nothing touches nothing moves, and what is pushed takes its neighbourhood along
instead of making a dent. Planes are found anew where the last solve has led, a few times.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import splu

from toile.capture.body.subject import Subject
from toile.capture.garments.garment import Garment, attached_targets
from toile.errors import InputError
from toile.limits import Count, NonNegative, Positive
from toile.physics.contact.body import BodyContact, ContactSettings
from toile.physics.contact.planes import ContactPlanes
from toile.physics.topology import Topology

Array = NDArray[np.float64]

# Contacts act as springs this much stiffer than what moves the garment: what is left is a ten-thousandth.
_STIFFNESS = 1e4
_ACTIVE_SETS = 12
# Planes that act a second time are kept unless they would pull by more than this [m].
_PULL = 1e-9


@dataclass(frozen=True)
class ResolutionSettings:
    """Settings of the resolution; the paper gives none.

    Attributes:
        smoothness: ℓ, how far along the cloth a push is felt [m].
        passes: times that the planes are found; none after the first where nothing is left to push.
        thickness: distance that vertices of the garment keep from the body [m].
        body_thickness: distance that faces of the garment keep from vertices of the body [m].
        reach: depth from which vertices of the garment are brought back [m].
        body_reach: depth from which vertices of the body are [m].
    """

    smoothness: NonNegative = 0.02
    passes: Count = 6
    thickness: Positive = 0.001
    body_thickness: Positive = 0.0005
    reach: Positive = 0.15
    body_reach: Positive = 0.04


@dataclass(frozen=True)
class Resolved:
    """A garment without collisions, as far as they could be resolved.

    Attributes:
        positions: (F, N, 3) [m].
        left: (F,) largest depth that contacts still have, negative where all keep their distance [m].
    """

    positions: Array
    left: Array


class CollisionResolution:
    """Resolves collisions of a garment with the body of a subject; frames are independent of each other.

    Attached vertices go where the body holds them and arms collide with nothing, as in the simulation layer.

    Args:
        garment: which.
        subject: whose body.
        settings: see ResolutionSettings.
    """

    def __init__(
        self, garment: Garment, subject: Subject, settings: ResolutionSettings | None = None
    ) -> None:
        self.settings = settings or ResolutionSettings()
        self.n_vertices, self._n_body = len(garment.rest_vertices), len(subject.rest_vertices)
        rest, faces = garment.rest_vertices.numpy(), np.ascontiguousarray(garment.faces.numpy())
        areas = np.asarray(igl.massmatrix(rest, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal())
        # A vertex that no face uses has no area, and must still have a cost.
        self._areas = np.maximum(areas, 1e-6 * areas.max())
        laplacian = -csr_array(igl.cotmatrix(rest, faces))
        cost = csr_array(diags_array(self._areas) + self.settings.smoothness**2 * laplacian)
        self._free = np.ones(self.n_vertices, np.bool_)
        self._free[garment.attached.numpy()] = False
        self._unknown = np.flatnonzero(np.repeat(self._free, 3))
        self._attached = np.flatnonzero(~np.repeat(self._free, 3))
        rows = csr_array(kron(cost, eye_array(3)))[self._unknown]
        self._cost, self._beside = rows[:, self._unknown], rows[:, self._attached]
        self._plain = splu(self._cost.tocsc())
        self._garment, self._body_faces = garment, subject.faces
        self._contact = BodyContact(
            Topology(self.n_vertices, garment.faces),
            self._areas,
            garment.attached.numpy(),
            subject.faces.numpy(),
            subject.parts["arms"].numpy(),
            ContactSettings(
                thickness=self.settings.thickness,
                body_thickness=self.settings.body_thickness,
                reach=self.settings.reach,
                body_reach=self.settings.body_reach,
            ),
        )

    def __call__(self, positions: Array, bodies: Array) -> Resolved:
        """Every frame resolved.

        Args:
            positions: garment (F, N, 3) [m].
            bodies: (F, V, 3) [m].

        Raises:
            InputError: another garment or body, other numbers of frames, or positions that are not finite.
        """
        frames = len(positions)
        for name, x, n in (("positions", positions, self.n_vertices), ("bodies", bodies, self._n_body)):
            if x.shape != (frames, n, 3) or not np.isfinite(x).all():
                raise InputError(
                    "Collisions cannot be resolved",
                    where=name,
                    expected=f"finite positions of shape {(frames, n, 3)}",
                    got=f"{tuple(x.shape)}, {int((~np.isfinite(x)).sum())} not finite",
                )
        held = attached_targets(
            self._garment, torch.from_numpy(np.asarray(bodies, np.float64)), self._body_faces
        )
        frames_of = zip(positions, bodies, held.numpy(), strict=True)
        found = [self._frame(x, body, targets) for x, body, targets in frames_of]
        return Resolved(np.stack([x for x, _ in found]), np.array([left for _, left in found]))

    def _frame(self, start: Array, body: Array, targets: Array) -> tuple[Array, float]:
        """Positions (N, 3) and the largest depth that is left."""
        begin = np.array(start, np.float64)
        moved = targets - begin[~self._free]
        x = begin + self._displacement(begin, begin, moved.reshape(-1), None)
        contact = self._contact.begin(x, body, body, 0.0, 1.0)
        for _ in range(self.settings.passes):
            contact.renew(x)
            planes = contact.potential.planes
            left = float(planes.depths(x).max(initial=-np.inf))
            # A distance is kept, so that what is a little closer is no collision.
            if left <= 0.1 * self.settings.body_thickness:
                return x, left
            x = begin + self._displacement(begin, x, moved.reshape(-1), planes)
        contact.renew(x)
        return x, float(contact.potential.planes.depths(x).max(initial=-np.inf))

    def _displacement(self, begin: Array, x: Array, held: Array, planes: ContactPlanes | None) -> Array:
        """Displacement (N, 3) [m] of ``begin`` to before all planes; first those act that x does not keep."""
        full = np.zeros(3 * self.n_vertices)
        full[self._attached] = held
        force = -(self._beside @ held)
        if planes is None:
            full[self._unknown] = self._plain.solve(force) if held.any() else 0.0
            return full.reshape(-1, 3)
        c = len(planes.offsets)
        rows = np.repeat(np.arange(c), 9)
        columns = (3 * planes.vertices[:, :, None] + np.arange(3)).reshape(-1)
        values = (planes.weights[:, :, None] * planes.normals[:, None, :]).reshape(-1)
        ahead = csr_array((values, (rows, columns)), shape=(c, 3 * self.n_vertices))
        lacking = planes.depths(begin) - ahead @ full
        ahead = ahead[:, self._unknown]
        stiffness = _STIFFNESS * planes.stiffness / self._contact.settings.stiffness
        u = (x - begin).reshape(-1)[self._unknown]
        acting = lacking - ahead @ u > 0.0
        for _ in range(_ACTIVE_SETS):
            own = ahead[acting]
            pull = own.T @ diags_array(stiffness[acting])
            u = splu((self._cost + pull @ own).tocsc()).solve(force + pull @ lacking[acting])
            now = lacking - ahead @ u > -_PULL * acting
            if np.array_equal(now, acting):
                break
            acting = now
        full[self._unknown] = u
        return full.reshape(-1, 3)


def resolve_collisions(
    garment: Garment,
    subject: Subject,
    positions: Array,
    bodies: Array | torch.Tensor,
    settings: ResolutionSettings | None = None,
) -> Array:
    """Garment (F, N, 3) [m] without collisions; see CollisionResolution."""
    return CollisionResolution(garment, subject, settings)(positions, np.asarray(bodies)).positions
