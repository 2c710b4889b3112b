"""What an effect of the out-of-family generator may change, and what it may know."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.effects.base import Scope, Stage
from toile.geometry.camera import Camera
from toile.physics.elements import Elements
from toile.physics.step_terms import StepContext

Rng = np.random.Generator
Array = NDArray[np.float64]


class Measure(Enum):
    """In what the strength of an effect is named."""

    MOTION = "mean displacement of the vertices in the last third of the clip, % of the width"
    PIXELS = "mean displacement in the image over the clip, % of the cloth's width in pixels"
    BRIGHTNESS = "mean relative change of brightness in the last third, %"
    EXPOSURE = "exposure time, % of the frame interval"
    EDGE = "shift of the mask's edge, % of the cloth's width in pixels"
    COVER = "part of the cloth that is covered while it is, %"


@dataclass(frozen=True)
class Reference:
    """What an effect may know of its scene when its shape is drawn: the clip without it.

    Attributes:
        motion: (F, H, W, 3) [m] on the fit's grid.
        cloth_size: [m].
        gravity: (3,) [m/s²].
        fps: frames per second.
        pinned: flattened indices on the fit's grid.
    """

    motion: Tensor
    cloth_size: tuple[float, float]
    gravity: Tensor
    fps: float
    pinned: tuple[int, ...]

    @property
    def width(self) -> float:
        """Mean of the sides [m], what gaps are measured in."""
        return 0.5 * (self.cloth_size[0] + self.cloth_size[1])

    @property
    def duration(self) -> float:
        """Time from the first frame to the last [s]."""
        return (len(self.motion) - 1) / self.fps


class OutOfFamilyEffect:
    """One effect. Hooks that a class does not override change nothing.

    Shapes (directions, places, times) are drawn once from ``rng``; ``strength`` multiplies them, 0 is nothing
    and 1 an ordinary amount. Places are fractions of the cloth, so that an effect fits every grid.

    Args:
        rng: for the shape.
        reference: the clip without the effect.

    Attributes:
        NAME: in the catalogue, or one of the names outside it.
        STAGE: where it acts; ACCEPTED: stages that are right answers.
        SCOPE: what it belongs to where the catalogue lacks it; see ``catalogue.scope_of``.
        OUTSIDE: whether the catalogue lacks it.
        MEASURE: what its strength is named in; LEVELS: weak, medium and strong in it.
        LIMIT: largest strength.
    """

    NAME: ClassVar[str]
    STAGE: ClassVar[Stage]
    ACCEPTED: ClassVar[tuple[Stage, ...]] = ()
    SCOPE: ClassVar[Scope] = Scope.CLOTH
    OUTSIDE: ClassVar[bool] = False
    MEASURE: ClassVar[Measure] = Measure.MOTION
    LEVELS: ClassVar[tuple[float, float, float]] = (1.5, 3.0, 6.0)
    LIMIT: ClassVar[float] = 30.0

    def __init__(self, rng: Rng, reference: Reference) -> None:
        self.reference = reference
        self.strength = 1.0
        self.draw(rng)

    def draw(self, rng: Rng) -> None:
        """Draw the shape."""

    def scaled(self, strength: float) -> Self:
        """The same shape with another strength."""
        other = copy.copy(self)
        other.strength = float(strength)
        return other

    def moved(self, reference: Reference) -> Self:
        """The same effect, shape and strength, in another clip of the same cloth."""
        other = copy.copy(self)
        other.reference = reference
        return other

    def parameters(self) -> dict[str, object]:
        """Numbers of the effect as JSON values, for the label."""
        return {"strength": self.strength}

    def comparable(self) -> dict[str, float]:
        """Parameters that mean the same as the catalogue's of that name, for the magnitude."""
        return {}

    # Mechanics and actuation.
    def begin(self) -> None:
        """Forget everything before a simulation starts."""

    def acceleration(self, now: StepContext) -> Tensor | None:
        """Force per mass (N, 3) [m/s²] at the positions and velocities of ``now``, or None."""
        return None

    def elements(self, elements: Elements, now: StepContext) -> Elements:
        """Stiffness factors and rest shape of this step; rest_straight_angles must stay 0."""
        return elements

    def masses(self, masses: Tensor, places: Tensor) -> Tensor:
        """Masses (N,) [kg]; places (N, 2) as fractions of the cloth."""
        return masses

    def gravity(self, gravity: Tensor) -> Tensor:
        """True gravity (3,) [m/s²] for the declared one."""
        return gravity

    def boundary(self, times: Tensor) -> Tensor | float:
        """Displacement of the pinned vertices beside their motion (T, n_pinned, 3) [m] at times (T,) [s]."""
        return 0.0

    def frame_interval(self, interval: float) -> float:
        """True time between frames [s] for the declared one."""
        return interval

    # Camera, appearance, observation.
    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """Where points are seen (..., 2) [px] that the declared camera projects to ``pixels``."""
        return pixels

    def brightness(self, normals: Tensor) -> Tensor | None:
        """Factor on the colour (...,) for unit normals (..., 3) towards the camera, or None."""
        return None

    def exposure(self) -> float:
        """Time over which a frame gathers light, as a fraction of the interval."""
        return 0.0

    def mask(self, mask: Array, frame: int) -> Array:
        """Mask (h, w) that is written for the true one."""
        return mask

    def cover(self, rgb: Array, mask: Array, frame: int) -> Array:
        """Image (h, w, 3) with what stands before the cloth."""
        return rgb

    # Where it acts.
    def where(self, places: Tensor) -> Tensor | None:
        """Vertices (N,), bool, that it acts on; None for all of them."""
        return None

    def when(self, times: Tensor) -> Tensor | None:
        """Frames (F,), bool, in which it acts; None for all of them."""
        return None


def places_on(grid: tuple[int, int]) -> Tensor:
    """Vertices of a grid as fractions of the cloth along axis 0 and 1, (H·W, 2), float64."""
    u, v = (torch.linspace(0, 1, n, dtype=torch.float64) for n in grid)
    return torch.stack(torch.meshgrid(u, v, indexing="ij"), -1).reshape(-1, 2)


def places_of(now: StepContext) -> Tensor:
    """Vertices of the simulated cloth as fractions (N, 2)."""
    assert now.cloth.grid is not None
    return places_on(now.cloth.grid)


def pulse(times: Tensor, begin: float, end: float, ramp: float) -> Tensor:
    """Smooth 0 → 1 → 0 with ramps of the given length inside [begin, end]; all in s."""

    def smooth(x: Tensor) -> Tensor:
        x = x.clamp(0, 1)
        return x * x * (3 - 2 * x)

    return smooth((times - begin) / ramp) * smooth((end - times) / ramp)


def unit(vector: Array) -> Tensor:
    """Unit vector (3,), float64."""
    return torch.from_numpy(np.asarray(vector, np.float64) / np.linalg.norm(vector))
