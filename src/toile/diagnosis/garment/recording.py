"""A diagnosis of a clip of a data set of people, in one of its cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toile.capture.body.subject import Subject
from toile.capture.data.clips import TRUTH_FILE, Truth
from toile.capture.garments import Garment, attached_targets
from toile.diagnosis.garment.bodies import TrackedBody
from toile.diagnosis.garment.diagnosis import Calibration, MadeWith, diagnose
from toile.diagnosis.garment.fit import ClipFitting, FitSettings
from toile.diagnosis.garment.masks import SmoothedAreas
from toile.diagnosis.garment.responses import measure_responses
from toile.diagnosis.garment.rollout import SETTLED, Discretisation, RollOuts
from toile.diagnosis.garment.scene import Scene
from toile.errors import InputError
from toile.limits import Count
from toile.progress import Report, silent
from toile.scenes.multi_view import load_multi_view
from toile.scenes.views import View

Floats = NDArray[np.float64]

FEWEST = SETTLED + 3
"""Frames of a clip: two to fit and one to hold out, once the garment has settled."""

_AT_REST = 0.01
"""How far the waistband may be from where it is at rest when the clip begins [m]."""


@dataclass(frozen=True)
class RecordingSettings:
    """How a clip is diagnosed.

    Attributes:
        fits: see FitSettings.
        substeps: of the model, per frame.
    """

    fits: FitSettings
    substeps: Count = 2


def diagnose_clip(
    clip: Path, view: int, n_frames: int | None, settings: RecordingSettings, report: Report = silent
) -> dict[str, Any]:
    """Say what the model of a clip lacks.

    The model is the data set's garment with its own material, on the clip's body.

    Args:
        clip: folder with scene.json and truth.npz; subject.npz and garment.npz lie beside it.
        view: number of the camera whose masks are used; nothing else of the images is.
        n_frames: only so many; all if None.
        settings: see RecordingSettings.
        report: progress.

    Returns:
        JSON values: see ``GarmentDiagnosis.to_dict``, and what the calibration was not made for.

    Raises:
        InputError: no such camera, no masks, too few frames, no clip of a data set, or one that does not
            begin at rest.
    """
    truth = Truth.load(clip / TRUTH_FILE)
    subject = Subject.load(clip.parent / "subject.npz")
    garment = Garment.load(clip.parent / "garment.npz")
    recording = load_multi_view(clip)
    if not 0 <= view < len(recording.views):
        raise InputError(
            "No such camera", where="view", expected=f"0 to {len(recording.views) - 1}", got=str(view)
        )
    seen = recording.views[view]
    frames = min(truth.n_frames, seen.n_frames, truth.n_frames if n_frames is None else n_frames)
    if frames < FEWEST:
        raise InputError(
            "Too few frames", where=str(clip), expected=f"{FEWEST} or more to diagnose", got=str(frames)
        )
    body = torch.from_numpy(truth.body_positions[:frames])
    tracked = TrackedBody(subject, body, float(garment.rest_vertices[:, 1].max()))
    _check_rest(clip, subject, garment, body)
    model = Discretisation(settings.substeps)
    look = RollOuts(subject, garment, tracked, [seen.camera], truth.fps, model, kept=4)
    form = SmoothedAreas()
    observed = form(observed_masks(clip, seen, frames)[None])
    calibration = Calibration.load()
    responses = measure_responses(look, Scene(), form, report)
    report("fits", 0, None)
    fitting = ClipFitting(look, Scene(), responses, observed, calibration.errors[1], form, settings.fits)
    made_with = MadeWith(
        seen.camera.width,
        frames,
        truth.fps,
        len(garment.rest_vertices),
        garment.name,
        settings.substeps,
    )
    differences = made_with.differences(calibration.made_with)
    return {
        "clip": clip.name,
        "view": view,
        "frames": frames,
        "calibrated": not differences,
        "not_as_calibrated": list(differences),
        **diagnose(fitting, calibration.weights).to_dict(),
    }


def observed_masks(clip: Path, seen: View, frames: int) -> Floats:
    """Binary masks of person and garment, without the frames that settle (2, F, h, w).

    Raises:
        InputError: there are none, or one cannot be read.
    """
    for kind, paths in (("person", seen.mask_paths), ("garment", seen.garment_mask_paths)):
        if len(paths) < frames:
            raise InputError(
                f"Masks of the {kind} are missing",
                where=f"{clip}: camera {seen.name}",
                expected=f"{frames}, one per frame",
                got=str(len(paths)),
            )
    kept = range(SETTLED, frames)
    pairs = ([read(f).numpy() for f in kept] for read in (seen.mask, seen.garment_mask))
    return np.stack([np.stack(masks) > 0.5 for masks in pairs]).astype(np.float64)


def _check_rest(clip: Path, subject: Subject, garment: Garment, body: torch.Tensor) -> None:
    """A garment whose start is not known starts at rest, and so must the body."""
    held = attached_targets(garment, body[0], subject.faces)
    farthest = float((held - garment.rest_vertices[garment.attached]).norm(dim=-1).max())
    if farthest > _AT_REST:
        raise InputError(
            "Clip does not begin at rest",
            where=f"{clip}: frame 0",
            expected=f"a waistband within {1e3 * _AT_REST:g} mm of where the garment was made",
            got=f"{1e3 * farthest:.0f} mm",
        )
