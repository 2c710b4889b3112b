"""What clips show otherwise than their session says, and what it says that means nothing here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.base_fit import N_WIND
from toile.diagnosis.joint_fit import DRAUGHT, JointClip, JointFit
from toile.diagnosis.session_stages import SeenClip
from toile.generation.clip_plan import MOTIONS
from toile.scenes.scene import Scene
from toile.scenes.session import Session

Array = NDArray[np.float64]

_AT_REST = 2.0
"""Memory of a diagnosis before its clips are judged [GB]."""
_MATRICES = 2.3
"""Matrices of 3 N x 3 N numbers that are kept of every frame, N the vertices of the model."""

_ALIKE = 0.01
"""Share by which frame rates and focal lengths of one device may differ."""

_BLOWN = 4.0
"""Draughts of a closed room from which on a wind is worth a word."""

_MOVED = 0.01
"""Share of the cloth's width by which what holds it moves where somebody moves it."""


def unknown_motions(session: Session) -> list[str]:
    """One sentence for every clip whose motion is a word that says nothing about air and corners."""
    return [
        f"{name}: its motion '{clip.motion}' is none of {', '.join(MOTIONS)}, so nothing is "
        "known of what blew or moved the corners"
        for name, clip in zip(session.clip_names, session.clips, strict=True)
        if clip.motion and clip.motion not in MOTIONS
    ]


def unlike_devices(session: Session, scenes: Sequence[Scene]) -> list[str]:
    """One sentence for every clip whose camera is not that of the first clip of the device that filmed it.

    Args:
        session: the clips.
        scenes: of each.
    """
    found: list[str] = []
    first: dict[str, tuple[str, Scene]] = {}
    for name, clip, scene in zip(session.clip_names, session.clips, scenes, strict=True):
        other, known = first.setdefault(clip.device, (name, scene))
        pairs = {
            "frames per second": (scene.fps, known.fps),
            "px of focal length": (scene.camera.fx, known.camera.fx),
        }
        found += [
            f"{name}: {value:.5g} {what} where {other} has {before:.5g}, though both are said to be of one "
            f"device ({clip.device!r}), whose clock and lens they would share: say device: in session.yaml"
            for what, (value, before) in pairs.items()
            if abs(value / before - 1) > _ALIKE
        ]
    return found


def copied_clips(session: Session, scenes: Sequence[Scene]) -> list[str]:
    """One sentence for every clip whose images are those of another one.

    Args:
        session: the clips.
        scenes: of each.
    """
    return [
        f"{name}: its images are those of {session.clip_names[k]}, so its evidence counts twice"
        for n, name in enumerate(session.clip_names)
        for k in range(n)
        if scenes[n].frames.shape == scenes[k].frames.shape
        and bool((scenes[n].frames == scenes[k].frames).all())
    ]


def memory_needed(n_frames: int, n_vertices: int) -> float:
    """Memory that a diagnosis takes at most, about, in GB.

    Of 20 x 20 vertices 2.7 for 40 frames, 4.3 for 80 and 8.4 for 240 (`/usr/bin/time`, nine sessions).

    Args:
        n_frames: of all clips together.
        n_vertices: of the model.
    """
    return _AT_REST + _MATRICES * n_frames * 8e-9 * (3 * n_vertices) ** 2


def short_of_memory(n_frames: int, n_vertices: int, free: float) -> list[str]:
    """One sentence where less memory is free [GB] than is needed, see ``memory_needed``."""
    needed = memory_needed(n_frames, n_vertices)
    if needed <= free:
        return []
    return [
        f"the clips have {n_frames} frames together, which takes about {needed:.1f} GB of memory, and "
        f"{free:.1f} GB are free: the system may end this without a word. Close other programs, or diagnose "
        "fewer clips; what is done by then is kept, and resume=<folder> goes on from there"
    ]


def moved_holders(session: Session, seen: Sequence[SeenClip], motion: Sequence[Array]) -> list[str]:
    """One sentence for every clip whose pinned vertices move although nobody is said to have moved them.

    Args:
        session: the clips.
        seen: the same after tracking.
        motion: of each, refined by the base model (F, N, 3) [m].
    """
    found = []
    clips = zip(session.clip_names, session.clips, seen, motion, strict=True)
    for name, clip, tracked, positions in clips:
        away = holders_away(tracked, positions).max(initial=0.0)
        if tracked.held_still and away > _MOVED * tracked.problem.scene.cloth_size[0]:
            found.append(
                f"{name}: what holds the cloth moves by {1e3 * away:.0f} mm, although nobody "
                f"moved it in a clip of motion '{clip.motion}': it slips, or another motion was recorded "
                f"({', '.join(MOTIONS)})"
            )
    return found


def wind_in_still_air(session: Session, clips: Sequence[JointClip], base: JointFit) -> list[str]:
    """One sentence for every clip whose cloth hangs as in a wind although none is said to have blown.

    Args:
        session: the clips.
        clips: the same in the fits.
        base: fit of the base model.
    """
    winds = base.values[len(base.values) - N_WIND * len(clips) :].reshape(-1, N_WIND)
    strengths = np.linalg.norm(winds, axis=-1)
    found = zip(session.clip_names, session.clips, clips, strengths, strict=True)
    return [
        f"{name}: its cloth hangs as in a wind of {strength:.2g} m/s² or more, although none blew in a "
        f"clip of motion '{clip.motion}': gusts, tilted gravity or what it touches may do that, or another "
        f"motion was recorded ({', '.join(MOTIONS)})"
        for name, clip, fitted, strength in found
        if fitted.around.still_air and strength > _BLOWN * DRAUGHT
    ]


def stopped_short(base: JointFit, fits: Mapping[str, JointFit]) -> list[str]:
    """One sentence where fits have not arrived: what they say against each other may be off.

    Args:
        base: of the base model.
        fits: of hypotheses that were fitted, by name.
    """
    short = ["the base model"] if not base.converged else []
    short += [name for name, fit in fits.items() if not fit.converged]
    if not short:
        return []
    return [
        f"what moves the cloth is less sure than it is said to be: the fit of {' and of '.join(short)} has "
        "stopped before it had arrived"
    ]


def stand_still(clip: SeenClip, positions: Array) -> bool:
    """Whether nobody is said to have moved the pinned vertices, and not all of them have moved.

    One that slips moves alone; where all do, another motion was recorded.

    Args:
        clip: see SeenClip.
        positions: its motion, refined by the base model (F, N, 3) [m].
    """
    least = holders_away(clip, positions).min(initial=np.inf)
    return clip.held_still and bool(least <= _MOVED * clip.problem.scene.cloth_size[0])


def holders_away(clip: SeenClip, positions: Array) -> Array:
    """Distances (P,) of the pinned vertices from where the template has them, median frame [m].

    Across the line of sight: along it images know little.

    Args:
        clip: see SeenClip.
        positions: its motion (F, N, 3) [m].
    """
    scene = clip.problem.scene
    pinned = list(scene.pinned_vertices)
    at = scene.template.reshape(-1, 3)[pinned].numpy().astype(np.float64)
    away = positions[:, pinned] - at
    ray = at / np.linalg.norm(at, axis=-1, keepdims=True)
    across = away - (away * ray).sum(-1, keepdims=True) * ray
    return np.asarray(np.median(np.linalg.norm(across, axis=-1), axis=0))
