"""What the stages of a diagnosis find, in the order in which they come."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import BaseFit
from toile.diagnosis.continuity import Discrepancy, Link, WindowSystem
from toile.diagnosis.findings import Finding, Screening
from toile.diagnosis.gap_maps import GapMaps
from toile.diagnosis.record import Shrink
from toile.diagnosis.refits import Race, Refit
from toile.diagnosis.shooting import Base, WindowMotion
from toile.diagnosis.shrinkage import HeldOut
from toile.physics.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrackedMotion:
    """What tracking has found.

    Attributes:
        positions: of all frames on the scene's grid (F, N, 3) [m].
    """

    positions: Array


@dataclass(frozen=True)
class Seen:
    """What is known without a model of the motion.

    Attributes:
        known: frames in which the tracked motion is that of the cloth; what comes after is none.
        findings: from the outline of frame 0, brightness, sharpness and the paths of the pinned vertices.
    """

    known: int
    findings: dict[str, Finding]


@dataclass(frozen=True, eq=False)
class BaseModel:
    """The base fit.

    Attributes:
        fit: see BaseFit.
        halvings: how often the time step was halved for it.
        systems: around it, without effects.
    """

    fit: BaseFit
    halvings: int
    systems: list[WindowSystem]


@dataclass(frozen=True, eq=False)
class ConvergedBase:
    """The base model with forces of the size that it needs.

    Attributes:
        fit: see BaseFit.
        systems: around it, with the coefficients of all effects.
        screening: what effects gain to first order around there.
    """

    fit: BaseFit
    systems: list[WindowSystem]
    screening: Screening


@dataclass(frozen=True)
class WindowPredictions:
    """What refitted effects predict.

    Attributes:
        gains: logarithm by which each predicts windows better than the base model.
        sizes: how far each moves the cloth, over the cloth's width.
    """

    gains: dict[str, float]
    sizes: dict[str, float]


@dataclass(frozen=True)
class StepError:
    """What half the time step changes.

    Attributes:
        distance: mean [m].
    """

    distance: float


@dataclass(frozen=True)
class StageResults:
    """What all stages have found.

    Attributes:
        tracked: see TrackedMotion.
        seen: see Seen.
        used: frames that were fitted.
        base: the base model.
        converged: the same with forces of the size that it needs.
        race: refitted effects.
        predictions: by those.
        step_error: see StepError.
        held_out: prediction of frames that no fit has seen.
        maps: where the base model departs from the motion.
    """

    tracked: TrackedMotion
    seen: Seen
    used: int
    base: BaseModel
    converged: ConvergedBase
    race: Race
    predictions: WindowPredictions
    step_error: StepError
    held_out: HeldOut
    maps: GapMaps


KINDS = (
    Base,
    BaseFit,
    BaseModel,
    Discrepancy,
    Finding,
    WindowPredictions,
    GapMaps,
    HeldOut,
    Link,
    Race,
    Refit,
    Screening,
    Seen,
    ConvergedBase,
    Shrink,
    State,
    StepError,
    TrackedMotion,
    WindowMotion,
    WindowSystem,
)
"""Everything that stages store."""
