"""How much of a generated motion a fit's own grid and step cannot follow, even with the true parameters."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.generation.settings import GeneratorSettings
from toile.generation.simulation import Sheet, simulate
from toile.generation.starting_point import starting_point
from toile.scenes.scene import Scene
from toile.scenes.template import Template


def deviation(
    settings: GeneratorSettings, scene: Scene, substeps: int, template: Template | None = None
) -> Tensor:
    """Distance of the truth from a simulation on the fit's grid with the true parameters.

    Args:
        settings: of the generated scene.
        scene: as generate returned it for them.
        substeps: BDF2 steps per frame of the simulation on the fit's grid.
        template: the real template, if the scene was made from one.

    Returns:
        Distances (F, H, W) [m].
    """
    assert scene.ground_truth is not None
    truth = scene.ground_truth.vertices
    assert truth is not None
    start = starting_point(settings, template)
    material = settings.material(start.cloth_size)
    sheet = Sheet.of(truth[0], start.cloth_size, settings.areal_density, start.pinned, material)
    motion = simulate(
        sheet,
        pinned_motion=settings.pinned_motion,
        acceleration=torch.tensor(settings.gravity, dtype=torch.float64)
        + torch.tensor(settings.wind, dtype=torch.float64),
        n_frames=settings.n_frames,
        fps=settings.fps,
        substeps=substeps,
        newton=settings.newton,
    )
    return (motion - truth).norm(dim=-1)
