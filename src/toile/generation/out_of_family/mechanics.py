"""Mechanical effects with a namesake in the catalogue, in other functional forms."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toile.effects.base import Stage
from toile.generation.out_of_family.interface import (
    OutOfFamilyEffect,
    Rng,
    places_of,
)
from toile.geometry.horizontal import horizontal_axes
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class MixedDrag(OutOfFamilyEffect):
    """Drag that grows with |v|^1.5, mostly across the surface: -c |v|^½ (n (n·v) + r (v - n (n·v)))."""

    NAME = "air_drag"
    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw the share along the surface."""
        self.tangential = float(rng.uniform(0.1, 0.4))

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        v, n = now.velocities, now.normals
        across = (v * n).sum(-1, keepdim=True) * n
        speed = v.norm(dim=-1, keepdim=True)
        # A drag of more than half of the velocity within a step would be a mistake of the step.
        rate = (3.0 * self.strength * speed.sqrt()).clamp(max=0.5 / now.time_step)
        return -rate * (across + self.tangential * (v - across))

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"coefficient": 3.0 * self.strength, "power": 1.5, "tangential_share": self.tangential}


class ThinningDamping(OutOfFamilyEffect):
    """Kelvin-Voigt damping with one time per kind of element; it thins as the rate grows.

    Implicit: a damped spring of rest length L and relaxation time τ is over one step a stiffer spring,
    k (1 + τ/h), whose rest length lies between L and the length that it had. For straight angles the second
    part is a linear force that keeps the amount of bending and turns with the cloth.
    """

    NAME = "internal_damping"
    STAGE = Stage.MECHANICS
    LIMIT = 25.0

    def draw(self, rng: Rng) -> None:
        """Draw the ratios of the relaxation times and the rate at which they halve."""
        self.times = 0.01 * np.array([rng.uniform(0.1, 0.6), rng.uniform(0.5, 1.5), rng.uniform(1.0, 3.0)])
        self.half_rate = float(rng.uniform(3.0, 10.0))  # 1/s

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        x, h = now.positions, now.time_step
        before = x - h * now.velocities
        tau = self.strength * torch.from_numpy(self.times)
        edges = _stencil(now, "stretching")

        def share(index: int, rate: Tensor) -> Tensor:
            return tau[index] / h / (1 + rate.abs() / self.half_rate)

        lengths = _lengths(x, edges)
        a = share(0, (lengths - _lengths(before, edges)) / (h * elements.rest["stretching"]))
        shears = _shear_measure(now, x)
        b = share(1, _shear_angle(now, shears - _shear_measure(now, before)) / h)
        between = (elements.rest["shearing"] + b * shears) / (1 + b)
        shearing = 1 + b
        if _has_diagonals(now):
            # A diagonal counts by its strain, so by its own rest length.
            shearing = shearing * (between / elements.rest["shearing"]).square()
        return elements.scaled(
            stretching=1 + a, shearing=shearing, bending=(1 + float(tau[2]) / h)
        ).with_rest(stretching=(elements.rest["stretching"] + a * lengths) / (1 + a), shearing=between)

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        straights = _stencil(now, "bending")
        target = _bends(now.positions - now.time_step * now.velocities, straights).norm(dim=-1)
        towards = torch.nn.functional.normalize(_bends(now.positions, straights), dim=-1)
        tau = self.strength * float(self.times[2])
        moment = now.material["bending"] * tau / now.time_step * target
        return bending_force(now, moment[:, None] * towards) / now.cloth.masses[:, None]

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"times": (self.strength * self.times).tolist(), "half_rate": self.half_rate}


class TwoRatioAnisotropy(OutOfFamilyEffect):
    """One direction stiffer than the other, by different ratios in stretching and bending."""

    NAME = "anisotropic_stiffness"
    STAGE = Stage.MECHANICS
    LIMIT = 3.5

    def draw(self, rng: Rng) -> None:
        """Draw the direction and the two exponents."""
        self.sign = float(rng.choice((-1.0, 1.0)))
        self.exponents = rng.uniform(0.3, 0.7), rng.uniform(0.8, 1.4)

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        assert now.cloth.grid is not None
        W = now.cloth.grid[1]
        edges, straights = _stencil(now, "stretching"), _stencil(now, "bending")
        along_edge = ((edges[:, 1] - edges[:, 0]) == W).double() * 2 - 1
        along_straight = ((straights[:, 1] - straights[:, 0]) == W).double() * 2 - 1
        a, b = (0.5 * self.sign * self.strength * e for e in self.exponents)
        return elements.scaled(stretching=torch.exp(a * along_edge), bending=torch.exp(b * along_straight))

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        a, b = (math.exp(self.sign * self.strength * e) for e in self.exponents)
        return {"stretching_ratio": a, "bending_ratio": b}


class ExponentialStiffening(OutOfFamilyEffect):
    """Stiffness that grows exponentially with stretch and shear (in tension and in either sense)."""

    NAME = "strain_stiffening"
    STAGE = Stage.MECHANICS
    LIMIT = 6.0

    def draw(self, rng: Rng) -> None:
        """Draw the two growth rates."""
        self.rates = float(rng.uniform(20, 60)), float(rng.uniform(4, 10))

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        strain, shear = strains(now)
        a, b = (self.strength * r for r in self.rates)
        return elements.scaled(
            stretching=torch.exp((a * strain).clamp(max=3)), shearing=torch.exp((b * shear).clamp(max=4))
        )

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        a, b = (self.strength * r for r in self.rates)
        return {"stretch_rate": a, "shear_rate": b}


class CurvedBand(OutOfFamilyEffect):
    """A band across the cloth that is curved at rest, towards one side."""

    NAME = "rest_curvature"
    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw the band's direction, place, width and side."""
        self.axis = int(rng.integers(2))
        self.centre, self.width = float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.12, 0.3))
        self.curvature = 6.0 * float(rng.choice((-1.0, 1.0)))  # 1/m

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        assert now.cloth.grid is not None
        W = now.cloth.grid[1]
        straights = _stencil(now, "bending")
        across = ((straights[:, 1] - straights[:, 0]) == W) == (self.axis == 0)
        inside = self.where(places_of(now))[straights[:, 1]] & across
        spacing = (now.positions[straights[:, 2]] - now.positions[straights[:, 1]]).norm(dim=-1)
        moment = now.material["bending"] * self.strength * self.curvature * spacing * inside
        normals = now.normals[straights[:, 1]]
        return bending_force(now, moment[:, None] * normals) / now.cloth.masses[:, None]

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "curvature": self.strength * self.curvature,
            "axis": self.axis,
            "centre": self.centre,
            "width": self.width,
        }

    def where(self, places: Tensor) -> Tensor:
        """See RealityEffect."""
        return (places[:, self.axis] - self.centre).abs() <= 0.5 * self.width


class _Blobs(OutOfFamilyEffect):
    """Two or three round patches in which something differs."""

    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw the patches."""
        n = int(rng.integers(2, 4))
        self.centres = torch.from_numpy(rng.uniform((0.1, 0.25), (0.9, 0.95), (n, 2)))
        self.radii = torch.from_numpy(rng.uniform(0.12, 0.25, n))
        self.weights = torch.from_numpy(rng.uniform(0.6, 1.0, n))

    def field(self, places: Tensor) -> Tensor:
        """Patches (N,), 0 outside and at most about 1."""
        distance = (places[:, None] - self.centres).norm(dim=-1) / self.radii
        return (self.weights * torch.exp(-(distance**4))).sum(-1)

    def where(self, places: Tensor) -> Tensor:
        """See RealityEffect."""
        return self.field(places) > 0.3

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "log_or_relative_peak": self.strength,
            "centres": self.centres.tolist(),
            "radii": self.radii.tolist(),
            "weights": self.weights.tolist(),
        }


class HeavyPatches(_Blobs):
    """Patches of more mass."""

    NAME = "nonuniform_density"
    LIMIT = 8.0

    def masses(self, masses: Tensor, places: Tensor) -> Tensor:
        """See RealityEffect."""
        return masses * (1 + self.strength * self.field(places))


class StiffPatches(_Blobs):
    """Patches that are stiffer in every way, exponentially in the strength."""

    NAME = "nonuniform_stiffness"
    LIMIT = 5.0

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        factor = torch.exp((self.strength * self.field(places_of(now))).clamp(max=6))
        return stiffened(elements, now, factor)


class PenaltyContact(OutOfFamilyEffect):
    """A plane or a sphere in the way, with a penalty force, a damper and regularised Coulomb friction.

    The strength says how far the obstacle reaches into the space that the cloth would sweep: 0 not at all,
    1 up to the pose of frame 0, which it never touches.
    """

    NAME = "contact"
    STAGE = Stage.MECHANICS
    LIMIT = 1.0

    def draw(self, rng: Rng) -> None:
        """Draw the obstacle; it stands where the clip without it moves farthest."""
        motion = self.reference.motion.reshape(len(self.reference.motion), -1, 3)
        right, ahead = horizontal_axes(self.reference.gravity)
        turn = float(rng.uniform(-0.25, 0.25))
        normal = math.cos(turn) * ahead + math.sin(turn) * right
        reach = [(motion @ (s * normal) - motion[0] @ (s * normal)).max() for s in (1, -1)]
        self.normal = normal if reach[0] >= reach[1] else -normal
        along = motion @ self.normal
        self.margin = 0.01 * self.reference.width
        self.ball = bool(rng.random() < 0.5)
        self.radius = float(rng.uniform(0.25, 0.45)) * self.reference.width
        self.friction = float(rng.uniform(0.1, 0.5))
        if self.ball:
            frame, vertex = divmod(int((along - along[0]).argmax()), along.shape[1])
            # Centre so that the ball touches the pose of frame 0 nowhere at strength 1.
            touch = motion[0, vertex] + self.normal * (self.radius + self.margin)
            for _ in range(200):
                if float((motion[0] - touch).norm(dim=-1).min()) >= self.radius + self.margin:
                    break
                touch = touch + 0.01 * self.reference.width * self.normal
            self.centre = touch
            self.range = float((along - along[0])[frame, vertex])
        else:
            self.offset = float(along[0].max()) + self.margin
            self.range = max(float(along.max()) - self.offset, self.margin)

    def _gap(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (N,) outside the obstacle and the directions (N, 3) away from it."""
        back = (1 - min(self.strength, 1.0)) * self.range
        if self.ball:
            away = x - (self.centre + back * self.normal)
            distance = away.norm(dim=-1)
            return distance - self.radius, away / distance[:, None]
        return self.offset + back - x @ self.normal, (-self.normal).expand_as(x)

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        if self.strength <= 0:
            return torch.zeros_like(now.positions)
        gap, away = self._gap(now.positions)
        depth = (-gap).clamp(min=0)[:, None]
        speed = (now.velocities * away).sum(-1, keepdim=True)
        stiffness = 0.1 / now.time_step**2
        push = (stiffness * depth - 0.3 / now.time_step * speed.clamp(max=0) * (depth > 0)).clamp(min=0)
        slide = now.velocities - speed * away
        amount = slide.norm(dim=-1, keepdim=True)
        grip = (self.friction * push).clamp(max=0.3 / now.time_step * amount)
        return push * away - grip * slide / amount.clamp(min=1e-9)

    def where(self, places: Tensor) -> Tensor | None:
        """Unknown before it is simulated; found from the clip by the scene's maker."""
        return None

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        shape = {"ball": self.ball, "normal": self.normal.tolist(), "friction": self.friction}
        if self.ball:
            back = (1 - min(self.strength, 1.0)) * self.range
            return {
                **shape,
                "radius": self.radius,
                "centre": (self.centre + back * self.normal).tolist(),
            }
        return {**shape, "offset": self.offset + (1 - min(self.strength, 1.0)) * self.range}


class TiltedGravity(OutOfFamilyEffect):
    """Gravity in another direction than declared."""

    NAME = "gravity_tilt"
    STAGE = Stage.MECHANICS
    LIMIT = 6.0

    def draw(self, rng: Rng) -> None:
        """Draw the direction of the tilt, of 2° at strength 1."""
        angle = float(rng.uniform(0, 2 * math.pi))
        right, ahead = horizontal_axes(self.reference.gravity)
        self.towards = math.cos(angle) * right + math.sin(angle) * ahead

    def gravity(self, gravity: Tensor) -> Tensor:
        """See RealityEffect."""
        angle = math.radians(2 * self.strength)
        return math.cos(angle) * gravity + math.sin(angle) * gravity.norm() * self.towards

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"degrees": 2 * self.strength, "towards": self.towards.tolist()}


class WrongFrameRate(OutOfFamilyEffect):
    """Frames that are further apart in time, or closer, than declared."""

    NAME = "frame_rate"
    STAGE = Stage.MECHANICS
    ACCEPTED = (Stage.MECHANICS, Stage.OBSERVATION)
    LIMIT = 7.0

    def draw(self, rng: Rng) -> None:
        """Draw the sense; 3 % at strength 1."""
        self.sign = float(rng.choice((-1.0, 1.0)))

    def frame_interval(self, interval: float) -> float:
        """See RealityEffect."""
        return interval * math.exp(0.03 * self.sign * self.strength)

    def comparable(self) -> dict[str, float]:
        """See RealityEffect."""
        return {"interval_ratio": self.frame_interval(1.0)}

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"interval_ratio": self.frame_interval(1.0)}


def strains(now: StepContext) -> tuple[Tensor, Tensor]:
    """Stretch of every edge (E,), 0 where it is slack, and size of every shear angle [rad]."""
    stretch = _lengths(now.positions, _stencil(now, "stretching")) / now.cloth.rest_lengths - 1
    shear = _shear_measure(now, now.positions) - now.cloth.energies.named("shearing").rest
    return stretch.clamp(min=0), _shear_angle(now, shear).abs()


def stiffened(elements: Elements, now: StepContext, factor: Tensor) -> Elements:
    """Elements whose stiffness is multiplied by the factor (N,) of their vertices."""
    shears = _stencil(now, "shearing")
    return elements.scaled(
        stretching=factor[_stencil(now, "stretching")].mean(-1).clamp(max=8),
        shearing=factor[shears].mean(-1) if _has_diagonals(now) else factor[shears[:, 1]],
        bending=factor[_stencil(now, "bending")[:, 1]],
    )


def bending_force(now: StepContext, moments: Tensor) -> Tensor:
    """Forces (N, 3) [N] of moments (S, 3) [N·m] about straight angles, each along the way it bends.

    The energy of a straight angle is ½ B |c|², c = (x_i - 2 x_k + x_j) / L to first order; a term -m·c beside
    it gives a preferred bend m / B.
    """
    s = _stencil(now, "bending")
    spacing = now.cloth.rest_lengths.mean()
    force = moments / spacing
    total = torch.zeros_like(now.positions)
    total = total.index_add(0, s[:, 0], force)
    total = total.index_add(0, s[:, 1], -2 * force)
    return total.index_add(0, s[:, 2], force)


def bends(now: StepContext) -> Tensor:
    """Bend vectors c (S, 3) of all straight angles, as in bending_force."""
    return _bends(now.positions, _stencil(now, "bending"))


def _stencil(now: StepContext, energy: str) -> Tensor:
    return now.cloth.energies.named(energy).stencil


def _has_diagonals(now: StepContext) -> bool:
    """Whether shearing is resisted by diagonals, not by angles."""
    return _stencil(now, "shearing").shape[1] == 2


def _shear_measure(now: StepContext, x: Tensor) -> Tensor:
    """What the rest shape of shearing is a value of: angles [rad], or lengths of diagonals [m]."""
    if _has_diagonals(now):
        return now.cloth.energies.named("shearing").measure(x)
    return _angles(x, _stencil(now, "shearing"))


def _shear_angle(now: StepContext, change: Tensor) -> Tensor:
    """Change of the shear angle [rad] for a change of what ``_shear_measure`` gives."""
    if _has_diagonals(now):
        return 2 * change / now.cloth.energies.named("shearing").rest
    return change


def _bends(x: Tensor, straights: Tensor) -> Tensor:
    a, b = x[straights[:, 1]] - x[straights[:, 0]], x[straights[:, 2]] - x[straights[:, 1]]
    return torch.nn.functional.normalize(b, dim=-1) - torch.nn.functional.normalize(a, dim=-1)


def _lengths(x: Tensor, edges: Tensor) -> Tensor:
    return (x[edges[:, 1]] - x[edges[:, 0]]).norm(dim=-1)


def _angles(x: Tensor, corners: Tensor) -> Tensor:
    a, b = x[corners[:, 0]] - x[corners[:, 1]], x[corners[:, 2]] - x[corners[:, 1]]
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))
