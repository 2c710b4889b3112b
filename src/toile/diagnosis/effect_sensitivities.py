"""What an effect does to first order: forces, or apparent displacements, per unit of each coefficient.

An effect acts through one hook; its derivative on the known motion, at the coefficients that it has, is
all that the diagnosis needs. It comes from torch, so a new effect needs nothing here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

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
from toile.effects.jacobian import jacobian
from toile.geometry.camera import Camera
from toile.physics.cloth import Cloth
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.terms import changed_elements, nominal_elements
from toile.physics.material import Material
from toile.physics.step_terms import ElementTerm, StepContext

Array = NDArray[np.float64]

_DIFFERENCE = 1e-4
"""Of a coefficient, in prior deviations, or of a stiffness, in its logarithm."""

FORCES = (VertexEffect, ElementEffect, ForceEffect, MassEffect, TimeEffect)
"""Kinds of effects that change the motion through forces."""


@dataclass(frozen=True)
class Instant:
    """One sub-step of the known motion.

    Attributes:
        step: what acted.
        time: of its end since frame 0 [s].
        time_step: h [s].
        material: (P,) what the cloth's law depends on, in SI units.
        acceleration: gravity and wind (3,) [m/s²].
        boundary: pinned positions at its end (n_pinned, 3) [m].
        after: what changes the elements after the effect.
        held: time since frame 0 whose forces are held over the frame that the sub-step is of [s], see
            effects.setting; None: forces act as they are at its end.
    """

    step: StepForces
    time: float
    time_step: float
    material: Array
    acceleration: Array
    boundary: Array
    after: tuple[ElementTerm, ...] = ()
    held: float | None = None


def derivatives(function: Callable[[Effect], Tensor], effect: Effect) -> Array:
    """Derivatives of a tensor (...) by every coefficient of an effect, per prior deviation, (n, ...)."""
    scales = effect.scales
    standardised = (effect.values / scales).detach().clone().requires_grad_()
    with torch.enable_grad():
        value = function(effect.with_values(standardised * scales))
        return jacobian(value, standardised).numpy().astype(np.float64)


def force_sensitivities(effect: Effect, instant: Instant, around: Surroundings) -> Array:
    """Force (n_parameters, N, 3) [N] per prior deviation of every parameter.

    Raises:
        TypeError: the effect does not act through forces.
    """
    cloth = around.cloth
    masses = cloth.masses
    if isinstance(effect, ElementEffect):
        return _element_force_sensitivities(effect, instant, cloth)
    if isinstance(effect, VertexEffect):
        now = _context(instant, cloth)
        units = effect.force_derivatives(torch.from_numpy(instant.step.positions), now)
        if units is not None:
            return np.asarray((units * effect.scales[:, None, None]).numpy(), np.float64)

        def force(acting: Effect) -> Tensor:
            assert isinstance(acting, VertexEffect)
            x = torch.from_numpy(instant.step.positions).clone().requires_grad_()
            return -torch.autograd.grad(acting.energy(x, now).sum(), x, create_graph=True)[0]

        return derivatives(force, effect)
    if isinstance(effect, ForceEffect):
        held = instant.time if instant.held is None else instant.held
        times = torch.tensor([held], dtype=torch.float64)

        def push(acting: Effect) -> Tensor:
            assert isinstance(acting, ForceEffect)
            return (masses[:, None] * acting.acceleration(times, around)[0]).expand(len(masses), 3)

        return derivatives(push, effect)
    if isinstance(effect, MassEffect):

        def heavier(acting: Effect) -> Tensor:
            assert isinstance(acting, MassEffect)
            return acting.masses(masses, around).log()

        now_masses = effect.masses(masses, around).detach().numpy()
        lost = now_masses[:, None] * instant.acceleration - instant.step.imbalance
        return derivatives(heavier, effect)[:, :, None] * lost
    if isinstance(effect, TimeEffect):

        def longer(acting: Effect) -> Tensor:
            assert isinstance(acting, TimeEffect)
            return acting.frame_interval(torch.ones((), dtype=torch.float64)).log()

        # Inertia goes with the inverse square of the time step.
        return 2 * derivatives(longer, effect)[:, None, None] * instant.step.imbalance
    raise TypeError(f"{effect.NAME} does not act through forces")


@torch.no_grad()
def stretching_within(terms: Sequence[ElementTerm], instant: Instant, cloth: Cloth) -> Array:
    """Change of the forces (N, 3) [N] per logarithm of Y by what terms make of it: it is in their strains.

    Of a template's tension alone this is less that tension: stiffer threads are less stretched by it.

    Args:
        terms: all that act.
        instant: see Instant.
        cloth: that they act on.
    """
    assembly = _assembly(cloth)
    coefficients = cloth.energies.coefficients(torch.from_numpy(instant.material)).numpy()
    stretching = [p.name for p in cloth.energies.parameters].index("stretching")

    def force(logarithm: float) -> Array:
        material = instant.material.copy()
        material[stretching] *= np.exp(logarithm)
        assembly.set_elements(changed_elements(terms, _context(replace(instant, material=material), cloth)))
        return -np.tensordot(coefficients, assembly.gradients(instant.step.positions), 1)

    return (force(_DIFFERENCE) - force(-_DIFFERENCE)) / (2 * _DIFFERENCE)


@torch.no_grad()
def _element_force_sensitivities(effect: ElementEffect, instant: Instant, cloth: Cloth) -> Array:
    """Forces by central differences of the solver's own kernels, which take microseconds.

    They are smooth in the coefficients, so the error is that of rounding.
    """
    assembly, now = _assembly(cloth), _context(instant, cloth)
    coefficients = cloth.energies.coefficients(now.material.values[0]).numpy()
    nominal = nominal_elements(instant.after, cloth)

    def force(values: Tensor) -> Array:
        changed = effect.with_values(values).elements(nominal, now)
        for term in instant.after:
            changed = term.elements(changed, now)
        assembly.set_elements(changed)
        return -np.tensordot(coefficients, assembly.gradients(instant.step.positions), 1)

    steps = _DIFFERENCE * torch.diag(effect.scales)
    return np.stack(
        [(force(effect.values + s) - force(effect.values - s)) / (2 * _DIFFERENCE) for s in steps]
    )


@lru_cache(maxsize=8)
def _assembly(cloth: Cloth) -> Assembly:
    """The assembly of a cloth that is asked about again and again."""
    return Assembly.of(cloth)


def apparent_sensitivities(effect: CameraEffect, positions: Array, template: Array, camera: Camera) -> Array:
    """Apparent displacement (n_parameters, N, 3) [m] per prior deviation.

    Points take their colours from where the nominal camera sees the template in frame 0, so a wrong camera
    shows in what differs from frame 0.

    Args:
        effect: of the camera.
        positions: (N, 3) [m].
        template: positions in frame 0 (N, 3) [m].
        camera: nominal.
    """
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)

    def shift(acting: Effect) -> Tensor:
        assert isinstance(acting, CameraEffect)
        moved = []
        for x in (torch.from_numpy(positions), torch.from_numpy(template)):
            pixels = camera.project(x)
            moved.append((acting.pixels(pixels, camera) - pixels) * x[:, 2:] / focal)
        return moved[0] - moved[1]

    out = np.zeros((len(effect.scales), *positions.shape))
    out[:, :, :2] = derivatives(shift, effect)
    return out


def _context(instant: Instant, cloth: Cloth) -> StepContext:
    step = instant.step
    return StepContext(
        cloth=cloth,
        material=Material(cloth.energies.parameters, torch.from_numpy(instant.material)[None]),
        positions=torch.from_numpy(step.before),
        velocities=torch.from_numpy(step.velocities),
        time=instant.time,
        time_step=instant.time_step,
        boundary=torch.from_numpy(instant.boundary),
    )
