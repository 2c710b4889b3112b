"""Contact against frozen planes, with lagged Coulomb friction, as a potential of one step.

Contact c is a point y = Σ_a w_a x_a of the cloth (a vertex, or a place on a face) before a plane with the
unit normal n, which it is to keep the thickness from. With d = offset - n·y, how much it lacks,

    U = k φ(d) + μ λ f(|u|),

φ a parabola that begins smoothly and hardens (see Penalty), λ the normal force of the solve before, u the
displacement over the step relative to the surface and along it, and f(s) = s beyond the displacement ε,
smooth below: the dissipative potential of Li, Ferguson, Schneider, Langlois, Zorin, Panozzo, Jiang and
Kaufman, Incremental Potential Contact, ACM Transactions on Graphics 39(4), 2020. A point that sticks creeps
slower than ε / h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from toile.physics.implicit.linear_solvers.pattern import BlockPattern
from toile.physics.implicit.potential import StepPotential

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
# Displacements below this share of ε have no direction.
_STILL = 1e-9


@dataclass(frozen=True)
class Places:
    """Places on the cloth, C of them.

    Attributes:
        vertices: (C, 3) between which they lie; a single one is there three times.
        weights: (C, 3); rows sum to 1.
    """

    vertices: Indices
    weights: Array

    @staticmethod
    def at(vertices: Indices) -> Places:
        """Single vertices (C,)."""
        return Places(np.repeat(vertices[:, None], 3, 1), np.tile([1.0, 0.0, 0.0], (len(vertices), 1)))

    def some(self, kept: Indices) -> Places:
        """Only those at the places ``kept``."""
        return Places(self.vertices[kept], self.weights[kept])

    def joined(self, *others: Places) -> Places:
        """With others after them."""
        every = (self, *others)
        return Places(
            np.concatenate([part.vertices for part in every]),
            np.concatenate([part.weights for part in every]),
        )

    def points(self, x: Array) -> Array:
        """Where they are, y (C, 3) [m], for vertices x (N, 3) [m]."""
        points: Array = np.einsum("ca,cak->ck", self.weights, x[self.vertices])
        return points


@dataclass(frozen=True)
class ContactPlanes(Places):
    """C contacts of a cloth of N vertices; see the module.

    Attributes:
        normals: (C, 3) n.
        offsets: (C,) [m].
        stiffness: (C,) k [N/m].
        normal_forces: (C,) λ [N].
        drags: (C, 3) how far the surface carries the point within the step [m].
        own: how many of them, the last ones, are between parts of the cloth itself.
    """

    normals: Array
    offsets: Array
    stiffness: Array
    normal_forces: Array
    drags: Array
    own: int = 0

    def with_own(self, others: ContactPlanes) -> ContactPlanes:
        """With planes between parts of the cloth itself after these."""
        return ContactPlanes(
            vertices=np.concatenate((self.vertices, others.vertices)),
            weights=np.concatenate((self.weights, others.weights)),
            normals=np.concatenate((self.normals, others.normals)),
            offsets=np.concatenate((self.offsets, others.offsets)),
            stiffness=np.concatenate((self.stiffness, others.stiffness)),
            normal_forces=np.concatenate((self.normal_forces, others.normal_forces)),
            drags=np.concatenate((self.drags, others.drags)),
            own=self.own + others.own,
        )

    def depths(self, x: Array) -> Array:
        """How much they lack, d (C,) [m]."""
        depths: Array = self.offsets - np.einsum("ck,ck->c", self.normals, self.points(x))
        return depths


class ContactPotential(StepPotential):
    """See the module.

    Args:
        planes: see ContactPlanes.
        positions: x_n (N, 3) [m], where the step begins.
        friction: μ.
        penalty: φ.
        sticking: ε [m].
    """

    def __init__(
        self, planes: ContactPlanes, positions: Array, friction: float, penalty: Penalty, sticking: float
    ) -> None:
        self.planes = planes
        self.friction = friction
        self._penalty, self._sticking = penalty, sticking
        c, n = len(planes.offsets), len(positions)
        starts = np.arange(0, 3 * c + 1, 3)
        # Of a single vertex the entries are 1, 0, 0 at the same place; they add up.
        self._weights = csr_array((planes.weights.reshape(-1), planes.vertices.reshape(-1), starts), (c, n))
        self._back = self._weights.T.tocsr()
        self._starts = planes.points(positions) + planes.drags
        self._slots: Indices | None = None

    def total(self, x: Array, free: Array) -> float:
        """See StepPotential."""
        y = self._weights @ x
        d = self._depths(y)
        total = float(self.planes.stiffness @ self._penalty.value(d))
        if self.friction > 0.0:
            s = np.sqrt(np.square(self._slides(y)).sum(1))
            total += self.friction * float(self.planes.normal_forces @ slip_potential(s, self._sticking))
        return total

    def gradient(self, x: Array) -> Array:
        """See StepPotential."""
        y = self._weights @ x
        forces = -self.normal_forces(x)[:, None] * self.planes.normals
        if self.friction > 0.0:
            u = self._slides(y)
            s = np.sqrt(np.square(u).sum(1))
            by_length, _ = slip_slopes(s, self._sticking)
            forces = forces + (self.friction * self.planes.normal_forces * by_length)[:, None] * u
        gradient: Array = self._back @ forces
        return gradient

    def normal_forces(self, x: Array) -> Array:
        """Normal forces k φ'(d) (C,) [N] of every contact at x."""
        forces: Array = self.planes.stiffness * self._penalty.slope(self.planes.depths(x))
        return forces

    def add_hessian(self, blocks: Array, pattern: BlockPattern, x: Array, *, convex: bool) -> None:
        """See StepPotential; it has no indefinite part."""
        planes = self.planes
        y = self._weights @ x
        curvature = planes.stiffness * self._penalty.curvature(self._depths(y))
        acting = curvature > 0.0
        if self.friction > 0.0:
            acting |= planes.normal_forces > 0.0
        which = np.flatnonzero(acting)
        if not len(which):
            return
        n = planes.normals[which]
        block = curvature[which, None, None] * n[:, :, None] * n[:, None, :]
        if self.friction > 0.0:
            u = self._slides(y)[which]
            s = np.sqrt(np.square(u).sum(1))
            by_length, beyond = slip_slopes(s, self._sticking)
            weight = self.friction * planes.normal_forces[which]
            tangential = np.eye(3) - n[:, :, None] * n[:, None, :]
            block += (weight * by_length)[:, None, None] * tangential
            # f'' - f'/s along the slide; never so negative that the sum is.
            along = u / np.maximum(s, _STILL * self._sticking)[:, None]
            block += (weight * beyond)[:, None, None] * along[:, :, None] * along[:, None, :]
        if self._slots is None:
            v = planes.vertices
            self._slots = np.stack([pattern.slots(v[:, a], v[:, b])[0] for a, b in _PAIRS], 1)
        slots = self._slots[which]
        w = planes.weights[which]
        products = np.stack([w[:, a] * w[:, b] for a, b in _PAIRS], 1)
        used = products != 0.0
        contact, pair = np.nonzero(used)
        add_blocks(blocks, slots[contact, pair], products[contact, pair][:, None, None] * block[contact])

    def _depths(self, y: Array) -> Array:
        depths: Array = self.planes.offsets - np.einsum("ck,ck->c", self.planes.normals, y)
        return depths

    def _slides(self, y: Array) -> Array:
        """Slides u (C, 3) [m]."""
        moved = y - self._starts
        n = self.planes.normals
        slides: Array = moved - np.einsum("ck,ck->c", moved, n)[:, None] * n
        return slides


@dataclass(frozen=True)
class Penalty:
    """φ(d) = ½ (d - w/2)² + w²/24 + ¼ d⁴/s² beyond the depth w; a cubic joins the parabola smoothly below.

    Attributes:
        smoothing: w, depth over which the force begins [m].
        hardening: s, depth where the force is twice that of the parabola [m]: a cloth under tension presses
            far harder than its weight.
    """

    smoothing: float
    hardening: float

    def value(self, d: Array) -> Array:
        """φ (C,) [m²]."""
        w = self.smoothing
        below, beyond = d.clip(0.0, w), (d - w).clip(min=0.0)
        q = np.square(d.clip(min=0.0))
        value: Array = (
            below**2 * below / (6 * w) + 0.5 * beyond * (w + beyond) + q * q / (4 * self.hardening**2)
        )
        return value

    def slope(self, d: Array) -> Array:
        """φ' (C,) [m]."""
        w = self.smoothing
        below, beyond = d.clip(0.0, w), (d - w).clip(min=0.0)
        up = d.clip(min=0.0)
        slope: Array = 0.5 * below * below / w + beyond + up * up * up / self.hardening**2
        return slope

    def slope_of(self, d: Tensor) -> Tensor:
        """φ' (C,) [m], with gradients."""
        w = self.smoothing
        return (
            0.5 * d.clamp(0.0, w).square() / w
            + (d - w).clamp(min=0.0)
            + d.clamp(min=0.0) ** 3 / self.hardening**2
        )

    def curvature(self, d: Array) -> Array:
        """φ'' (C,)."""
        up = d.clip(min=0.0)
        curvature: Array = d.clip(0.0, self.smoothing) / self.smoothing + 3 * up * up / self.hardening**2
        return curvature


def slip_potential(s: Array, limit: float) -> Array:
    """f(s): s beyond the limit, twice smooth and even below."""
    below = s.clip(max=limit)
    found: Array = below**2 / limit - below**3 / (3 * limit**2) + limit / 3 + (s - below)
    return found


def slip_slopes(s: Array, limit: float) -> tuple[Array, Array]:
    """f'(s) / s and f''(s) - f'(s) / s."""
    inside = s < limit
    safe = np.where(inside, limit, s)
    by_length = np.where(inside, (2 - s / limit) / limit, 1 / safe)
    return by_length, np.where(inside, -s / limit**2, -1 / safe)


def add_blocks(blocks: Array, slots: Indices, more: Array) -> None:
    """Add blocks (M, 3, 3) to their places, of which some appear many times."""
    order = np.argsort(slots, kind="stable")
    places, first = np.unique(slots[order], return_index=True)
    blocks[places] += np.add.reduceat(more[order], first, axis=0)
