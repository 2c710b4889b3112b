"""What an effect is: a few named parameters and exactly one hook through which they act.

Generator, fit and diagnosis use the same interface. An effect is immutable; ``with_values`` gives the same
effect with other values. At ``values = 0`` of its strengths it is the identity, bit for bit: hooks return
their argument itself.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.physics.cloth import Cloth
from toile.physics.step_terms import ElementTerm, StepContext, VertexTerm


class Stage(Enum):
    """Where along the way from forces to pixels an effect acts."""

    NUMERICS = "numerics"
    ACTUATION = "actuation"
    MECHANICS = "mechanics"
    CAMERA = "camera"
    APPEARANCE = "appearance"
    OBSERVATION = "observation"


class Scope(Enum):
    """What an effect belongs to: clips that share it share its parameters."""

    CLOTH = "cloth"
    DEVICE = "device"
    CLIP = "clip"


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        name: unique within the effect.
        unit: SI, "1" for pure numbers.
        low, high: bounds.
        scale: typical magnitude: standard deviation of the Gaussian prior around 0.
        doc: what it is.
    """

    name: str
    unit: str
    low: float
    high: float
    scale: float
    doc: str


class Amount(NamedTuple):
    """What the values of an effect come to, as one would measure it at the cloth.

    Attributes:
        what: in words.
        value: in the unit.
        unit: "1" for pure numbers.
    """

    what: str
    value: float
    unit: str


class Effect(ABC):
    """One physical or optical effect.

    Args:
        values: parameters by name; those left out are 0. Zeros of PARAMETERS that this instance has not are
            left out as well: configuration files list the usual ones.

    Attributes:
        NAME: in the catalogue and of the configuration file.
        STAGE: see Stage.
        SCOPE: see Scope; of the cloth where a class says nothing else.
        PARAMETERS: all of them are strengths: the effect does nothing where all are 0.
        STIFFNESS: name of the material's number against which it works, "" where it works against none.
        SOURCE: where the model is from.
        values: (n_parameters,) float64, in the order of ``parameters``; may require gradients.
    """

    NAME: ClassVar[str]
    STAGE: ClassVar[Stage]
    SCOPE: ClassVar[Scope] = Scope.CLOTH
    PARAMETERS: ClassVar[tuple[Parameter, ...]]
    STIFFNESS: ClassVar[str] = ""
    SOURCE: ClassVar[str]

    def __init__(self, values: Mapping[str, float] | None = None) -> None:
        names = [parameter.name for parameter in self.parameters]
        listed = {parameter.name for parameter in self.PARAMETERS}.difference(names)
        values = {name: v for name, v in (values or {}).items() if v != 0 or name not in listed}
        for name in values:
            if name not in names:
                raise InputError(
                    f"{self.NAME} has no such parameter",
                    where=f"effect={self.NAME}",
                    expected=", ".join(names),
                    got=name,
                )
        for parameter in self.parameters:
            value = values.get(parameter.name, 0.0)
            if not parameter.low <= value <= parameter.high:
                raise InputError(
                    f"{self.NAME}: {parameter.name} is out of bounds",
                    where=f"effect={self.NAME}",
                    expected=f"{parameter.low:g} to {parameter.high:g} {parameter.unit}",
                    got=f"{value:g}",
                )
        self.values = torch.tensor([values.get(name, 0.0) for name in names], dtype=torch.float64)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """PARAMETERS, or as many of their kind as this instance has."""
        return self.PARAMETERS

    def with_values(self, values: Tensor) -> Self:
        """The same effect with other values (n_parameters,), which may require gradients."""
        if values.shape != (len(self.parameters),):
            raise ValueError(f"values: expected ({len(self.parameters)},), got {tuple(values.shape)}")
        other = copy.copy(self)
        other.values = values
        return other

    def for_clip(self, duration: float) -> Self:
        """The same effect with as many parameters as clips of a length ask for; itself for most effects.

        Args:
            duration: from the first frame to the last one [s], of the longest clip.
        """
        return self

    def in_still_air(self) -> Self:
        """The same effect for clips some of which have no steady wind; itself for most effects."""
        return self

    def in_detail(self) -> Effect:
        """The same effect with what a session can tell apart beside; itself for most effects."""
        return self

    def in_clip(self, around: Surroundings) -> Self:
        """The same effect where it needs to know in which clip it acts; itself for most effects."""
        return self

    def deviation(self, material: Mapping[str, float]) -> float:
        """Prior deviation of the values of a cloth, in ``scales``; 1 for most effects.

        Args:
            material: of the cloth, by name.
        """
        return 1.0

    def is_possible(self, material: Mapping[str, float]) -> bool:
        """Whether a cloth can be like that; most effects within their bounds always are.

        Args:
            material: of the cloth, by name.
        """
        return True

    def place(self) -> dict[str, NDArray[np.float64]]:
        """Where this instance acts, beside its values, as arrays; {} where all of a class are alike."""
        return {}

    def placed(self, place: Mapping[str, NDArray[np.float64]]) -> Self:
        """The same effect where ``place`` of another instance says; itself for most effects."""
        return self

    def acts_on(self, around: Surroundings, motion: Tensor) -> Tensor | None:
        """How strongly it acts on every vertex (N,), at least 0, in a unit of its own.

        None for effects that act everywhere alike, as most do.

        Args:
            around: the clip.
            motion: of the cloth (F, N, 3) [m].
        """
        return None

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """What the values come to; () where they say so themselves, as most do.

        Args:
            around: the clip.
            material: of the cloth, by name.
            times: of the frames that they are known from (T,) [s]; of others they say nothing.
        """
        return ()

    def value(self, name: str) -> Tensor:
        """One parameter, ()."""
        return self.values[[parameter.name for parameter in self.parameters].index(name)]

    @property
    def is_identity(self) -> bool:
        """Whether all values are exactly 0."""
        return not bool(self.values.detach().any())

    @property
    def is_active(self) -> bool:
        """Whether it does anything, or derivatives say what it would do."""
        return self.values.requires_grad or not self.is_identity

    @property
    def scales(self) -> Tensor:
        """Prior standard deviations (n_parameters,)."""
        return torch.tensor([parameter.scale for parameter in self.parameters], dtype=torch.float64)


@dataclass(frozen=True)
class Surroundings:
    """What effects outside the step may know of a clip.

    Attributes:
        cloth: see Cloth; N vertices on a grid.
        cloth_size: rest length of the sides along axis 0 and 1 [m].
        gravity: (3,) [m/s²].
        fps: frames per second, the mean where they are unevenly spaced.
        n_frames: F.
        times: of the frames (F,) [s], the first 0; None where they are evenly spaced.
        still_air: whether there is no steady wind: then gusts have a mean of their own.
    """

    cloth: Cloth
    cloth_size: tuple[float, float]
    gravity: Tensor
    fps: float
    n_frames: int
    times: Tensor | None = None
    still_air: bool = False

    def frame_times(self) -> Tensor:
        """Times of the frames (F,) [s]."""
        if self.times is not None:
            return self.times
        return torch.arange(self.n_frames, dtype=torch.float64) / self.fps

    def held_times(self) -> Tensor:
        """Times at which forces are evaluated that are held from frame to frame (F - 1,) [s]: the middles.

        So a force that varies is neither early nor late, and one of zero mean has none.
        """
        times = self.frame_times()
        return 0.5 * (times[:-1] + times[1:])


class VertexEffect(Effect, VertexTerm):
    """Acts within a step through a potential of every vertex (drag, contact, following forces)."""

    def force_derivatives(self, positions: Tensor, now: StepContext) -> Tensor | None:
        """Derivatives of the forces by the values at positions (N, 3), (n_parameters, N, 3) [N].

        None where torch's differentiation is as fast.
        """
        return None


class ElementEffect(Effect, ElementTerm):
    """Acts within a step through stiffness factors and rest shapes (damping, stiffening, anisotropy)."""


class ForceEffect(Effect):
    """Acts through an acceleration that does not depend on the motion (gusts, tilted gravity)."""

    @abstractmethod
    def acceleration(self, times: Tensor, around: Surroundings) -> Tensor:
        """Acceleration (T, N or 1, 3) [m/s²] at times (T,) [s], beside gravity and wind."""


class MassEffect(Effect):
    """Acts through the vertex masses."""

    @abstractmethod
    def masses(self, masses: Tensor, around: Surroundings) -> Tensor:
        """Masses (N,) [kg] for nominal masses (N,)."""


class BoundaryEffect(Effect):
    """Acts through the motion of the pinned vertices."""

    @abstractmethod
    def boundary(self, boundary: Tensor, around: Surroundings) -> Tensor:
        """Pinned positions (F, n_pinned, 3) [m] for nominal ones."""


class TimeEffect(Effect):
    """Acts through the time between two frames; all of them scale like their mean."""

    @abstractmethod
    def frame_interval(self, interval: Tensor) -> Tensor:
        """True mean time between frames () [s] for the nominal one."""


class CameraEffect(Effect):
    """Acts on where a point is seen."""

    @abstractmethod
    def pixels(self, pixels: Tensor, camera: Camera) -> Tensor:
        """Where a point is seen (..., 2) [px] that the nominal camera projects to ``pixels``."""


class BrightnessEffect(Effect):
    """Acts on how bright a surface point is seen."""

    @abstractmethod
    def brightness(self, normals: Tensor, reference: Tensor) -> Tensor:
        """Factor on the colour (...,) for unit normals (..., 3), relative to the normals of frame 0.

        Normals point towards the camera; at frame 0 the factor is 1 as the texture is frame 0 itself.
        """


class ExposureEffect(Effect):
    """Acts through the time over which a frame gathers light."""

    @abstractmethod
    def exposure(self) -> Tensor:
        """Fraction () of the frame interval, centred on the frame."""


class MaskEffect(Effect):
    """Acts on the masks."""

    @abstractmethod
    def growth(self) -> Tensor:
        """Distance () [px] by which the mask's edge is moved outwards."""
