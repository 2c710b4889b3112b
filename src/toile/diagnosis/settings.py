"""Settings of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from pydantic import Field

from toile.diagnosis.attachment_slip import SlipSettings
from toile.diagnosis.brightness_cue import BrightnessSettings
from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.decision import Weights
from toile.diagnosis.evidence import EvidenceSettings
from toile.diagnosis.findings import WIDENED
from toile.diagnosis.numerics import StepRefinement
from toile.diagnosis.outline_cue import OutlineSettings
from toile.diagnosis.refits import RefitSettings
from toile.diagnosis.sharpness import ExposureSettings
from toile.diagnosis.shooting import ShootingSettings
from toile.diagnosis.shrinkage import PredictionSettings
from toile.diagnosis.tracked import CoarseTracking
from toile.diagnosis.verdict import VerdictSettings
from toile.limits import Count, CountOrZero, Fraction, Positive, Seed, Unit
from toile.reconstruction.lost_cloth import LEAST

Side = Annotated[int, Field(ge=3)]
"""Vertices along a side of a grid."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """How a clip is diagnosed.

    Attributes:
        sides: vertices along each side of the model's grids, coarse to fine; the scene's own at most.
        held_out: share of the frames at the end that nothing is fitted to.
        coarse: the first pass of tracking; None for none.
        shooting: windows and priors.
        stiffness: start values Y [N/m], S per cell area [N/m] and B [N·m]: the same fabric on every grid.
        longest_substep: of the base model [s].
        refinement: of those steps until shorter ones change nothing; None to measure their error only.
        usual_discrepancy: that a right model still needs; beyond it something is missing.
        usual_cost: of the images that a right model leaves, per fitted frame; if the best one leaves more,
            what speaks for an effect counts for less, and ``none`` is no proof that nothing is missing.
        refitted: how many effects that move the cloth are fitted on their own, the best-scoring first: in a
            first pass, in a second one, and so on.
        base_refits: of the base model at most, with forces of the size that it needs.
        weights: what evidence from fitted windows and that prediction count for.
        compared: effects whose prediction of held-out frames is measured.
        placebos: force fields without meaning that are fitted and predicted beside them.
        seed: of everything random.
        fewest_frames: that are fitted at least; a clip with fewer is refused, and as many are used whatever
            is lost.
        least_overlap: of the outline with the mask, as a share of frame 0's; with less the cloth is lost.
        outline: camera and mask, see OutlineSettings.
        brightness: light, see BrightnessSettings.
        exposure: see ExposureSettings.
        attachment_slip: see SlipSettings.
        evidence: of effects that move the cloth, see EvidenceSettings.
        refits: see RefitSettings.
        prediction: see PredictionSettings.
        widened: factor by which intervals of the linearised model are too narrow.
        verdict: when an answer is given, see VerdictSettings.
        calibration: file that makes probabilities of evidence, of ``toile calibrate``; None for the package's
            own.
    """

    sides: Annotated[tuple[Side, ...], Field(min_length=1), Unit("vertices")] = (20,)
    held_out: Annotated[float, Field(ge=0, lt=1)] = 0.25
    coarse: CoarseTracking | None = field(default_factory=CoarseTracking)
    shooting: ShootingSettings = field(default_factory=ShootingSettings)
    stiffness: tuple[Positive, Positive, Positive] = (850.0, 2.8, 5.3e-5)
    longest_substep: Annotated[Positive, Unit("s")] = 0.005
    refinement: StepRefinement | None = None
    usual_discrepancy: Discrepancy = field(default_factory=lambda: Discrepancy(1.6, 0.1))
    usual_cost: Positive = 15.0
    refitted: tuple[CountOrZero, ...] = (5, 2)
    base_refits: CountOrZero = 4
    weights: Weights = field(default_factory=Weights)
    compared: CountOrZero = 3
    placebos: CountOrZero = 3
    seed: Seed = 0
    fewest_frames: Annotated[Count, Unit("frames")] = 6
    least_overlap: Fraction = LEAST
    outline: OutlineSettings = field(default_factory=OutlineSettings)
    brightness: BrightnessSettings = field(default_factory=BrightnessSettings)
    exposure: ExposureSettings = field(default_factory=ExposureSettings)
    attachment_slip: SlipSettings = field(default_factory=SlipSettings)
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    refits: RefitSettings = field(default_factory=RefitSettings)
    prediction: PredictionSettings = field(default_factory=PredictionSettings)
    widened: Positive = WIDENED
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    calibration: str | None = None
