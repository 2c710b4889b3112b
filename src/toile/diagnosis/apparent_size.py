"""How large a cloth seems to become while what holds it stands still.

One camera sees angles: a cloth that becomes smaller looks like one that moves away. A model whose cloth
keeps its lengths moves it away, holders and all. Where nobody moved the holders they have stayed, so what
seems to have become of their distance has become of the sides of the cloth: they shrink, or the camera zooms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.session_stages import SeenClip
from toile.scenes.scene import Scene

Array = NDArray[np.float64]

_FEWEST = 9
"""Frames, so that a third and a tenth of them are some."""

_SLIP = 2.0
"""How far a slip goes along the line of sight at most, of how far it goes across it.

Of a slip in any direction whatever in nine cases of ten: 2 / sqrt(5) of the sphere.
"""


def change_of_size(clip: SeenClip, positions: Array) -> float | None:
    """Share by which the sides seem to have changed in a clip, negative where they shrink.

    None where somebody moved what holds the cloth, where nothing does, or where too few frames are known.

    Args:
        clip: see SeenClip.
        positions: its motion, refined by the base model (F, N, 3) [m]: tracking errs by a hundredth of the
            distance on cloths that keep their size.
    """
    scene = clip.problem.scene
    if not clip.held_still or not scene.pinned_vertices or len(positions) < _FEWEST:
        return None
    return change_in(scene, positions)


def change_in(scene: Scene, positions: Array) -> float:
    """The same from a motion (F, N, 3) [m] in which the holders stand still where the template is."""
    pinned = list(scene.pinned_vertices)
    at = scene.template.reshape(-1, 3)[pinned].numpy().astype(np.float64)
    return seen_change(positions[:, pinned], at)


def seen_change(found: Array, at: Array) -> float:
    """The same from positions of holders that were found (F, P, 3) [m], the camera in the origin.

    From the first tenth of the frames to the last third, along the lines of sight, by as much as all holders
    do: one that slips towards the camera alone changes nothing. Holders that all slip move across the lines
    of sight as well, so of the change that is taken away which such a slip may have along them.

    Args:
        found: F of at least _FEWEST.
        at: where they are (P, 3) [m].
    """
    distance = np.linalg.norm(at, axis=-1)
    ray = at / distance[:, None]
    first = np.median(found[: max(3, len(found) // 10)], axis=0)
    last = np.median(found[-(len(found) // 3) :], axis=0)
    before, after = (first * ray).sum(-1), (last * ray).sum(-1)
    sides = before / after - 1
    if np.ptp(np.sign(sides)) > 0:
        return 0.0
    across = np.linalg.norm(last - first - (after - before)[:, None] * ray, axis=-1) / distance
    least = sides[np.abs(sides).argmin()]
    left = abs(least) - _SLIP * across.max()
    return float(np.sign(least) * left) if left > 0 else 0.0
