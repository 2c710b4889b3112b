"""Effects on what moves the cloth, in other functional forms than the catalogue's."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toile.effects.base import Stage
from toile.generation.out_of_family.interface import OutOfFamilyEffect, Rng, pulse
from toile.geometry.horizontal import horizontal_axes
from toile.physics.step_terms import StepContext


class StickSlip(OutOfFamilyEffect):
    """A pinned corner that slips through its grip in jumps, inwards and down."""

    NAME = "anchor_slip"
    STAGE = Stage.ACTUATION

    def draw(self, rng: Rng) -> None:
        """Draw the corner, the direction, and the times and heights of the jumps."""
        pinned = self.reference.pinned
        self.corner = int(rng.integers(len(pinned)))
        flat = self.reference.motion[0].reshape(-1, 3)
        inwards = flat.mean(0) - flat[pinned[self.corner]]
        inwards = inwards / inwards.norm()
        across = torch.from_numpy(rng.standard_normal(3))
        direction = inwards + 0.3 * across / across.norm()
        self.direction = direction / direction.norm()
        n = int(rng.integers(2, 5))
        self.times = np.sort(rng.uniform(0.1, 0.75, n)) * self.reference.duration
        self.heights = rng.uniform(0.4, 1.0, n)
        self.heights *= 0.02 * self.reference.width / self.heights.sum()
        self.ramp = 0.06  # s

    def boundary(self, times: Tensor) -> Tensor:
        """See RealityEffect."""
        path = sum(
            float(height) * pulse(times, float(begin), math.inf, self.ramp)
            for begin, height in zip(self.times, self.heights, strict=True)
        )
        result = torch.zeros(len(times), len(self.reference.pinned), 3, dtype=torch.float64)
        result[:, self.corner] = self.strength * torch.as_tensor(path)[:, None] * self.direction
        return result

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "corner": self.corner,
            "slip": self.strength * float(self.heights.sum()),
            "times": self.times.tolist(),
            "direction": self.direction.tolist(),
        }

    def where(self, places: Tensor) -> Tensor:
        """The quarter of the cloth around the corner."""
        W = self.reference.motion.shape[2]
        H = self.reference.motion.shape[1]
        k = self.reference.pinned[self.corner]
        corner = torch.tensor([k // W / (H - 1), k % W / (W - 1)], dtype=torch.float64)
        return (places - corner).norm(dim=-1) <= 0.35

    def when(self, times: Tensor) -> Tensor:
        """From the first jump on."""
        return times > float(self.times[0])


class Gusts(OutOfFamilyEffect):
    """Band-limited noise plus two pulses of a uniform force per mass, across gravity."""

    NAME = "gusts"
    STAGE = Stage.ACTUATION

    def draw(self, rng: Rng) -> None:
        """Draw spectrum, phases and pulses."""
        n = 12
        self.frequencies = rng.uniform(0.7, 4.0, n)
        self.phases = rng.uniform(0, 2 * math.pi, n)
        self.angles = rng.uniform(0, 2 * math.pi, n)
        self.weights = rng.rayleigh(1.0, n) / math.sqrt(n)
        self.begins = rng.uniform(0.05, 0.65, 2) * self.reference.duration
        self.lengths = rng.uniform(0.2, 0.4, 2)
        self.pulse_angles = rng.uniform(0, 2 * math.pi, 2)
        self.pulse_weights = rng.uniform(1.5, 3.0, 2)

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        right, ahead = horizontal_axes(self.reference.gravity)
        waves = self.weights * np.sin(2 * math.pi * self.frequencies * now.time + self.phases)
        x, y = (waves * np.cos(self.angles)).sum(), (waves * np.sin(self.angles)).sum()
        t = torch.tensor([now.time], dtype=torch.float64)
        for begin, length, angle, weight in zip(
            self.begins, self.lengths, self.pulse_angles, self.pulse_weights, strict=True
        ):
            p = weight * float(pulse(t, float(begin), float(begin + length), 0.35 * float(length)))
            x, y = x + p * math.cos(angle), y + p * math.sin(angle)
        return (self.strength * (float(x) * right + float(y) * ahead)).expand_as(now.positions)

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "deviation": self.strength * float(np.sqrt(0.5 * (self.weights**2).sum())),
            "pulses": (self.strength * self.pulse_weights).tolist(),
            "begins": self.begins.tolist(),
        }
