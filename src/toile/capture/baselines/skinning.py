"""The garment goes with the body and does nothing else."""

from __future__ import annotations

from dataclasses import replace

from toile.capture.prediction import Prediction


def skinned(prediction: Prediction) -> Prediction:
    """The prediction without deformation of the garment, A = T = none."""
    return replace(prediction, A=None, T=None)
