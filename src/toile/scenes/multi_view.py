"""Loading what several cameras recorded, in the native layout or in that of EasyMocap."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from toile.errors import InputError
from toile.scenes.easymocap import is_easymocap, survey_easymocap
from toile.scenes.findings import Severity, require
from toile.scenes.native import survey_multi_view
from toile.scenes.views import MultiView


def load_multi_view(
    folder: Path | str, *, n_frames: int | None = None, fps: float | None = None, up: str = "z"
) -> MultiView:
    """Load a recording by several cameras.

    Args:
        folder: with scene.json that holds ``cameras``, or with EasyMocap's intri.yml and extri.yml.
        n_frames: load only the first ones; None for all.
        fps: frames per second; needed where the layout does not say (EasyMocap).
        up: axis of EasyMocap's world that points up, "z" or "y".

    Returns:
        The recording; its world has y up.

    Raises:
        InputError: the first thing that is wrong.
    """
    folder = Path(folder)
    if (folder / "scene.json").is_file() or not is_easymocap(folder):
        recording, findings = survey_multi_view(folder, n_frames=n_frames)
        if recording is not None and fps is not None:
            recording = replace(recording, fps=float(fps))
    elif fps is None:
        raise InputError(
            "Frame rate is not known",
            where=str(folder),
            expected="fps, since calibrations do not say it",
            got="none",
        )
    else:
        recording, findings = survey_easymocap(folder, fps=fps, n_frames=n_frames, up=up)
    notes = tuple(str(f) for f in require(findings) if f.severity is Severity.WARNING)
    assert recording is not None
    return replace(recording, notes=notes)
