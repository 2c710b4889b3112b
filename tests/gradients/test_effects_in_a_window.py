"""Gradient of a window's objective by the effects' numbers, against finite differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.effects.air_drag import AirDrag
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.anisotropic_stiffness import AnisotropicStiffness
from toile.effects.base import Effect
from toile.effects.frame_rate import FrameRate
from toile.effects.gravity_tilt import GravityTilt
from toile.effects.gusts import Gusts
from toile.effects.internal_damping import InternalDamping
from toile.effects.nonuniform_density import NonuniformDensity
from toile.physics.cloth import Cloth, grid_material
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State
from toile.physics.step_terms import StepTerm
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.gauss_newton.conjugate_gradients import Vector, axpy
from toile.reconstruction.gauss_newton.unknowns import Priors, WindowUnknowns
from toile.reconstruction.gauss_newton.window import Motion, state_at
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import scene_cloth, scene_units, uniform
from toile.rendering import WarpRenderer
from toile.scenes.scene import Scene

PRIORS = Priors(2.0, 1.0, 2.0, 0.01, 3.0, 0.5, 1.0, walk=False, effects=1.0)
STIFFNESS = np.array([1500.0, 10.0, 0.5])

EFFECTS: dict[str, tuple[Effect, ...]] = {
    "air_drag": (AirDrag({"linear": 0.6, "normal": 1.0, "quadratic": 1.5}),),
    "internal_damping": (InternalDamping({"in_plane": 0.01, "bending": 0.02}),),
    "anisotropic_stiffness": (AnisotropicStiffness({"stretching": 0.2, "bending": -0.2}),),
    "gusts": (Gusts({"x_1": 0.5, "z_2": -0.7}, n_modes=3),),
    "gravity_tilt": (GravityTilt({"about_x": 2.0, "about_z": -1.0}),),
    "anchor_slip": (AnchorSlip({"x": 0.01, "z": 0.02}, vertex=1, start=0.01, duration=0.04),),
    "nonuniform_density": (NonuniformDensity({"mode_10": 0.2, "mode_02": -0.1}),),
    "frame_rate": (FrameRate({"log_factor": 0.04}),),
    "several": (
        AirDrag({"normal": 1.0}),
        Gusts({"z_1": 0.5}, n_modes=1),
        InternalDamping({"in_plane": 0.01, "bending": 0.01}),
        AnchorSlip({"y": 0.01}, vertex=0, start=0.0, duration=0.05),
    ),
    # Exactly zero, where effects are the identity.
    "zero": (AirDrag(), Gusts(n_modes=1), AnchorSlip(start=0.0, duration=0.05), NonuniformDensity()),
}


def problem(scene: Scene, effects: FitEffects) -> Reconstruction:
    cloth = scene_cloth(scene, 0.15, uniform)
    parameters = ClothParameters(
        scene.n_frames,
        cloth.n_vertices,
        len(cloth.pinned),
        scene_units(scene, 0.15),
        stretching=STIFFNESS[0],
        shearing=STIFFNESS[1],
        bending=STIFFNESS[2],
    )

    def simulator(cloth: Cloth, step: float | Tensor, terms: Sequence[StepTerm] = ()) -> ImplicitSimulator:
        return ImplicitSimulator(cloth, step, BDF2(), NewtonSettings(tolerance=1e-9), terms)

    made = Reconstruction(scene, cloth, simulator, 2, parameters, WarpRenderer(), effects)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        parameters.wind.copy_(torch.tensor([1.0, 0.0, 2.0]))
        parameters.turbulence.add_(torch.randn(parameters.turbulence.shape, generator=generator))
        parameters.boundary_motion.add_(
            2e-3 * torch.randn(parameters.boundary_motion.shape, generator=generator)
        )
    return made


def start_of(made: Reconstruction, first: int) -> State:
    """State at a window's first frame, after the motion that the parameters give."""
    with torch.no_grad():
        before = made.simulate(made.scene.n_frames).all_positions[0].numpy()
    return state_at(made, before, first)


def moved(made: Reconstruction, unknowns: WindowUnknowns, start: State, z: Vector, linearize: bool) -> Motion:
    """The window's motion, as a fit simulates it."""
    given = unknowns.inputs(z, linearize=linearize)
    simulator = given.simulator
    assert isinstance(simulator, ImplicitSimulator)
    ratio = made.simulator.time_step / simulator.time_step
    start = replace(start, velocities=start.velocities * ratio)
    k = torch.from_numpy(unknowns.si_stiffness(z))[:, None]
    with torch.no_grad():
        motion = rollout(
            simulator,
            start,
            grid_material(k[0], k[1], k[2]),
            torch.from_numpy(given.forces)[None],
            torch.from_numpy(given.boundary)[None],
            made.frame_steps.window(unknowns.first, unknowns.last),
            linearize=linearize,
        )
    return Motion(simulator, start, motion)


@pytest.mark.parametrize("first", [0, 2])
@pytest.mark.parametrize("name", EFFECTS)
def test_gradient_and_tangent(name: str, first: int, swaying_scene: Scene) -> None:
    effects = FitEffects(EFFECTS[name])
    made = problem(swaying_scene, effects)
    unknowns = WindowUnknowns(made, PRIORS, STIFFNESS, first, 4)
    start, z = start_of(made, first), unknowns.start()
    motion = moved(made, unknowns, start, z, True)
    weights = np.random.default_rng(0).normal(size=motion.positions.shape)
    linear = motion.linearized(with_inertia=effects.change_inertia)
    gradient = unknowns.adjoint(z, linear.adjoint(weights))
    step = 2e-4
    for part in ("effects", "wind"):
        numeric, tangent = [], []
        for k in range(len(z[part])):
            unit = {key: np.zeros_like(a) for key, a in z.items()}
            unit[part][k] = 1.0

            def at(length: float, along: Vector = unit) -> NDArray[np.float64]:
                return moved(made, unknowns, start, axpy(length, along, z), False).positions

            behind = axpy(-step, unit, z)
            if np.array_equal(unknowns.within_bounds(behind)["effects"], behind["effects"]):
                slope = (at(step) - at(-step)) / (2 * step)
            else:
                # At a bound one side is all there is.
                slope = (4 * at(step) - at(2 * step) - 3 * motion.positions) / (2 * step)
            numeric.append(float((weights * slope).sum()))
            tangent.append(float((weights * linear.tangent(unknowns.tangent(z, unit))).sum()))
        scale = np.abs(numeric).max()
        assert scale > 0
        np.testing.assert_allclose(tangent, gradient[part], atol=1e-9 * scale)
        np.testing.assert_allclose(gradient[part], numeric, atol=2e-4 * scale)
