"""What the images say without a model of the motion: outline, brightness, sharpness, pinned vertices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.attachment_slip import SlipFit, slip_evidence
from toile.diagnosis.brightness_cue import BrightnessFit, brightness_evidence, measured_brightness
from toile.diagnosis.findings import Finding, finding
from toile.diagnosis.outline_cue import OutlineFit, outline_evidence, template_outline
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.sharpness import ExposureFit, exposure_evidence, smear
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import BrightnessEffect, CameraEffect, Effect, ExposureEffect, MaskEffect
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]


def image_findings(
    reconstruction: Reconstruction, positions: Array, effects: Sequence[Effect], settings: DiagnosisSettings
) -> dict[str, Finding]:
    """Findings of the effects that leave a trace of their own in the images, by name.

    Args:
        reconstruction: its scene and renderer are used.
        positions: tracked, of the first frames (F, N, 3) [m].
        effects: candidates; those that act through the motion alone are passed over.
        settings: of the cues.
    """
    scene = reconstruction.scene
    outline = template_outline(scene, settings.outline)
    seen = measured_brightness(reconstruction, positions, settings.brightness)
    findings = {}
    for effect in effects:
        fit: OutlineFit | BrightnessFit | ExposureFit | SlipFit
        if isinstance(effect, CameraEffect | MaskEffect):
            fit = outline_evidence(effect, scene, outline, settings.outline)
        elif isinstance(effect, BrightnessEffect):
            fit = brightness_evidence(effect, seen, settings.brightness)
        elif isinstance(effect, ExposureEffect):
            fit = exposure_evidence(effect, smear(reconstruction, positions, settings.exposure))
        elif isinstance(effect, AnchorSlip):
            pinned = list(scene.pinned_vertices)
            pull = positions[0].mean(0) - positions[0][pinned]
            fit = slip_evidence(effect, positions[:, pinned], scene.fps, pull, settings.attachment_slip)
        else:
            continue
        findings[effect.NAME] = finding(effect, fit.log_evidence, fit.mean, fit.covariance)
    return findings
