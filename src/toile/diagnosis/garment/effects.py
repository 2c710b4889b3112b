"""The effects that a model of a person in a garment may lack."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from toile.diagnosis.garment.scene import Scene
from toile.effects.base import Stage


@dataclass(frozen=True)
class Effect:
    """One number of the scene that may be wrong.

    A coefficient of 1 changes that number by ``size``; it is the usual size, the unit of the prior.

    Attributes:
        field: of the scene.
        size: usual deviation, and the difference up and down of the alias table.
        words: that size in words.
        unit: in which numbers are shown.
        shown: by what a change of the field is multiplied for that.
        lowest: value that the field can have.
        stage: where between forces and pixels it acts.
        source: where it comes from.
        chord: coefficients between which the answer is measured. What moves the cloth little needs a wide
            one: wrinkles answer to anything, by chance, and a narrow difference measures them.
    """

    field: str
    size: float
    words: str
    unit: str
    shown: float
    lowest: float
    stage: Stage
    source: str
    chord: tuple[float, float] = (-1.0, 1.0)

    def changed(self, scene: Scene, coefficient: float) -> Scene:
        """The scene with so much more of it."""
        return scene.changed(self.field, self.size * coefficient)

    def in_units(self, coefficient: float) -> float:
        """A coefficient as it is shown, in ``unit``."""
        return coefficient * self.size * self.shown

    def least(self, scene: Scene) -> float:
        """Smallest coefficient that the scene allows."""
        return (self.lowest - float(getattr(scene, self.field))) / self.size


EFFECTS: Mapping[str, Effect] = {
    "mask_bias": Effect(
        "bias",
        0.5,
        "half a pixel",
        "px",
        1.0,
        -math.inf,
        Stage.OBSERVATION,
        "segmentation that cuts too wide or too narrow; toile.effects.mask_bias for a cloth alone",
    ),
    "body_friction": Effect(
        "friction",
        0.3,
        "of 0.3",
        "times the model's",
        1.0,
        0.0,
        Stage.MECHANICS,
        "Coulomb's law between cloth and body, as the layer has it",
        (-3.0, 3.0),
    ),
    "pose_error": Effect(
        "thigh",
        math.radians(2.0),
        "2 degrees of both thighs",
        "degrees",
        180 / math.pi,
        -math.inf,
        Stage.ACTUATION,
        "depth of a knee that one camera does not see (Li et al., 3DV 2021, PoseNet)",
    ),
    "body_shape": Effect(
        "girth",
        0.004,
        "4 mm of hips and legs",
        "mm",
        1e3,
        -math.inf,
        Stage.ACTUATION,
        "a template of another person, or of a dressed one",
    ),
    "garment_stiffness": Effect(
        "stiffness",
        0.3,
        "of 500 N/m and 1e-5 J",
        "times the model's",
        1.0,
        # A cloth without stiffness has no solution.
        0.05,
        Stage.MECHANICS,
        "Young's modulus and bending rigidity of another fabric, by the same factor",
        (-2.0, 3.0),
    ),
    "waist_slip": Effect(
        "slip",
        0.008,
        "8 mm downwards",
        "mm downwards",
        1e3,
        -math.inf,
        Stage.ACTUATION,
        "a waistband that is not where it was when the person was measured",
    ),
    "air_drag": Effect(
        "drag",
        0.4,
        "0.4 1/s across the cloth",
        "1/s",
        1.0,
        0.0,
        Stage.MECHANICS,
        "Baraff and Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998; toile.effects.air_drag",
        (-1.25, 5.0),
    ),
}
"""By name. Usual sizes are ours, those of the alias table (benchmarks/capture_aliases.py)."""
