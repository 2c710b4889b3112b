"""How large a cloth seems to become while what holds it stands still.

One camera sees angles: a cloth that becomes smaller looks like one that moves away. Tracking, whose cloth
keeps its lengths, moves it away, holders and all. Where nobody moved the holders they have stayed, so what
seems to have become of their distance has become of the sides of the cloth: they shrink, or the camera zooms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.session_stages import SeenClip

Array = NDArray[np.float64]

_FEWEST = 9
"""Frames, so that a third and a tenth of them are some."""


def change_of_size(clip: SeenClip) -> float | None:
    """Share by which the sides seem to have changed in a clip, negative where they shrink.

    None where somebody moved what holds the cloth, where nothing does, or where too few frames are tracked.
    """
    scene = clip.problem.scene
    pinned = list(scene.pinned_vertices)
    if not clip.held_still or not pinned or clip.n_frames < _FEWEST:
        return None
    at = scene.template.reshape(-1, 3)[pinned].numpy().astype(np.float64)
    return seen_change(clip.tracked.positions[: clip.n_frames, pinned], at)


def seen_change(tracked: Array, at: Array) -> float:
    """The same from tracked positions of holders (F, P, 3) [m], the camera in the origin.

    From the first tenth of the frames to the last third, along the lines of sight, by as much as all holders
    do: one that slips towards the camera alone changes nothing.

    Args:
        tracked: F of at least _FEWEST.
        at: where they are (P, 3) [m].
    """
    distance = np.linalg.norm(at, axis=-1)
    along = (tracked * (at / distance[:, None])).sum(-1) / distance
    first = np.median(along[: max(3, len(along) // 10)], axis=0)
    sides = first / np.median(along[-(len(along) // 3) :], axis=0) - 1
    if np.ptp(np.sign(sides)) > 0:
        return 0.0
    return float(sides[np.abs(sides).argmin()])
