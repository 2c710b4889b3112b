"""Out-of-balance force of a garment in contact: what no admissible contact can explain.

Li et al. (3DV 2021, 4.1.2) measure by how much a motion violates Newton's second law. Where the cloth touches
the body the force of contact is not known. Any force within Coulomb's cone is physical, so what counts is the
distance of the missing force from that cone: the force that is left when contact has done its best.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from torch import Tensor

from toile.capture.garments.garment import Garment
from toile.evaluation.out_of_balance import OutOfBalanceForce, out_of_balance_force
from toile.evaluation.penetration import Floats, Indices, Mask
from toile.physics.cloth import Cloth

CONTACT_PROTOCOL = (
    "out-of-balance force with contact: r = M a − F_int − M g with centred differences at the frame rate; "
    "where the cloth is within {distance} mm of the body, less the part that a contact force within "
    "Coulomb's cone could supply; free vertices, first and last frame left out"
)
TOUCHING = 0.006
"""Distance of a vertex to the body within which a contact may push it [m]: faces rest on a body, too."""
GRAVITY = (0.0, -9.81, 0.0)


@dataclass(frozen=True)
class ContactBalance:
    """Out-of-balance force with contact.

    Attributes:
        forces: what is left at each vertex, (F, N) [N]; NaN in the first and last frame and where held.
        mean_weight: mean weight of a free vertex [N].
        without_contact: the same measure without any contact force.
    """

    forces: Floats
    mean_weight: float
    without_contact: OutOfBalanceForce

    @property
    def average(self) -> float:
        """Mean over free vertices and inner frames [N]."""
        return float(np.nanmean(self.forces))

    @property
    def maximum(self) -> float:
        """Largest of all [N]."""
        return float(np.nanmax(self.forces))

    @property
    def average_weights(self) -> float:
        """Mean in weights of a vertex."""
        return self.average / self.mean_weight

    @property
    def maximum_weights(self) -> float:
        """Largest in weights of a vertex."""
        return self.maximum / self.mean_weight


@dataclass(frozen=True)
class Touching:
    """Where a body may push a garment; moves with both, so that it is found once for any translation.

    Attributes:
        contact: whether a vertex is near enough (F, N) bool; none in the first and last frame.
        normals: (F, N, 3), unit, out of the body.
    """

    contact: Mask
    normals: Floats

    @staticmethod
    def of(
        positions: Floats, body: Floats, body_faces: Indices, inactive: Mask | None, touching: float
    ) -> Touching:
        """Found by libigl; arguments as in ``balance_with_contact``."""
        passive = np.zeros(body.shape[1], np.bool_) if inactive is None else inactive
        faces = np.ascontiguousarray(body_faces[~passive[body_faces].any(1)])
        contact, normals = np.zeros(positions.shape[:2], np.bool_), np.zeros(positions.shape)
        for f in range(1, len(positions) - 1):
            distance, _, nearest, there = igl.signed_distance(
                np.ascontiguousarray(positions[f]),
                np.ascontiguousarray(body[f]),
                faces,
                igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
            )
            apart = (positions[f] - nearest) / np.where(distance == 0, 1.0, distance)[:, None]
            far = np.abs(distance) > 1e-9
            normals[f] = np.where(far[:, None], apart, there)
            contact[f] = distance < touching
        return Touching(contact, normals)


def balance_with_contact(
    garment: Garment,
    cloth: Cloth,
    positions: Floats,
    body: Floats,
    body_faces: Indices,
    fps: float,
    *,
    inactive: Mask | None = None,
    touching: float | Touching = TOUCHING,
) -> ContactBalance:
    """Out-of-balance force of a garment's motion on a moving body.

    Args:
        garment: its material and what is attached.
        cloth: its elements and masses, e.g. ``SimulationLayer(...).cloth``.
        positions: (F, N, 3) [m], F at least 3.
        body: (F, V, 3) [m].
        body_faces: (T, 3), a closed surface.
        fps: frames per second.
        inactive: (V,) vertices of the body that push nothing.
        touching: see TOUCHING; or where that is, if it is known.

    Raises:
        InputError: shapes that do not fit, or fewer than three frames.
    """
    material = garment.material
    values = cloth.material(young=material.young, poisson=material.poisson, bending=material.bending).values[
        0
    ]
    coefficients = cloth.energies.coefficients(values)
    gravity = torch.tensor(GRAVITY, dtype=torch.float64)

    def internal(x: Tensor) -> Tensor:
        flat = x[:, :, 0].clone().requires_grad_(True)
        forces = [
            -torch.autograd.grad(cloth.energies.energy(frame, coefficients), frame, retain_graph=True)[0]
            for frame in flat.unbind(0)
        ]
        return torch.stack(forces)[:, :, None]

    x = torch.from_numpy(np.ascontiguousarray(positions, np.float64))
    plain = out_of_balance_force(
        x[:, :, None],
        masses=cloth.masses[:, None],
        internal_forces=internal,
        external_forces=(cloth.masses[:, None] * gravity)[:, None],
        frame_time=1.0 / fps,
        gravity=gravity,
        pinned_vertices=tuple(garment.attached.tolist()),
    )
    left = np.full(positions.shape[:2], np.nan)
    free = np.ones(positions.shape[1], np.bool_)
    free[garment.attached.numpy()] = False
    where = touching
    if not isinstance(where, Touching):
        where = Touching.of(positions, body, body_faces, inactive, where)
    for f in range(1, len(positions) - 1):
        r = plain.residual[f - 1, :, 0].numpy()
        remaining = np.where(
            where.contact[f, :, None], r - on_cone(r, where.normals[f], material.friction), r
        )
        left[f] = np.where(free, np.linalg.norm(remaining, axis=1), np.nan)
    return ContactBalance(left, plain.mean_weight, plain)


def on_cone(force: Floats, normal: Floats, friction: float) -> Floats:
    """Nearest forces within Coulomb's cone.

    Args:
        force: (N, 3).
        normal: (N, 3), unit, out of the body.
        friction: μ; tangential up to μ times the push.

    Returns:
        (N, 3), the projections on {f: |f - (f·n) n| <= μ f·n}.
    """
    push = np.einsum("nk,nk->n", force, normal)
    along = force - push[:, None] * normal
    length = np.linalg.norm(along, axis=1)
    inside = length <= friction * push
    nearest_push = (push + friction * length) / (1 + friction**2)
    beyond = nearest_push <= 0
    direction = along / np.where(length > 0, length, 1.0)[:, None]
    on_side = nearest_push[:, None] * (normal + friction * direction)
    projected: Floats = np.where(inside[:, None], force, np.where(beyond[:, None], 0.0, on_side))
    return projected
