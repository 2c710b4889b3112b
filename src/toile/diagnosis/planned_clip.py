"""A clip that nobody has recorded yet, as the base model of a session expects it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.joint_fit import JointClip, tracked_windows
from toile.diagnosis.shooting import Base, Shooting
from toile.diagnosis.tracked import Tracked
from toile.physics.cloth import Cloth
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.simulator import SimulationError
from toile.physics.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Performance:
    """What is done in a clip, in the middle of what an instruction asks for.

    Attributes:
        before: wind until frame 0 [m/s²].
        wind: from then on [m/s²].
        amplitude: of the corners [m].
        frequency: of the corners [1/s].
        turned: held by the next pair of corners.
    """

    before: float = 0.0
    wind: float = 0.0
    amplitude: float = 0.0
    frequency: float = 1.0
    turned: bool = False


PERFORMANCES: Mapping[str, Performance] = {
    "hang": Performance(before=0.7, wind=1.6),
    "release": Performance(before=2.0),
    "shake": Performance(before=0.4, wind=0.7, amplitude=0.015, frequency=1.5),
    "sway": Performance(before=0.4, wind=0.7, amplitude=0.06, frequency=0.4),
    "turned": Performance(before=0.4, wind=0.7, amplitude=0.015, frequency=1.5, turned=True),
    "fan_off": Performance(amplitude=0.015, frequency=1.5),
}
"""By motion, see generation.clip_plan.MOTIONS."""

HELD_STILL = frozenset(motion for motion, done in PERFORMANCES.items() if done.amplitude == 0)
"""Motions in which nobody moves what holds the cloth."""

STILL_AIR = frozenset(motion for motion, done in PERFORMANCES.items() if done.wind == 0)
"""Motions in which there is no steady wind from frame 0 on."""

CALM = "fan_off"
"""Motion in which nothing blows, gusts neither."""

_SQUARE = 1e-3
"""Share by which sides may differ."""

_ACROSS = np.array([0.6, 0.8])
"""Along the two horizontal axes: how the wind blows and the corners move."""

_FADE_IN = 0.3
"""Of the corners' motion [s]."""

_SETTLING_STEP, _SETTLING_STEPS = 0.1, 60
"""With steps as long as these [s] the integrator's own damping brings a cloth to rest."""

_FINER = 5
"""Steps in place of one where those are too long."""


def planned_clip(
    like: JointClip, motion: str, material: Array, n_frames: int, moved: float
) -> tuple[JointClip, Array]:
    """A clip of the same cloth before the same camera, simulated by the base model.

    Its images tell as much about every vertex as those of the other clip do on average.

    Args:
        like: a clip of the session.
        motion: one of PERFORMANCES.
        material: of the base model (P,).
        n_frames: of the clip.
        moved: deviation of the boundary positions in a clip in which they are moved [m].

    Returns:
        The clip, its windows simulated, and its wind along the two horizontal axes [m/s²].

    Raises:
        SimulationError: the motion cannot be simulated, or the cloth cannot be turned.
    """
    done, old = PERFORMANCES[motion], like.shooting
    assert isinstance(old.simulator, ImplicitSimulator)
    newton = old.simulator.newton
    cloth, begin = old.simulator.cloth, old.tracked.positions[0]
    if done.turned:
        H, W = old.grid
        if cloth.lines.along_0 != cloth.lines.along_1:
            raise SimulationError("a sheet that is not square on its grid is not turned")
        places = np.rot90(np.arange(H * W).reshape(H, W)).reshape(-1)
        begin, of_old = begin[places], np.argsort(places)
        turned = replace(cloth, pinned=torch.from_numpy(of_old[cloth.pinned.numpy()].copy()))
        begin = _as_far_apart(begin, cloth, turned, like.around.cloth_size)
        cloth = turned
    pinned = cloth.pinned.numpy()
    across = _ACROSS @ old.horizontal

    def simulated(start: Array, interval: float, wind: float, boundary: Array, substeps: int) -> Array:
        step = interval / substeps
        simulator = ImplicitSimulator(cloth, step, BDF2(), newton, old.simulator.terms)
        x = torch.from_numpy(start.copy())[None]
        state = State.start(x, torch.zeros_like(x), step, simulator.n_past)
        base = Base(material, np.zeros(2))
        load = torch.from_numpy(old.masses[:, None] * (old.gravity + wind * across))
        forces = load.expand(1, len(boundary) - 1, -1, -1)
        held = torch.from_numpy(boundary)[None]
        found = rollout(simulator, state, base.material_of(cloth), forces, held, substeps)
        return np.asarray(found.positions[0].numpy())

    still = np.repeat(begin[pinned][None], _SETTLING_STEPS + 1, 0)
    try:
        start = simulated(begin, _SETTLING_STEP, done.before, still, 1)[-1]
    except SimulationError:
        # A cloth that folds on its way needs shorter steps, and damps less in each.
        start = simulated(begin, _SETTLING_STEP, done.before, still, _FINER)[-1]
    h = old.simulator.time_step
    times = np.arange(n_frames) * old.substeps * h
    fade = np.clip(times / _FADE_IN, 0, 1)
    path = done.amplitude * fade**2 * (3 - 2 * fade) * np.sin(2 * np.pi * done.frequency * times)
    boundary = begin[pinned] + path[:, None, None] * across
    positions = simulated(start, h * old.substeps, done.wind, boundary, old.substeps)

    information = [old.tracked.mean_information] * n_frames
    tracked = Tracked(positions, information, np.zeros_like(positions), positions)
    simulator = ImplicitSimulator(cloth, h, BDF2(), newton, old.simulator.terms)
    shooting = Shooting(
        simulator,
        old.substeps,
        old.gravity,
        old.horizontal,
        old.grid,
        boundary,
        tracked,
        old.settings if motion in HELD_STILL else replace(old.settings, boundary=moved),
        forces=old.forces,
    ).counting_frames_once()
    wind = done.wind * _ACROSS
    base = Base(material, wind)
    windows = [shooting.simulate(w, w.standardised, base) for w in tracked_windows(shooting, n_frames)]
    around = replace(like.around, cloth=cloth, n_frames=n_frames, still_air=motion in STILL_AIR)
    clip = JointClip(shooting, around, like.device, windows)
    return clip, wind


def _as_far_apart(begin: Array, held: Cloth, turned: Cloth, sides: tuple[float, float]) -> Array:
    """Places of a turned cloth, its hands as slack as they were: the other edge may be longer.

    Args:
        begin: places of the vertices, hands where they were (N, 3) [m].
        held: as it was held.
        turned: as it is held now.
        sides: rest length along grid axis 0 and 1 [m].

    Raises:
        SimulationError: more than two hands hold a cloth whose sides differ.
    """
    if abs(sides[0] / sides[1] - 1) < _SQUARE:
        return begin
    if len(turned.pinned) > 2:
        raise SimulationError("a sheet that is not square, and held by more than two hands, is not turned")
    along = torch.cartesian_prod(*(p * side for p, side in zip(turned.lines.places(), sides, strict=True)))
    if len(turned.pinned) < 2:
        return begin
    (a, b), (c, d) = along[held.pinned], along[turned.pinned]
    ratio = float((d - c).norm() / (b - a).norm())
    first, second = begin[turned.pinned.numpy()]
    middle = 0.5 * (first + second)
    # All of it, so that no thread is torn on the way to where it hangs.
    direction = (second - first) / np.linalg.norm(second - first)
    moved: Array = begin + (ratio - 1) * ((begin - middle) @ direction)[:, None] * direction
    return moved
