"""Steps with which Blender's cloth keeps the balance of torques.

Blender's solver stops where what is left is a hundredth of all that it solves for, forces within the cloth
included (single precision, conjugate gradients). Where a part of the cloth is stiff and steps are long these
are so large that what is left is a force from nowhere, which swings the whole cloth. Forces within a cloth
have no torque, and what holds it at two corners has none about the line through them: without air and
obstacles nothing but gravity may turn the cloth about that line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toile.generation.blender import process, world
from toile.generation.blender.effects import WITHIN
from toile.generation.blender.settings import BlenderSettings
from toile.physics.simulator import SimulationError

Array = NDArray[np.float64]

LARGEST_IMBALANCE = 0.03
"""Root mean square acceleration that nothing accounts for, at most [m/s²]: a cloth without any effect has
0.02 in steps of 1.25 ms (docs/results/blender_balance.md)."""

_SHORTEST = 1 / 3200
"""Step [s] below which a scene would take too long."""
_DURATION = 0.8
"""Of the motion that is judged [s]: half a swing."""
_RATE = 100.0
"""Frames per second of it, about: accelerations are second differences."""


def balanced(settings: BlenderSettings, work: Path, *, with_effect: bool) -> BlenderSettings:
    """The settings with as many steps as the balance needs: theirs, or those times a power of two.

    Steps end at _SHORTEST: an effect that is too strong for them is none that Blender can show.

    Args:
        settings: of the scene.
        work: folder for intermediate files.
        with_effect: whether its effect acts; one from outside does not count.

    Raises:
        SimulationError: no number of steps does, or Blender stopped.
    """
    tried = settings
    while (found := imbalance_of(tried, work, with_effect=with_effect)) > LARGEST_IMBALANCE:
        longer, tried = tried, replace(tried, steps=2 * tried.steps)
        if 1 / (tried.fps * tried.steps) < _SHORTEST * 0.999:
            raise SimulationError(
                f"{settings.effect}: with {longer.steps} steps a frame nothing accounts for {found:.2g} m/s² "
                "by which the cloth is turned; choose a weaker effect"
            )
    return tried


def imbalance_of(settings: BlenderSettings, work: Path, *, with_effect: bool) -> float:
    """The imbalance of the cloth let go in a vacuum, its corners still, in steps as long as in the scene.

    Args:
        settings: of the scene.
        work: folder for intermediate files.
        with_effect: whether its effect acts; one from outside does not count.
    """
    per_frame = max(round(settings.fps * settings.steps / _RATE), 1)
    fps = settings.fps * settings.steps / per_frame
    still = replace(
        settings,
        fps=fps,
        steps=per_frame,
        n_frames=max(round(_DURATION * fps), 3),
        motion_amplitude=0.0,
        wind=(0.0, 0.0, 0.0),
    )
    acts = with_effect and settings.effect in WITHIN
    request = world.simulation(still, "balance", with_effect=acts)
    process.run({"threads": settings.threads, "simulations": [request]}, work, settings.python)
    motion: Array = np.load(work / "balance.npy").astype(np.float64)
    if not np.isfinite(motion).all():
        return float("inf")
    pinned = [(int(i), int(j)) for i, j in request["pinned"]]
    return imbalance(motion, pinned, np.array(request["gravity"], float), fps)


def imbalance(motion: Array, pinned: Sequence[tuple[int, int]], gravity: Array, fps: float) -> float:
    """Root mean square torque about the line through two corners that gravity does not account for.

    Args:
        motion: (F, H, W, 3) [m], all vertices of one mass.
        pinned: the two corners.
        gravity: (3,) [m/s²].
        fps: frames per second.

    Returns:
        Of the mean acceleration at the vertices' mean distance from the line [m/s²].
    """
    positions = motion.reshape(len(motion), -1, 3)
    first, second = (motion[1:-1, i, j] for i, j in pinned)
    line = (second - first) / np.linalg.norm(second - first, axis=-1, keepdims=True)
    acceleration = (positions[2:] - 2 * positions[1:-1] + positions[:-2]) * fps**2
    arm = positions[1:-1] - first[:, None]
    torque = (np.cross(arm, acceleration - gravity).mean(1) * line).sum(-1)
    off_line = arm - (arm * line[:, None]).sum(-1, keepdims=True) * line[:, None]
    return float(np.sqrt(((torque / np.linalg.norm(off_line, axis=-1).mean(1)) ** 2).mean()))
