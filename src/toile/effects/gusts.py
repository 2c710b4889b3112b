"""Gusts: wind that comes and goes, on every vertex alike or harder on what faces it."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.effects.base import Amount, ForceEffect, Parameter, Scope, Stage, Surroundings, VertexEffect
from toile.errors import InputError
from toile.geometry.horizontal import horizontal_axes
from toile.limits import Count
from toile.physics.step_terms import StepContext

USUAL_MODES = 6
"""Per horizontal direction, where neither a number is given nor the length of the clips is known."""

HIGHEST = 3.0
"""Frequency [Hz] up to which clips have modes where their number is not given."""


def _parameters(n_modes: int, longest: int = 1) -> tuple[Parameter, ...]:
    """Of ``longest`` to ``n_modes`` half waves; 0 is the mean."""
    return tuple(
        Parameter(
            f"{axis}_{k}",
            "m/s²",
            -50.0,
            50.0,
            1.0,
            f"{f'amplitude of {k} half waves' if k else 'mean'}, {what}",
        )
        for axis, what in (
            ("x", "the camera's x axis made horizontal"),
            ("z", "the horizontal one across it"),
        )
        for k in range(longest, n_modes + 1)
    )


def half_waves(duration: float) -> int:
    """How many of them, one at least, reach HIGHEST in so long a clip [s]."""
    # A product such as 6 × 1.5 s may come out a hair above the whole number.
    return max(1, math.ceil(2 * HIGHEST * duration - 1e-6))


class Gusts(ForceEffect):
    """Uniform horizontal acceleration Σ a_k cos(π k t / T) over a clip of length T, of zero mean.

    Its mean over the clip is the constant wind of the fit and left to that; in still air there is none, and
    the mean is a mode of its own, k = 0 (``in_still_air``). k half waves have the frequency k / (2 T), so a
    number of modes that is enough for a short clip is too small for a long one. Those of a session push
    harder what faces them, see FacingGusts.

    Args:
        values: see Effect.
        n_modes: per horizontal direction; None for 6, or as many as ``for_clip`` finds.

    Raises:
        InputError: there are no modes, or values of others.
    """

    NAME: ClassVar[str] = "gusts"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    SCOPE: ClassVar[Scope] = Scope.CLIP
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = _parameters(USUAL_MODES)
    SOURCE: ClassVar[str] = (
        "wind velocity as a sum of harmonics: Shinozuka and Deodatis, Simulation of Stochastic Processes by "
        "Spectral Representation, Applied Mechanics Reviews 44(4), 1991"
    )

    def __init__(self, values: Mapping[str, float] | None = None, n_modes: Count | None = None) -> None:
        if n_modes is not None and n_modes < 1:
            raise InputError(
                "gusts: too few modes", where="effect=gusts", expected="n_modes >= 1", got=str(n_modes)
            )
        self._given = n_modes is not None
        self._longest = 1
        self._parameters = _parameters(USUAL_MODES if n_modes is None else n_modes)
        super().__init__(values)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return self._parameters

    def for_clip(self, duration: float) -> Self:
        """See Effect: modes up to 3 Hz where no number of them was given; amplitudes stay as they are."""
        if self._given:
            return self
        amplitudes = self.values.reshape(2, -1)
        acting = [k + self._longest for k in range(amplitudes.shape[1]) if bool(amplitudes[:, k].any())]
        n_modes = max([half_waves(duration), *acting])
        values = amplitudes.new_zeros(2, n_modes + 1 - self._longest)
        n_kept = min(values.shape[1], amplitudes.shape[1])
        values[:, :n_kept] = amplitudes[:, :n_kept]
        other = copy.copy(self)
        other._parameters = _parameters(n_modes, self._longest)
        return other.with_values(values.reshape(-1))

    def in_detail(self) -> FacingGusts:
        """See Effect: harder on what faces them, by a share that a session finds."""
        return FacingGusts(self)

    def in_still_air(self) -> Self:
        """See Effect: with a mean, which acts in clips whose Surroundings say so."""
        if not self._longest:
            return self
        amplitudes = self.values.reshape(2, -1)
        other = copy.copy(self)
        other._longest = 0
        other._parameters = _parameters(amplitudes.shape[1], 0)
        return other.with_values(torch.cat((amplitudes.new_zeros(2, 1), amplitudes), 1).reshape(-1))

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: the strongest that blows at a frame, beside the clip's wind."""
        strongest = self.acceleration(times, around).norm(dim=-1).max()
        return (Amount("strongest gust", float(strongest), "m/s²"),)

    def acceleration(self, times: Tensor, around: Surroundings) -> Tensor:
        """See ForceEffect."""
        waves = self.waves(times, _length(around), still_air=around.still_air)
        return (waves @ self.values.reshape(2, -1).T @ horizontal_axes(around.gravity))[:, None]

    def waves(self, times: Tensor, length: float, *, still_air: bool) -> Tensor:
        """Of every amplitude of a direction at times (T,) [s], (T, n_modes).

        Args:
            times: since frame 0.
            length: of the clip [s].
            still_air: see Surroundings.
        """
        k = self._longest + torch.arange(len(self.values) // 2, dtype=torch.float64)
        modes = torch.cos(torch.pi * k * times[:, None] / length)
        if not self._longest and not still_air:
            # The wind of the fit has it.
            modes = modes * (k > 0)
        return modes


# Its bounds say what is known of it; the prior between them is as good as even.
_FACING = Parameter(
    "facing_beyond_half", "1", -0.5, 0.5, 1.0, "share that only pushes what faces it, beyond one half"
)


class FacingGusts(VertexEffect):
    """Gusts that push harder what faces them: per mass (1 - f) a + f n (n·a), with the normals n.

    a is the acceleration of Gusts. Moving air pushes a surface mostly along its normal (f = 1), rubs along it
    and flows around it (f < 1); how much of each nobody knows, so the share f is found as well, from one half
    on. Normals are those at the step's begin, so that the potential is linear in the new positions.

    Args:
        gusts: of which they are made, with its amplitudes.
    """

    NAME: ClassVar[str] = Gusts.NAME
    STAGE: ClassVar[Stage] = Gusts.STAGE
    SCOPE: ClassVar[Scope] = Gusts.SCOPE
    quadratic: ClassVar[bool] = True
    past_reach: ClassVar[int] = 1
    own_past: ClassVar[bool] = True
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = (*Gusts.PARAMETERS, _FACING)
    SOURCE: ClassVar[str] = (
        f"{Gusts.SOURCE}; on surfaces: Baraff and Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998"
    )

    def __init__(self, gusts: Gusts) -> None:
        self._gusts = gusts
        self._axes = torch.zeros(2, 3, dtype=torch.float64)
        self._length = 0.0
        self._still_air = False
        super().__init__()
        self.values = torch.cat((gusts.values, torch.zeros(1, dtype=torch.float64)))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        return (*self._gusts.parameters, _FACING)

    def for_clip(self, duration: float) -> Self:
        """See Gusts."""
        return self._of(self.alike().for_clip(duration))

    def in_still_air(self) -> Self:
        """See Gusts."""
        return self._of(self.alike().in_still_air())

    def in_clip(self, around: Surroundings) -> Self:
        """See Effect."""
        other = copy.copy(self)
        other._axes, other._length = horizontal_axes(around.gravity), _length(around)
        other._still_air = around.still_air
        return other

    def place(self) -> dict[str, NDArray[np.float64]]:
        """See Effect."""
        if not self._length:
            return {}
        return {
            "axes": self._axes.numpy(),
            "length": np.array([self._length]),
            "still_air": np.array([float(self._still_air)]),
        }

    def placed(self, place: Mapping[str, NDArray[np.float64]]) -> Self:
        """See Effect."""
        if not place:
            return self
        other = copy.copy(self)
        other._axes = torch.from_numpy(np.array(place["axes"], np.float64))
        other._length = float(place["length"][0])
        other._still_air = bool(place["still_air"][0])
        return other

    def amounts(
        self, around: Surroundings, material: Mapping[str, float], times: Tensor
    ) -> tuple[Amount, ...]:
        """See Effect: the strongest that blows at a frame, where the cloth faces it."""
        return self.alike().amounts(around, material, times)

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm.

        Raises:
            ValueError: nobody has said in which clip, see ``in_clip``.
        """
        acceleration = self._waves(now) @ self.values[:-1].reshape(2, -1).T @ self._axes
        moved, share = positions - now.positions, 0.5 + self.values[-1]
        across = (now.normals @ acceleration) * (now.normals * moved).sum(-1)
        return -now.cloth.masses * ((1 - share) * (moved @ acceleration) + share * across)

    def force_derivatives(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexEffect."""
        waves, share = self._waves(now), 0.5 + self.values[-1]
        across = (now.normals @ self._axes.T).T[:, :, None] * now.normals
        along = self._axes[:, None].expand_as(across)
        by_direction = (1 - share) * along + share * across
        by_amplitude = (waves[:, None, None] * by_direction[:, None]).flatten(0, 1)
        blowing = self.values[:-1].reshape(2, -1) @ waves
        by_share = torch.einsum("d,dni->ni", blowing, across - along)
        return now.cloth.masses[:, None] * torch.cat((by_amplitude, by_share[None]))

    def _waves(self, now: StepContext) -> Tensor:
        """Of every amplitude of a direction at the end of a step, (n_modes,)."""
        if not self._length:
            raise ValueError("gusts: expected to be told in which clip they blow")
        time = torch.tensor([now.time], dtype=torch.float64)
        return self._gusts.waves(time, self._length, still_air=self._still_air)[0]

    def alike(self) -> Gusts:
        """Gusts with these amplitudes that push all of the cloth alike."""
        return self._gusts.with_values(self.values[:-1])

    def _of(self, gusts: Gusts) -> Self:
        """The same with other modes."""
        other = copy.copy(self)
        other._gusts = gusts
        other.values = torch.cat((gusts.values, self.values[-1:]))
        return other


def _length(around: Surroundings) -> float:
    """Of a clip [s], also where fps is a mean."""
    return (around.n_frames - 1) / around.fps
