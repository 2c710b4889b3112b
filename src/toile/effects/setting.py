"""Effects applied to what a simulation is given: masses, forces, pinned positions, time, step terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from toile.effects.base import (
    BoundaryEffect,
    Effect,
    ElementEffect,
    ForceEffect,
    MassEffect,
    Surroundings,
    TimeEffect,
    VertexEffect,
)
from toile.physics.cloth import Cloth
from toile.physics.step_terms import StepTerm


@dataclass(frozen=True)
class Setting:
    """What a simulation of a clip is given; every tensor carries the gradients of the effects' values.

    Attributes:
        cloth: with the changed masses.
        forces: of the frames 1 ... F-1, gravity included, (F-1, N, 3) [N].
        boundary: pinned positions (F, n_pinned, 3) [m].
        frame_interval: true time between frames () [s], the mean where they are unevenly spaced.
        terms: for the simulator.
    """

    cloth: Cloth
    forces: Tensor
    boundary: Tensor
    frame_interval: Tensor
    terms: tuple[StepTerm, ...]


def setting(
    effects: Sequence[Effect], around: Surroundings, boundary: Tensor, acceleration: Tensor | None = None
) -> Setting:
    """Apply all effects that act between forces and positions, in the given order.

    Args:
        effects: of any kind; those that act on images alone are passed over.
        around: the nominal clip.
        boundary: nominal pinned positions (F, n_pinned, 3) [m].
        acceleration: wind beside gravity, (3,) or (F-1, 1 or N, 3) [m/s²]; none if None.
    """
    cloth = changed_cloth(effects, around)
    return Setting(
        cloth=cloth,
        forces=external_forces(effects, around, cloth, acceleration),
        boundary=changed_boundary(effects, around, boundary),
        frame_interval=frame_interval(effects, around),
        terms=active_terms(effects),
    )


def active_terms(effects: Sequence[Effect]) -> tuple[StepTerm, ...]:
    """Effects that act within a step, without those that do nothing and need no gradients."""
    return tuple(e for e in effects if isinstance(e, VertexEffect | ElementEffect) and e.is_active)


def changed_cloth(effects: Sequence[Effect], around: Surroundings) -> Cloth:
    """The cloth with its true masses; the same object where no effect changes them."""
    masses = around.cloth.masses
    for effect in effects:
        if isinstance(effect, MassEffect):
            masses = effect.masses(masses, around)
    return around.cloth if masses is around.cloth.masses else replace(around.cloth, masses=masses)


def external_forces(
    effects: Sequence[Effect], around: Surroundings, cloth: Cloth, acceleration: Tensor | None = None
) -> Tensor:
    """Masses times gravity, wind and what force effects add, (F-1, N, 3) [N].

    Effects are evaluated in the middle of each frame interval, over which the force is held, in the clip's
    own clock, see Surroundings.held_times.

    Args:
        effects: see setting.
        around: the nominal clip.
        cloth: with its true masses.
        acceleration: see setting.
    """
    total = around.gravity if acceleration is None else around.gravity + acceleration
    times = around.held_times()
    for effect in effects:
        if isinstance(effect, ForceEffect) and effect.is_active:
            total = total + effect.acceleration(times, around)
    return (cloth.masses[:, None] * total).expand(around.n_frames - 1, cloth.n_vertices, 3)


def changed_boundary(effects: Sequence[Effect], around: Surroundings, boundary: Tensor) -> Tensor:
    """True pinned positions (F, n_pinned, 3) [m] for nominal ones."""
    for effect in effects:
        if isinstance(effect, BoundaryEffect):
            boundary = effect.boundary(boundary, around)
    return boundary


def frame_interval(effects: Sequence[Effect], around: Surroundings) -> Tensor:
    """True time between frames () [s], the mean where they are unevenly spaced."""
    interval = torch.tensor(1 / around.fps, dtype=torch.float64)
    for effect in effects:
        if isinstance(effect, TimeEffect):
            interval = effect.frame_interval(interval)
    return interval
