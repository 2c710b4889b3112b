"""Temporal smoothing of a prediction by a Gaussian over a few frames.

Li et al. (3DV 2021, section 4), after Habermann et al., DeepCap: a Gaussian filter of 5 frames. It acts on
what the networks state and not on the vertices, so that a body stays posed by its skeleton; angles are
averaged as rotations, so that π and -π are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import roma
import torch
from torch import Tensor

from toile.capture.body.limits import AXES, rotation_of_angles
from toile.capture.prediction import Prediction
from toile.errors import InputError
from toile.limits import Count, Positive


@dataclass(frozen=True)
class SmoothingSettings:
    """Settings of the filter.

    Attributes:
        frames: width of the filter, odd; 5 in the paper, 1 for none.
        deviation: of the Gaussian in frames; ours.
    """

    frames: Count = 5
    deviation: Positive = 1.0

    def __post_init__(self) -> None:
        if self.frames % 2 == 0:
            raise InputError(
                "Filter has no middle",
                where="smoothing.frames",
                expected="an odd number of frames",
                got=str(self.frames),
            )

    def weights(self) -> Tensor:
        """(frames,), float64, sum 1."""
        away = torch.arange(self.frames, dtype=torch.float64) - self.frames // 2
        weights = torch.exp(-0.5 * (away / self.deviation).square())
        return weights / weights.sum()


def smoothed_values(values: Tensor, settings: SmoothingSettings) -> Tensor:
    """Values (F, ...) averaged over neighbouring frames; at the ends over those that are there."""
    weights, half = settings.weights().to(values), settings.frames // 2
    total, counted = torch.zeros_like(values), values.new_zeros(len(values))
    for shift in range(-half, half + 1):
        weight = weights[shift + half]
        to = slice(max(0, -shift), len(values) - max(0, shift))
        of = slice(max(0, shift), len(values) - max(0, -shift))
        if to.start < (to.stop or 0):
            total[to] = total[to] + weight * values[of]
            counted[to] += weight
    return total / counted.reshape(-1, *(1,) * (values.ndim - 1))


def smoothed_angles(angles: Tensor, settings: SmoothingSettings) -> Tensor:
    """Euler angles (F, ..., 3) [rad] of averaged rotations: the chordal mean, nearest to the mean matrix.

    Whole turns of the angles given are lost, those of the answer are within -π to π.
    """
    if settings.frames == 1:
        return angles
    mean = smoothed_values(rotation_of_angles(angles), settings)
    found: Tensor = roma.rotmat_to_euler(AXES, roma.special_procrustes(mean))
    return found


def smoothed(prediction: Prediction, settings: SmoothingSettings | None = None) -> Prediction:
    """The prediction with θ, α, A as rotations and T and the translation as vectors averaged over frames.

    Rotations that differ by half a turn have no mean; networks state nothing like it from frame to frame.
    """
    settings = settings or SmoothingSettings()
    if settings.frames == 1:
        return prediction
    A, T = prediction.A, prediction.T
    return replace(
        prediction,
        angles=smoothed_angles(prediction.angles, settings),
        root=smoothed_angles(prediction.root, settings),
        A=None if A is None else smoothed_angles(A, settings),
        T=None if T is None else smoothed_values(T, settings),
        translation=smoothed_values(prediction.translation, settings),
    )
