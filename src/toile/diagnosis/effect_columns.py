"""What an effect does to first order: forces, or apparent displacements, per unit of each of its numbers.

An effect acts through one hook; its derivative at zero on the known motion is all that screening needs. It
comes from torch, so a new effect needs nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.func import grad, jacfwd

from toile.cloth.cloth import Cloth
from toile.cloth.energies.bending import bending_energy
from toile.cloth.energies.shearing import shearing_energy
from toile.cloth.energies.stretching import stretching_energy
from toile.cloth.material import Material
from toile.diagnosis.sensitivities import StepForces
from toile.effects.base import (
    CameraEffect,
    Effect,
    ElementEffect,
    ForceEffect,
    MassEffect,
    Surroundings,
    TimeEffect,
    VertexEffect,
)
from toile.geometry.camera import Camera
from toile.simulators.step_terms import Elements, StepContext

Array = NDArray[np.float64]

FORCES = (VertexEffect, ElementEffect, ForceEffect, MassEffect, TimeEffect)
"""Kinds of effects that change the motion through forces."""


@dataclass(frozen=True)
class Instant:
    """One sub-step of the known motion.

    Attributes:
        step: what acted.
        time: of its end since frame 0 [s].
        time_step: h [s].
        stiffness: (3,) Y [N/m], S, B [N·m].
        acceleration: gravity and wind (3,) [m/s²].
        anchors: held positions at its end (n_held, 3) [m].
    """

    step: StepForces
    time: float
    time_step: float
    stiffness: Array
    acceleration: Array
    anchors: Array


def force_columns(effect: Effect, instant: Instant, around: Surroundings) -> Array:
    """Force (n_parameters, N, 3) [N] per prior deviation of every parameter, at zero.

    Raises:
        TypeError: the effect does not act through forces.
    """
    scales = effect.scales
    zero = torch.full_like(scales, _ALMOST_ZERO)
    cloth = around.cloth
    x = torch.from_numpy(instant.step.positions)
    masses = cloth.masses

    def with_white(white: Tensor) -> Effect:
        return effect.with_values(white * scales)

    if isinstance(effect, VertexEffect | ElementEffect):
        now = _context(instant, cloth)

        def force(white: Tensor) -> Tensor:
            acting = with_white(white)
            if isinstance(acting, VertexEffect):
                return -grad(lambda at: acting.energy(at, now).sum())(x)
            assert isinstance(acting, ElementEffect)
            changed = acting.elements(plain_elements(cloth), now)
            return -grad(lambda at: internal_energy(at, cloth, now.material, changed))(x)

        return _numpy(jacfwd(force)(zero)).transpose(2, 0, 1)
    if isinstance(effect, ForceEffect):
        times = torch.tensor([instant.time], dtype=torch.float64)

        def push(white: Tensor) -> Tensor:
            acting = with_white(white)
            assert isinstance(acting, ForceEffect)
            return (masses[:, None] * acting.acceleration(times, around)[0]).expand(len(masses), 3)

        return _numpy(jacfwd(push)(zero)).transpose(2, 0, 1)
    if isinstance(effect, MassEffect):

        def heavier(white: Tensor) -> Tensor:
            acting = with_white(white)
            assert isinstance(acting, MassEffect)
            return acting.masses(masses, around) / masses

        change = _numpy(jacfwd(heavier)(zero)).T
        lost = masses.numpy()[:, None] * instant.acceleration - instant.step.imbalance
        return change[:, :, None] * lost
    if isinstance(effect, TimeEffect):
        interval = torch.ones((), dtype=torch.float64)

        def longer(white: Tensor) -> Tensor:
            acting = with_white(white)
            assert isinstance(acting, TimeEffect)
            return acting.frame_interval(interval)

        # Inertia goes with the inverse square of the time step.
        return 2 * _numpy(jacfwd(longer)(zero))[:, None, None] * instant.step.imbalance
    raise TypeError(f"{effect.NAME} does not act through forces")


def apparent_columns(effect: CameraEffect, positions: Array, template: Array, camera: Camera) -> Array:
    """Apparent displacement (n_parameters, N, 3) [m] per prior deviation, at zero.

    Points take their colours from where the nominal camera sees the template in frame 0, so a wrong camera
    shows in what differs from frame 0.

    Args:
        effect: of the camera.
        positions: (N, 3) [m].
        template: positions in frame 0 (N, 3) [m].
        camera: nominal.
    """
    scales = effect.scales

    def shift(white: Tensor, x: Tensor) -> Tensor:
        pixels = camera.project(x)
        acting = effect.with_values(white * scales)
        return (acting.pixels(pixels, camera) - pixels) * x[:, 2:] / torch.tensor([camera.fx, camera.fy])

    zero = torch.full_like(scales, _ALMOST_ZERO)
    here = _numpy(jacfwd(lambda w: shift(w, torch.from_numpy(positions)))(zero))
    there = _numpy(jacfwd(lambda w: shift(w, torch.from_numpy(template)))(zero))
    out = np.zeros((len(scales), *positions.shape))
    out[:, :, :2] = (here - there).transpose(2, 0, 1)
    return out


def plain_elements(cloth: Cloth) -> Elements:
    """Elements without any effect."""
    s = cloth.stencils
    one = torch.ones(max(len(s.edges), len(s.corners), len(s.straights)), dtype=torch.float64)
    return Elements(
        one[: len(s.edges)],
        one[: len(s.corners)],
        one[: len(s.straights)],
        cloth.rest_lengths,
        cloth.rest_corner_angles,
        torch.zeros(len(s.straights), dtype=torch.float64),
    )


def internal_energy(x: Tensor, cloth: Cloth, material: Material, elements: Elements) -> Tensor:
    """Internal energy () [J] with changed elements."""
    s = cloth.stencils
    return (
        stretching_energy(x, s.edges, elements.rest_lengths, material.stretching * elements.stretching)
        + shearing_energy(x, s.corners, elements.rest_corner_angles, material.shearing * elements.shearing)
        + bending_energy(
            x, s.straights, material.bending * elements.bending, elements.rest_straight_angles
        )
    )


def all_columns(
    effects: Sequence[Effect], around: Surroundings
) -> tuple[list[str], Callable[[Instant], Array]]:
    """Names of the columns of all effects that act through forces, and a function that gives them."""
    acting = [effect for effect in effects if isinstance(effect, FORCES)]
    names = [effect.NAME for effect in acting for _ in effect.scales]

    def columns(instant: Instant) -> Array:
        return np.concatenate([force_columns(effect, instant, around) for effect in acting])

    return names, columns


# Of a prior deviation: effects that are exactly 0 are passed over, derivatives and all.
_ALMOST_ZERO = 1e-9


def _context(instant: Instant, cloth: Cloth) -> StepContext:
    step = instant.step
    k = torch.from_numpy(instant.stiffness)
    return StepContext(
        cloth=cloth,
        material=Material(k[0:1], k[1:2], k[2:3]),
        positions=torch.from_numpy(step.before),
        velocities=torch.from_numpy((step.positions - step.before) / instant.time_step),
        time=instant.time,
        time_step=instant.time_step,
        anchors=torch.from_numpy(instant.anchors),
    )


def _numpy(values: Tensor) -> Array:
    return np.asarray(values.detach().numpy(), np.float64)
