"""Gradients of the whole chain, parameters → simulation → rendering → loss, against finite differences."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.reconstruction.losses.image import ImageLoss
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.scene_cloth import scene_cloth, scene_units, template
from toile.rendering import WarpRenderer
from toile.rendering.base import RenderedImages
from toile.scenes.scene import Scene

# Step of the central differences in the unit of the parameter (large enough that float32 images change by far
# more than their rounding), and the largest relative error that was measured.
CASES = {
    "stretching": (60.0, 1.9e-2),  # changes the image least of all: float32 rounding is what is left
    "shearing": (0.4, 9.2e-3),
    "bending": (0.005, 4.4e-4),
    "wind": (0.2, 3.5e-4),
    "turbulence": (0.05, 4e-4),
    "boundary_motion": (5e-4, 6.5e-4),
    "texture_offset": (2e-3, 1.1e-3),
}


@pytest.fixture
def inside(swaying_scene: Scene) -> Scene:
    """The swaying cloth, smoothly coloured, seen through a window that it fills: nothing discrete."""
    v, u = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="ij")
    waves = [torch.sin(2 * math.pi * (a * u + b * v)) for a, b in ((1.0, 0.5), (0.3, 1.2), (0.8, -0.7))]
    camera = swaying_scene.camera
    height, width = camera.height // 3, camera.width // 3
    return dataclasses.replace(
        swaying_scene,
        texture=0.5 + 0.4 * torch.stack(waves, -1),
        camera=camera.crop(height, width, height, width).scaled(2),
    )


@pytest.fixture
def problem(inside: Scene) -> Reconstruction:
    cloth = scene_cloth(inside, 0.15, template)
    parameters = ClothParameters(
        inside.n_frames,
        cloth.n_vertices,
        len(cloth.pinned),
        scene_units(inside, 0.15),
        stretching=1000.0,
        shearing=4.0,
        bending=0.5,
    )
    problem = Reconstruction(
        inside,
        cloth,
        # Solved to rounding, so that differences of simulations are differences of solutions.
        lambda cloth, step: ImplicitSimulator(cloth, step, BDF2(), NewtonSettings(tolerance=1e-9)),
        2,
        parameters,
        WarpRenderer(),
    )
    # A general point: wind, turbulence and moving boundary positions.
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        parameters.wind.copy_(torch.tensor([2.0, 0.0, 3.0]))
        parameters.turbulence.add_(torch.randn(parameters.turbulence.shape, generator=generator))
        parameters.boundary_motion.add_(
            2e-3 * torch.randn(parameters.boundary_motion.shape, generator=generator)
        )
    return problem


def loss(problem: Reconstruction) -> Tensor:
    """An image loss that is linear in the image: against black, with weights per pixel."""
    scene, p = problem.scene, problem.parameters
    x = problem.simulate(scene.n_frames).positions[0]
    uv = problem.texture_coordinates + p.texture_offset
    images = problem.renderer.render(x, problem.faces, uv, scene.texture, scene.camera)
    assert bool((images.silhouette == 1).all()), "the cloth has to fill the window"
    generator = torch.Generator().manual_seed(2)
    weights = torch.rand(images.rgb.shape, generator=generator)
    weighted = RenderedImages(weights * images.rgb, images.silhouette, images.depth)
    return ImageLoss(1.0)(weighted, torch.zeros_like(weights), images.silhouette)


def test_every_parameter_has_a_step() -> None:
    assert set(CASES) == set(ClothParameters.NAMES)


@pytest.mark.parametrize("name", CASES)
def test_gradient(name: str, problem: Reconstruction) -> None:
    parameter = problem.parameters.get_parameter(name)
    (gradient,) = torch.autograd.grad(loss(problem), parameter)
    (step, measured), errors = CASES[name], []
    for seed in range(1 if parameter.ndim == 0 else 3):
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
        # Half along the gradient, so that there is something to measure.
        direction = noise.sign() + 2 * gradient / gradient.abs().mean().clamp(min=1e-30)
        direction = direction / direction.square().mean().sqrt()
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                parameter.add_(sign * step * direction)
                values.append(loss(problem).double().item())
                parameter.sub_(sign * step * direction)
        numeric = (values[0] - values[1]) / (2 * step)
        errors.append(abs((gradient * direction).sum().item() / numeric - 1))
    assert max(errors) < 3 * measured, errors
