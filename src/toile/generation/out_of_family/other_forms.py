"""Second functional forms of effects: a diagnosis must name the cause, not the formula."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from toile.effects.base import Stage
from toile.generation.out_of_family.actuation import Gusts
from toile.generation.out_of_family.interface import OutOfFamilyEffect, Rng, places_of
from toile.generation.out_of_family.mechanics import ThinningDamping, stiffened, strains
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext


class QuadraticDrag(OutOfFamilyEffect):
    """Drag with the square of the normal speed, a share along the surface, and less of it in the wake below.

    -c w(y) (|n·v| (n·v) n + r |v_t| v_t), w falling from 1 at the upper edge to 1 - d at the lower one.
    """

    NAME = "air_drag"
    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw the share along the surface and the wake."""
        self.tangential, self.wake = float(rng.uniform(0.0, 0.15)), float(rng.uniform(0.0, 0.4))

    def acceleration(self, now: StepContext) -> Tensor:
        """See RealityEffect."""
        v, n = now.velocities, now.normals
        normal = (v * n).sum(-1, keepdim=True)
        along = v - normal * n
        wake = 1 - self.wake * places_of(now)[:, 1:]

        def rate(speed: Tensor) -> Tensor:
            return (6.0 * self.strength * wake * speed).clamp(max=0.5 / now.time_step)

        slide = along.norm(dim=-1, keepdim=True)
        return -rate(normal.abs()) * normal * n - self.tangential * rate(slide) * along

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {
            "coefficient": 6.0 * self.strength,
            "power": 2.0,
            "tangential_share": self.tangential,
            "wake": self.wake,
        }


class RayleighDamping(ThinningDamping):
    """Damping proportional to the stiffness (Rayleigh): one time for all elements, whatever the rate."""

    def draw(self, rng: Rng) -> None:
        """Draw the time."""
        self.times = np.full(3, 0.01 * rng.uniform(0.5, 1.5))
        self.half_rate = math.inf

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"times": (self.strength * self.times).tolist()}


class BilinearStiffening(OutOfFamilyEffect):
    """Threads that are stiffer by a constant factor beyond a strain, in stretching and in shear."""

    NAME = "strain_stiffening"
    STAGE = Stage.MECHANICS
    LIMIT = 12.0

    def draw(self, rng: Rng) -> None:
        """Draw where the second branch begins, and how steep it is."""
        self.knees = float(rng.uniform(0.001, 0.004)), float(rng.uniform(0.01, 0.04))
        self.slopes = float(rng.uniform(0.8, 1.6)), float(rng.uniform(0.8, 1.6))

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        factors = []
        for strain, knee, slope in zip(strains(now), self.knees, self.slopes, strict=True):
            # Secant of a law with slope 1 up to the knee and 1 + s beyond.
            beyond = 1 - knee / strain.clamp(min=knee)
            factors.append(1 + self.strength * slope * beyond)
        return elements.scaled(stretching=factors[0], shearing=factors[1])

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"knees": list(self.knees), "slopes": [1 + self.strength * s for s in self.slopes]}


class PulsedGusts(Gusts):
    """Three to five single gusts and no noise between them."""

    def draw(self, rng: Rng) -> None:
        """Draw the pulses."""
        n = int(rng.integers(3, 6))
        self.frequencies = self.phases = self.angles = self.weights = np.zeros(0)
        self.begins = np.sort(rng.uniform(0.02, 0.75, n)) * self.reference.duration
        self.lengths = rng.uniform(0.15, 0.45, n)
        self.pulse_angles = rng.uniform(0, 2 * math.pi, n)
        self.pulse_weights = rng.uniform(1.0, 3.0, n)


class NoisyGusts(Gusts):
    """Noise with a spectrum that falls with the frequency, and no pulses."""

    def draw(self, rng: Rng) -> None:
        """Draw spectrum and phases."""
        n = 24
        self.frequencies = rng.uniform(0.4, 5.0, n)
        self.phases = rng.uniform(0, 2 * math.pi, n)
        self.angles = rng.uniform(0, 2 * math.pi, n)
        self.weights = 2.0 * rng.rayleigh(1.0, n) / math.sqrt(n) / self.frequencies ** (5 / 6)
        self.begins = self.lengths = self.pulse_angles = self.pulse_weights = np.zeros(0)


class _Gradient(OutOfFamilyEffect):
    """Something that grows evenly from one side of the cloth to the other."""

    STAGE = Stage.MECHANICS

    def draw(self, rng: Rng) -> None:
        """Draw the direction."""
        angle = float(rng.uniform(0, 2 * math.pi))
        self.towards = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)

    def slope(self, places: Tensor) -> Tensor:
        """From -1 to 1 over the cloth, (N,)."""
        return (places - 0.5) @ self.towards * 2 / float(self.towards.abs().sum())

    def where(self, places: Tensor) -> Tensor:
        """The third in which there is most."""
        return self.slope(places) > 1 / 3

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"log_ratio": 2 * self.strength, "towards": self.towards.tolist()}


class GradedDensity(_Gradient):
    """Mass per area that grows exponentially from side to side; the mean stays about the same."""

    NAME = "nonuniform_density"
    LIMIT = 1.6

    def masses(self, masses: Tensor, places: Tensor) -> Tensor:
        """See RealityEffect."""
        return masses * torch.exp(self.strength * self.slope(places))


class GradedStiffness(_Gradient):
    """Stiffness of every kind that grows exponentially from side to side."""

    NAME = "nonuniform_stiffness"
    LIMIT = 2.5

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """See RealityEffect."""
        return stiffened(elements, now, torch.exp(self.strength * self.slope(places_of(now))))
