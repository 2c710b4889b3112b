"""Effects on the way from surface to pixels, in other functional forms than the catalogue's."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor

from toile.effects.base import Stage
from toile.generation.out_of_family.interface import Array, Measure, OutOfFamilyEffect, Rng, unit
from toile.geometry.camera import Camera


class WrongFocalLength(OutOfFamilyEffect):
    """A focal length that differs from the declared one, by slightly different factors along x and y."""

    NAME = "focal_error"
    STAGE = Stage.CAMERA
    MEASURE = Measure.PIXELS

    def draw(self, rng: Rng) -> None:
        """Draw the sense and the pixel's aspect; 5 % at strength 1."""
        self.sign = float(rng.choice((-1.0, 1.0)))
        self.aspect = float(rng.uniform(-0.05, 0.05))

    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """See RealityEffect."""
        centre = pixels.new_tensor([camera.cx, camera.cy])
        f = 0.05 * self.sign * self.strength
        factor = pixels.new_tensor([math.exp(f * (1 + self.aspect)), math.exp(f * (1 - self.aspect))])
        return centre + factor * (pixels - centre)

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"ratio": math.exp(0.05 * self.sign * self.strength), "aspect": self.aspect}


class TangentialLens(OutOfFamilyEffect):
    """Radial distortion of two orders with a tangential part (a lens that is not centred)."""

    NAME = "lens_distortion"
    STAGE = Stage.CAMERA
    MEASURE = Measure.PIXELS

    def draw(self, rng: Rng) -> None:
        """Draw the sense and the ratios of the coefficients."""
        self.radial = float(rng.choice((-0.3, 0.3)))
        self.second = float(rng.uniform(-0.2, 0.2))
        self.tangential = rng.uniform(-0.06, 0.06, 2)

    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """See RealityEffect."""
        x, y = (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy
        r2 = x * x + y * y
        k1, k2 = self.strength * self.radial, self.strength * self.second
        p1, p2 = (self.strength * float(p) for p in self.tangential)
        # Kept monotonic: a lens does not fold the image.
        factor = (1 + k1 * r2 + k2 * r2 * r2).clamp(0.5, 2.0)
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = factor * x + dx, factor * y + dy
        return torch.stack((camera.fx * x + camera.cx, camera.fy * y + camera.cy), -1)

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        s = self.strength
        return {"k1": s * self.radial, "k2": s * self.second, "p": (s * self.tangential).tolist()}


class Lambert(OutOfFamilyEffect):
    """Diffuse light from one side beside ambient light; no cast shadows."""

    NAME = "shading"
    STAGE = Stage.APPEARANCE
    MEASURE = Measure.BRIGHTNESS
    LEVELS = (5.0, 10.0, 20.0)
    LIMIT = 1.0

    def draw(self, rng: Rng) -> None:
        """Draw the direction to the light: beside, above and before the cloth."""
        side = float(rng.choice((-1.0, 1.0)))
        self.light = unit(np.array([side * rng.uniform(0.5, 1.2), -rng.uniform(0.1, 0.8), -0.5]))

    def brightness(self, normals: Tensor) -> Tensor:
        """See RealityEffect."""
        return 1 - self.strength + 1.6 * self.strength * (normals @ self.light).clamp(min=0)

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"lambert": 1.6 * self.strength, "ambient": 1 - self.strength, "light": self.light.tolist()}


class SubFrameBlur(OutOfFamilyEffect):
    """Motion blur as the mean of renders within the exposure."""

    NAME = "motion_blur"
    STAGE = Stage.APPEARANCE
    MEASURE = Measure.EXPOSURE
    LEVELS = (30.0, 50.0, 90.0)
    LIMIT = 1.0

    def exposure(self) -> float:
        """See RealityEffect."""
        return min(self.strength, 1.0)

    def comparable(self) -> dict[str, float]:
        """See RealityEffect."""
        return {"exposure": self.exposure()}

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"exposure": self.exposure()}


class RaggedMask(OutOfFamilyEffect):
    """A mask whose edge is moved outwards or inwards, unevenly along the edge and over time."""

    NAME = "mask_bias"
    STAGE = Stage.OBSERVATION
    MEASURE = Measure.EDGE
    LEVELS = (0.75, 1.5, 3.0)

    def draw(self, rng: Rng) -> None:
        """Draw the sense and the seed of the edge."""
        self.sign = float(rng.choice((-1.0, 1.0)))
        self.seed = int(rng.integers(2**31))
        self.pixels_per_percent = 0.0  # set by the film, which knows the cloth's width in pixels

    @property
    def growth(self) -> float:
        """Mean shift of the edge outwards [px]; 1 % of the width at strength 1."""
        return self.sign * self.strength * self.pixels_per_percent

    def mask(self, mask: Array, frame: int) -> Array:
        """See RealityEffect."""
        rng = np.random.default_rng([self.seed, frame])
        ragged = gaussian_filter(rng.standard_normal(mask.shape), 3.0)
        ragged = 1 + 0.5 * ragged / ragged.std()
        inside = mask > 0.5
        # Distances are to the middles of pixels, half a pixel beyond the edge.
        outside_by = np.where(
            inside, 0.5 - distance_transform_edt(inside), distance_transform_edt(~inside) - 0.5
        )
        return (outside_by <= self.growth * ragged).astype(mask.dtype)

    def comparable(self) -> dict[str, float]:
        """See RealityEffect."""
        return {"growth": self.growth}

    def parameters(self) -> dict[str, object]:
        """See RealityEffect."""
        return {"growth_px": self.growth}
