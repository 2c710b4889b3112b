"""What the stages of a diagnosis find, in the order in which they come, and the settings each depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import BaseFit
from toile.diagnosis.continuity import Discrepancy, Link, WindowSystem
from toile.diagnosis.findings import Finding, Screening
from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.gap_maps import GapMaps
from toile.diagnosis.record import Shrink
from toile.diagnosis.refits import Race, Refit
from toile.diagnosis.shooting import Base, WindowMotion
from toile.diagnosis.shrinkage import HeldOut
from toile.physics.state import State

Array = NDArray[np.float64]

TRACKING = "tracking"
IMAGES = "images"
BASE_MODEL = "base model and evidence"
CONVERGED_BASE = "converged base model"
REFITS = "refits"
WINDOW_PREDICTIONS = "window predictions"
NUMERICS = "numerics"
HELD_OUT = "held-out frames"
MAPS = "maps"
ANSWER = "answer"

FILES = {
    TRACKING: "tracked.npz",
    IMAGES: "stages/images.npz",
    BASE_MODEL: "stages/base_model.npz",
    CONVERGED_BASE: "stages/converged_base.npz",
    REFITS: "stages/refits.npz",
    WINDOW_PREDICTIONS: "stages/window_predictions.npz",
    NUMERICS: "stages/numerics.npz",
    HELD_OUT: "stages/held_out.npz",
    MAPS: "stages/maps.npz",
}
"""Where the results of the stages lie in the folder of a run; the answer follows from them at once."""

_ORDER = (*FILES, ANSWER)

# Stage that asks for a setting first; it and those after it depend on it. What is not listed counts from the
# first stage on, so a setting that somebody forgets here costs time and is never overlooked.
_FIRST_ASKED = {
    "outline": IMAGES,
    "brightness": IMAGES,
    "exposure": IMAGES,
    "attachment_slip": IMAGES,
    "sides": BASE_MODEL,
    "shooting": BASE_MODEL,
    "longest_substep": BASE_MODEL,
    "refinement": BASE_MODEL,
    "usual_discrepancy": CONVERGED_BASE,
    "base_refits": CONVERGED_BASE,
    "evidence": CONVERGED_BASE,
    "refits": CONVERGED_BASE,
    "refitted": REFITS,
    "prediction": WINDOW_PREDICTIONS,
    "placebos": HELD_OUT,
    "compared": ANSWER,  # the stage of the held-out frames is told the names
    "weights": ANSWER,
    "usual_cost": ANSWER,
    "widened": ANSWER,
    "verdict": ANSWER,
    "calibration": ANSWER,
}


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class ConvergedBase:
    """The base model with forces of the size that it needs.

    Attributes:
        fit: see BaseFit.
        systems: around it, with the columns of all effects.
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


def settings_of(stage: str, settings: Any) -> Mapping[str, str]:
    """Fingerprints of the settings (a dataclass) that a stage, or one before it, asks for."""
    asked = _ORDER[: _ORDER.index(stage) + 1]
    return {
        f"settings.{f.name}": fingerprint(getattr(settings, f.name))
        for f in fields(settings)
        if _FIRST_ASKED.get(f.name, TRACKING) in asked
    }
