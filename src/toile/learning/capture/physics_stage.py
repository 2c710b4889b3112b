"""Third stage: SimNet is supervised by simulation over windows of frames (Li et al. 2021, Eqs. 7 and 8)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from toile.capture.layer.layer import LayerSettings, SimulationLayer
from toile.capture.losses.rigidity import rotation_loss
from toile.capture.losses.simulation import LayerFrameStep, simulated_window, simulation_loss
from toile.capture.training.frames import TrainingSet
from toile.capture.training.weights import Networks
from toile.learning.capture.warm_stage import SimNetStage, WarmSettings
from toile.limits import Count, NonNegative, Seed, TwoOrMore


@dataclass(frozen=True, kw_only=True)
class PhysicsSettings(WarmSettings):
    """Settings of the stage; ``rigidity_weight`` is that of nothing: simulation takes its place.

    Attributes:
        window: F, frames in a row.
        substeps: of the layer, per frame.
        simulation_weight: of Eq. 8 [1/m²].
        silhouette_rays: whether the layer is drawn to the silhouettes, Eq. 1.
        through_layer: whether gradients flow through the layer; the paper's do not.
        layer: see LayerSettings.
    """

    steps: Count = 60
    batch: Count = 1
    learning_rate: NonNegative = 5e-4
    rigidity_weight: NonNegative = 0.0
    window: TwoOrMore = 3
    substeps: Count = 4
    simulation_weight: NonNegative = 10.0
    silhouette_rays: bool = True
    through_layer: bool = False
    layer: LayerSettings = field(default_factory=LayerSettings)


class PhysicsStage(SimNetStage):
    """Trains SimNet by silhouettes, attachment and what the simulation makes of its own output.

    Args:
        See Stage.

    Attributes:
        frames_counted: simulated frames that converged and so supervised, over all steps of this process.
        frames_simulated: all of them.
    """

    NAME: ClassVar[str] = "physics"
    NUMBER: ClassVar[int] = 3
    settings: PhysicsSettings

    def __init__(self, settings: PhysicsSettings, networks: Networks, data: TrainingSet, seed: Seed) -> None:
        super().__init__(settings, networks, data, seed)
        self.layer = SimulationLayer.of(data.garment, data.subject, settings.layer)
        self.frames_counted = self.frames_simulated = 0

    def terms(self, step: int, rng: np.random.Generator) -> Mapping[str, Tensor]:
        """See Stage."""
        s, data = self.settings, self.data
        windows = data.draw(s.batch, s.window, rng)
        batch = data.batch([sample for window in windows for sample in window])
        # The same change of the picture throughout a window.
        images = torch.cat(
            [
                s.augmentation(part, np.random.default_rng(rng.integers(2**31)), alike=True)
                for part in batch.images.to(self.device).split(s.window)
            ]
        )
        world, A, _ = self.deformed(batch, images)
        assert world.body is not None
        simulation = world.garment.new_zeros(())
        for number, window in enumerate(windows):
            frames = slice(number * s.window, (number + 1) * s.window)
            rays = [data.rays(sample) for sample in window] if s.silhouette_rays else ()
            frame_step = LayerFrameStep(self.layer, data.fps, s.substeps, rays)
            target = simulated_window(
                world.garment[frames],
                world.body[frames],
                frame_step,
                1 / data.fps,
                through_step=s.through_layer,
            )
            self.frames_counted += int(target.counts.sum())
            self.frames_simulated += s.window - 1
            simulation = simulation + simulation_loss(world.garment[frames], target)
        graph = self.networks.deformation.garment_mesh.graph
        assert graph is not None
        return {
            **self.image_terms(batch, world),
            # Eqs. 5 and 6 are means over frames, Eq. 8 is a sum over those of a window.
            "simulation": s.simulation_weight * simulation / (s.batch * (s.window - 1)),
            "rotations": s.rotation_weight * rotation_loss(graph, A),
        }
