"""Effects that the catalogue lacks; a right answer here is that none of its effects explains the clip."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toile.effects.base import Scope, Stage
from toile.generation.out_of_family.interface import (
    Array,
    Measure,
    OutOfFamilyEffect,
    Rng,
    unit,
)
from toile.generation.out_of_family.mechanics import bending_force, bends
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class PlasticCreases(OutOfFamilyEffect):
    """Bends that stay: beyond a yield angle the rest angle follows the bend."""

    NAME = "plastic_creases"
    STAGE = Stage.MECHANICS
    OUTSIDE = True

    def draw(self, rng: Rng) -> None:
        """Draw the curvature from which the cloth yields, and how fast."""
        self.yield_curvature = float(rng.uniform(0.5, 2.0))  # 1/m
        self.rate = float(rng.uniform(4.0, 10.0))  # 1/s
        self.hardness = 4.0
        self._rest: Tensor | None = None

    def begin(self) -> None:
        """See RealityEffect."""
        self._rest = None

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """Creased cloth is stiffer in bending, or its rest angle would not show."""
        return elements.scaled(bending=1 + self.hardness * self.strength)

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        middle = now.cloth.energies.named("bending").stencil[:, 1]
        normals = now.normals[middle]
        angle = (bends(now) * normals).sum(-1)
        if self._rest is None:
            self._rest = angle.clone()
        away = angle - self._rest
        yielding = self.yield_curvature * float(now.cloth.rest_lengths.mean())
        beyond = away.sign() * (away.abs() - yielding).clamp(min=0)
        self._rest = self._rest + min(self.rate * now.time_step, 1.0) * beyond
        moment = now.material["bending"] * self.hardness * self.strength * self._rest
        return bending_force(now, moment[:, None] * normals) / now.cloth.masses[:, None]

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "hardness": self.hardness * self.strength,
            "yield_curvature": self.yield_curvature,
            "rate": self.rate,
        }


class InternalPressure(OutOfFamilyEffect):
    """More pressure on one side than on the other, pulsing slowly; it follows the normals."""

    NAME = "internal_pressure"
    STAGE = Stage.MECHANICS
    ACCEPTED = (Stage.MECHANICS, Stage.ACTUATION)
    OUTSIDE = True

    def draw(self, rng: Rng) -> None:
        """Draw side and pulse."""
        self.sign = float(rng.choice((-1.0, 1.0)))
        self.frequency, self.phase = float(rng.uniform(0.5, 1.5)), float(rng.uniform(0, 2 * math.pi))

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        wave = 1 + 0.5 * math.sin(2 * math.pi * self.frequency * now.time + self.phase)
        # Area per vertex over its mass is the same for all of them: the pressure is one acceleration.
        return self.sign * self.strength * wave * now.normals

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"acceleration": self.sign * self.strength, "frequency": self.frequency}


class Vortex(OutOfFamilyEffect):
    """Air that turns about an axis before the cloth and pushes it across its surface."""

    NAME = "vortex_field"
    STAGE = Stage.MECHANICS
    ACCEPTED = (Stage.MECHANICS, Stage.ACTUATION)
    OUTSIDE = True

    def draw(self, rng: Rng) -> None:
        """Draw axis, place, sense and size."""
        start = self.reference.motion[0].reshape(-1, 3)
        spread = 0.3 * self.reference.width
        self.centre = start.mean(0) + spread * torch.from_numpy(rng.standard_normal(3) * [0.7, 0.7, 0.4])
        down = self.reference.gravity.numpy() / float(self.reference.gravity.norm())
        self.axis = unit(down + 0.4 * rng.standard_normal(3)) * float(rng.choice((-1.0, 1.0)))
        self.radius = float(rng.uniform(0.25, 0.5)) * self.reference.width

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        r = now.positions - self.centre
        r = r - (r @ self.axis)[:, None] * self.axis
        distance = r.norm(dim=-1, keepdim=True) / self.radius
        air = torch.linalg.cross(self.axis.expand_as(r), r / self.radius) * torch.exp(-(distance**2))
        n = now.normals
        return 8.0 * self.strength * (air * n).sum(-1, keepdim=True) * n

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "peak": 8.0 * self.strength,
            "centre": self.centre.tolist(),
            "axis": self.axis.tolist(),
            "radius": self.radius,
        }


class Shrinking(OutOfFamilyEffect):
    """Cloth whose sides become shorter while it is filmed."""

    NAME = "shrinking"
    STAGE = Stage.MECHANICS
    OUTSIDE = True
    LIMIT = 12.0

    def draw(self, rng: Rng) -> None:
        """Draw the begin of the shrinking and the ratio of the two directions; 2 % at strength 1."""
        self.begin_time = float(rng.uniform(0.0, 0.2)) * self.reference.duration
        self.ratios = rng.uniform(0.7, 1.3, 2)

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        assert now.cloth.grid is not None
        edges = now.cloth.energies.named("stretching").stencil
        along = (edges[:, 1] - edges[:, 0]) == now.cloth.grid[1]
        done = 1 - math.exp(-max(now.time - self.begin_time, 0.0) / (0.4 * self.reference.duration))
        a, b = (1 - min(0.02 * self.strength * float(r) * done, 0.3) for r in self.ratios)
        factor = torch.where(along, torch.tensor(a).double(), torch.tensor(b).double())
        shrunk = elements.with_rest(stretching=elements.rest["stretching"] * factor)
        if now.cloth.energies.named("shearing").stencil.shape[1] == 2:  # diagonals shrink with the sides
            shrunk = shrunk.with_rest(shearing=elements.rest["shearing"] * (0.5 * (a + b)))
        return shrunk

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"shares": (0.02 * self.strength * self.ratios).tolist(), "begin": self.begin_time}


class Occluder(OutOfFamilyEffect):
    """Something that passes before the cloth and that the mask takes for cloth."""

    NAME = "unmasked_occluder"
    SCOPE = Scope.CLIP
    STAGE = Stage.OBSERVATION
    ACCEPTED = (Stage.OBSERVATION, Stage.APPEARANCE)
    OUTSIDE = True
    MEASURE = Measure.COVER
    LEVELS = (3.0, 6.0, 12.0)

    def draw(self, rng: Rng) -> None:
        """Draw colour, path and time; 1 % of the cloth at strength 1."""
        self.colour = rng.uniform(0.15, 0.85, 3)
        begin = float(rng.uniform(0.15, 0.4))
        self.span = begin, begin + float(rng.uniform(0.35, 0.5))
        self.ends = rng.uniform(0.25, 0.75, (2, 2))
        self.stretch = float(rng.uniform(0.5, 2.0))

    def cover(self, rgb: Array, mask: Array, frame: int) -> Array:
        """See RealityEffect."""
        time = frame / max(len(self.reference.motion) - 1, 1)
        if not self.span[0] <= time <= self.span[1] or not mask.any():
            return rgb
        share = (time - self.span[0]) / (self.span[1] - self.span[0])
        rows, columns = np.nonzero(mask > 0.5)
        low = np.array([rows.min(), columns.min()])
        high = np.array([rows.max(), columns.max()])
        centre = low + ((1 - share) * self.ends[0] + share * self.ends[1]) * (high - low)
        radius = math.sqrt(0.01 * self.strength * len(rows) / math.pi)
        r, c = np.mgrid[: mask.shape[0], : mask.shape[1]]
        a, b = radius * math.sqrt(self.stretch), radius / math.sqrt(self.stretch)
        inside = ((r - centre[0]) / a) ** 2 + ((c - centre[1]) / b) ** 2 <= 1
        result: Array = np.where((inside & (mask > 0.5))[..., None], self.colour, rgb)
        return result

    def when(self, times: Tensor) -> Tensor:
        """See RealityEffect."""
        share = times / self.reference.duration
        return (share >= self.span[0]) & (share <= self.span[1])

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"cover": 0.01 * self.strength, "span": list(self.span), "ends": self.ends.tolist()}
