"""Effects in this engine's own forms; those of camera, light and observation are the other generator's."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toile.effects.base import Stage
from toile.errors import InputError
from toile.generation.mujoco.engine import Array, Flex, FlexEffect
from toile.generation.out_of_family.interface import OutOfFamilyEffect, Rng, places_on
from toile.generation.out_of_family.mechanics import PenaltyContact, TiltedGravity, WrongFrameRate
from toile.generation.out_of_family.optics import (
    Lambert,
    RaggedMask,
    SubFrameBlur,
    TangentialLens,
    WrongFocalLength,
)
from toile.generation.out_of_family.outside import InternalPressure, Occluder, Vortex
from toile.geometry.horizontal import horizontal_axes
from toile.geometry.mesh import face_normals
from toile.physics.step_terms import StepContext


class FaceDrag(OutOfFamilyEffect):
    """Pressure drag and skin friction of still air on every triangle, both by the square of its speed.

    ½ ρ A (C |v_n| v_n n + C_f |v| v_t), a third of it on every corner.
    """

    NAME = "air_drag"
    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw the ratio of the coefficients of friction and pressure."""
        self.friction = float(rng.uniform(0.02, 0.2))

    def acceleration(self, now: StepContext) -> Tensor:
        """See OutOfFamilyEffect."""
        faces = now.cloth.topology.faces
        normals = face_normals(now.positions, faces)
        double_area = normals.norm(dim=-1, keepdim=True)
        n = normals / double_area
        v = now.velocities[faces].mean(1)
        normal_speed = (v * n).sum(-1, keepdim=True)
        across = normal_speed * n
        rate = 0.6 * self.strength * 0.5 * double_area  # kg/m³ · m²
        force = -rate * (
            normal_speed.abs() * across + self.friction * v.norm(dim=-1, keepdim=True) * (v - across)
        )
        total = torch.zeros_like(now.positions)
        for corner in range(3):
            total = total.index_add(0, faces[:, corner], force / 3)
        # A drag that takes more than half of the speed in a step would be a mistake of the step.
        limit = 0.5 / now.time_step * now.velocities.norm(dim=-1, keepdim=True)
        result = total / now.cloth.masses[:, None]
        return result * (limit / result.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1)

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {"half_density_times_coefficient": 0.6 * self.strength, "friction_share": self.friction}


class RayleighDamping(FlexEffect):
    """More damping in proportion to the stiffness, of membrane and bending alike."""

    NAME = "internal_damping"
    STAGE = Stage.MECHANICS
    LIMIT = 60.0

    def prepare(self, flex: Flex) -> None:
        """See FlexEffect."""
        flex.model.flex_damping[:] = flex.sheet.material.damping + 0.01 * self.strength

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {"times": [0.01 * self.strength] * 3}


class OrthotropicSheet(FlexEffect):
    """Young's moduli that differ between the two axes, and bending that differs otherwise."""

    NAME = "anisotropic_stiffness"
    STAGE = Stage.MECHANICS
    LIMIT = 4.0

    def draw(self, rng: Rng) -> None:
        """Draw the stiffer direction and the exponents of the two ratios."""
        self.sign = float(rng.choice((-1.0, 1.0)))
        self.exponents = float(rng.uniform(0.6, 1.2)), float(rng.uniform(0.3, 1.0))

    def _ratios(self) -> tuple[float, float]:
        stretch, bend = (math.exp(self.sign * self.strength * e) for e in self.exponents)
        return stretch, bend

    def prepare(self, flex: Flex) -> None:
        """See FlexEffect."""
        stretch, bend = self._ratios()
        flex.set_stiffness(flex.sheet.material.plane_stiffness(stretch))
        along = np.abs(flex.rest[flex.edges[:, 1]] - flex.rest[flex.edges[:, 0]])
        # An edge along axis 0 is the hinge of bending along axis 1.
        share = (along[:, 1] ** 2 - along[:, 0] ** 2) / (along**2).sum(1)
        flex.scale_bending(bend ** (0.5 * share))

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        stretch, bend = self._ratios()
        return {"stretching_ratio": stretch, "bending_ratio": bend}


class LimitedExtension(FlexEffect):
    """Stiffness times 1 / (1 - ε/ε_max), as in Gent (1996); ε is a triangle's largest strain a step ago."""

    NAME = "strain_stiffening"
    STAGE = Stage.MECHANICS
    LIMIT = 60.0

    def draw(self, rng: Rng) -> None:
        """Draw the limit at strength 1."""
        self.limit = float(rng.uniform(0.15, 0.4))

    def update(self, flex: Flex, time: float) -> None:
        """See FlexEffect."""
        share = (self.strength / self.limit * flex.strains()).clip(0, 0.9)
        flex.scale_stiffness(1 / (1 - share))

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {"largest_strain": self.limit / max(self.strength, 1e-9)}


class CurledHem(FlexEffect):
    """A margin along the lower or a side edge that is curved at rest, more so towards the edge."""

    NAME = "rest_curvature"
    STAGE = Stage.MECHANICS
    LIMIT = 60.0

    def draw(self, rng: Rng) -> None:
        """Draw edge, width and side."""
        self.axis = int(rng.integers(2))
        self.inner = float(rng.uniform(0.35, 0.65))
        self.curvature = 8.0 * float(rng.choice((-1.0, 1.0)))  # 1/m

    def _curvature(self, places: Tensor | Array) -> Array:
        share = (np.asarray(places)[:, self.axis] - self.inner) / (1 - self.inner)
        result: Array = self.strength * self.curvature * np.clip(share, 0, 1)
        return result

    def prepare(self, flex: Flex) -> None:
        """See FlexEffect."""
        stencils, matrices = flex.bending_matrices()
        along = flex.rest[stencils, self.axis]
        middle = flex.places[stencils[:, :2]].mean(1)
        heights = 0.5 * self._curvature(middle)[:, None] * (along - along[:, :2].mean(1, keepdims=True)) ** 2
        # The bending energy ½ xᵀ Q x becomes ½ (x - h n)ᵀ Q (x - h n), n the normal of the step before.
        self._stencils = torch.from_numpy(stencils.astype(np.int64))
        self._pull = torch.from_numpy((matrices @ heights[..., None])[..., 0])

    def force(self, flex: Flex, now: StepContext) -> Tensor:
        """See FlexEffect."""
        normals = torch.nn.functional.normalize(now.normals[self._stencils[:, :2]].mean(1), dim=-1)
        forces = self._pull[..., None] * normals[:, None]
        return torch.zeros_like(now.positions).index_add(0, self._stencils.reshape(-1), forces.reshape(-1, 3))

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {"curvature_at_edge": self.strength * self.curvature, "axis": self.axis, "begin": self.inner}

    def where(self, places: Tensor) -> Tensor:
        """See OutOfFamilyEffect."""
        return places[:, self.axis] > self.inner


class _Stripe(FlexEffect):
    """A straight stripe across the cloth in which something differs, with soft borders."""

    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw direction, place and width."""
        angle = float(rng.uniform(0, math.pi))
        self.direction = np.array([math.cos(angle), math.sin(angle)])
        self.through = rng.uniform((0.25, 0.4), (0.75, 0.9))
        self.width = float(rng.uniform(0.15, 0.35))

    def field(self, places: Tensor | Array) -> Array:
        """Share (N,) of the stripe at places (N, 2), 0 to 1."""
        distance = np.abs((np.asarray(places) - self.through) @ self.direction)
        result: Array = 0.5 - 0.5 * np.tanh((distance - 0.5 * self.width) / 0.04)
        return result

    def where(self, places: Tensor) -> Tensor:
        """See OutOfFamilyEffect."""
        return torch.from_numpy(self.field(places) > 0.3)

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {
            "log_or_relative_peak": self.strength,
            "direction": self.direction.tolist(),
            "through": self.through.tolist(),
            "width": self.width,
        }


class HeavyStripe(_Stripe):
    """A stripe of more mass."""

    NAME = "nonuniform_density"
    LIMIT = 12.0

    def masses(self, masses: Tensor, places: Tensor) -> Tensor:
        """See OutOfFamilyEffect."""
        return masses * (1 + self.strength * torch.from_numpy(self.field(places)))


class StiffStripe(_Stripe):
    """A stripe stiffer or softer in its plane, and more so in bending, exponentially in the strength."""

    NAME = "nonuniform_stiffness"
    LIMIT = 8.0

    def draw(self, rng: Rng) -> None:
        """Draw stripe and sign."""
        super().draw(rng)
        self.sign = float(rng.choice((-1.0, 1.0)))

    def prepare(self, flex: Flex) -> None:
        """See FlexEffect."""
        inside = self.field(flex.places[flex.elements].mean(1))
        plane = flex.sheet.material.plane_stiffness()
        exponent = np.minimum(0.5 * self.strength * inside, 3.0)
        flex.set_stiffness(plane * np.exp(self.sign * exponent)[:, None, None])
        flex.scale_bending(np.exp(self.sign * self.strength * self.field(flex.places[flex.edges].mean(1))))

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {**super().parameters(), "log_or_relative_peak": self.sign * self.strength}


class RigidObstacle(PenaltyContact, FlexEffect):
    """The other generator's ball or plane as a rigid body, met by MuJoCo's own frictional contacts."""

    def acceleration(self, now: StepContext) -> Tensor:
        """None: the body pushes back by itself."""
        return torch.zeros_like(now.positions)

    def obstacle(self) -> str:
        """See FlexEffect."""
        if self.strength <= 0:
            return ""
        back = (1 - min(self.strength, 1.0)) * self.range
        # Without a priority of its own the larger friction counts, and that is the cloth's, 1.
        surface = f'friction="{self.friction} 0.005 0.0001" priority="1" solref="0.01 1"'
        if self.ball:
            centre = (self.centre + back * self.normal).tolist()
            place = " ".join(map(repr, centre))
            return f'<geom type="sphere" size="{self.radius!r}" pos="{place}" {surface}/>'
        place = " ".join(map(repr, ((self.offset + back) * self.normal).tolist()))
        outwards = " ".join(map(repr, (-self.normal).tolist()))
        return f'<geom type="plane" size="3 3 0.1" pos="{place}" zaxis="{outwards}" {surface}/>'


class CreepingGrip(OutOfFamilyEffect):
    """A pinned corner that starts to slide and slows down exponentially."""

    NAME = "anchor_slip"
    STAGE = Stage.ACTUATION

    def draw(self, rng: Rng) -> None:
        """Draw corner, direction, begin and time constant."""
        pinned = self.reference.pinned
        self.corner = int(rng.integers(len(pinned)))
        flat = self.reference.motion[0].reshape(-1, 3)
        towards = flat[pinned[1 - self.corner]] - flat[pinned[self.corner]]
        down = self.reference.gravity / self.reference.gravity.norm()
        direction = towards / towards.norm() + float(rng.uniform(0.0, 0.8)) * down
        self.direction = direction / direction.norm()
        self.begin_time = float(rng.uniform(0.05, 0.45)) * self.reference.duration
        self.time = float(rng.uniform(0.08, 0.3))

    def boundary(self, times: Tensor) -> Tensor:
        """See OutOfFamilyEffect."""
        since = (times - self.begin_time).clamp(min=0)
        # The grip yields over a tenth of the time, not with a jump of the speed.
        path = 1 - torch.exp(-(since**2) / (self.time * (since + 0.1 * self.time)))
        result = torch.zeros(len(times), len(self.reference.pinned), 3, dtype=torch.float64)
        result[:, self.corner] = 0.02 * self.reference.width * self.strength * path[:, None] * self.direction
        return result

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {
            "corner": self.corner,
            "slip": 0.02 * self.reference.width * self.strength,
            "begin": self.begin_time,
            "time": self.time,
            "direction": self.direction.tolist(),
        }

    def where(self, places: Tensor) -> Tensor:
        """The quarter of the cloth around the corner."""
        grid = self.reference.motion.shape[1], self.reference.motion.shape[2]
        return (places - places_on(grid)[self.reference.pinned[self.corner]]).norm(dim=-1) <= 0.35

    def when(self, times: Tensor) -> Tensor:
        """From its begin on."""
        return times > self.begin_time


class OneMinusCosineGusts(OutOfFamilyEffect):
    """Gusts of the profile (1 - cos)/2 from about one direction, harder on what faces them."""

    NAME = "gusts"
    STAGE = Stage.ACTUATION

    def draw(self, rng: Rng) -> None:
        """Draw number, times, directions and weights."""
        n = int(rng.integers(2, 5))
        self.begins = np.sort(rng.uniform(0.0, 0.75, n)) * self.reference.duration
        self.lengths = rng.uniform(0.25, 0.6, n)
        # Mostly across the surface: from before or behind the cloth.
        mean = math.pi * (float(rng.choice((0.5, 1.5))) + float(rng.uniform(-0.3, 0.3)))
        self.angles = mean + 0.3 * rng.standard_normal(n)
        self.weights = rng.uniform(0.5, 1.5, n)
        self.facing = float(rng.uniform(0.2, 0.8))

    def acceleration(self, now: StepContext) -> Tensor:
        """See OutOfFamilyEffect."""
        right, ahead = horizontal_axes(self.reference.gravity)
        share = ((now.time - self.begins) / self.lengths).clip(0, 1)
        amounts = self.strength * self.weights * 0.5 * (1 - np.cos(2 * math.pi * share))
        x, y = float((amounts * np.cos(self.angles)).sum()), float((amounts * np.sin(self.angles)).sum())
        push = x * right + y * ahead
        across = (now.normals @ push)[:, None] * now.normals
        return (1 - self.facing) * push + self.facing * across

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {
            "peaks": (self.strength * self.weights).tolist(),
            "begins": self.begins.tolist(),
            "lengths": self.lengths.tolist(),
            "angles": self.angles.tolist(),
            "facing_share": self.facing,
        }


class ShorterThreads(FlexEffect):
    """Rest lengths that become shorter at a constant rate over a part of the clip."""

    NAME = "shrinking"
    STAGE = Stage.MECHANICS
    OUTSIDE = True
    LIMIT = 12.0

    def draw(self, rng: Rng) -> None:
        """Draw begin, end and the ratio of the two directions; 2 % at strength 1."""
        self.span = np.sort(rng.uniform((0.0, 0.5), (0.3, 1.0))) * self.reference.duration
        self.ratios = rng.uniform(0.6, 1.4, 2)

    def update(self, flex: Flex, time: float) -> None:
        """See FlexEffect."""
        done = float(np.clip((time - self.span[0]) / (self.span[1] - self.span[0]), 0, 1))
        first, second = (1 - min(0.02 * self.strength * float(r) * done, 0.3) for r in self.ratios)
        flex.scale_lengths(first, second)

    def parameters(self) -> dict[str, object]:
        """See OutOfFamilyEffect."""
        return {"shares": (0.02 * self.strength * self.ratios).tolist(), "span": self.span.tolist()}


_ALL: tuple[type[OutOfFamilyEffect], ...] = (
    FaceDrag,
    RayleighDamping,
    OrthotropicSheet,
    LimitedExtension,
    CurledHem,
    HeavyStripe,
    StiffStripe,
    RigidObstacle,
    TiltedGravity,
    WrongFrameRate,
    CreepingGrip,
    OneMinusCosineGusts,
    WrongFocalLength,
    TangentialLens,
    Lambert,
    SubFrameBlur,
    RaggedMask,
    InternalPressure,
    Vortex,
    ShorterThreads,
    Occluder,
)
MUJOCO_EFFECTS: dict[str, type[OutOfFamilyEffect]] = {effect.NAME: effect for effect in _ALL}
"""All effects of this engine by name."""


def mujoco_effect(name: str) -> type[OutOfFamilyEffect]:
    """The class of that name.

    Raises:
        InputError: there is none.
    """
    if name not in MUJOCO_EFFECTS:
        raise InputError(
            "MuJoCo scenes have no such effect", where="effects", expected=", ".join(MUJOCO_EFFECTS), got=name
        )
    return MUJOCO_EFFECTS[name]
