"""Third stage: SimNet is supervised by simulation over windows of frames (Li et al. 2021, Eqs. 7 and 8)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from toile.capture.deformation.deform import Deformed
from toile.capture.layer.layer import LayerSettings, SimulationLayer
from toile.capture.layer.silhouette import SilhouetteRays
from toile.capture.layer.workers import LayerWorkers
from toile.capture.losses.balance import potential_loss
from toile.capture.losses.rigidity import rigidity_loss, rotation_loss
from toile.capture.losses.simulation import (
    LayerWindow,
    SimulatedWindow,
    simulation_loss,
    window_on_layer,
)
from toile.capture.training.frames import Sample, TrainingSet
from toile.capture.training.weights import Networks
from toile.errors import InputError
from toile.learning.capture.stage import STATE
from toile.learning.capture.warm_stage import SimNetStage, WarmSettings
from toile.limits import Count, CountOrZero, NonNegative, Seed, TwoOrMore


@dataclass(frozen=True, kw_only=True)
class PhysicsSettings(WarmSettings):
    """Settings of the stage. In the paper simulation takes the place of rigidity, whose weight is 0 here.

    Attributes:
        window: F, frames in a row.
        potential_weight: of the incremental potential of the windows, see ``potential_loss`` [1/J]; ours, 0
            leaves it out.
        simulation_every: steps between two with the simulation, which takes a hundred times as long as the
            rest; 0 leaves it out.
        substeps: of the layer, per frame. With one, implicit Euler damps the motion that starts when a
            strained garment is let go, which later frames would otherwise see.
        simulation_weight: of Eq. 8 [1/m²].
        silhouette_rays: whether the layer is drawn to the silhouettes, Eq. 1.
        through_layer: whether gradients flow through the layer; the paper's do not.
        replays: earlier windows per step, drawn at random, that supervise again with the positions simulated
            back then; ours. A simulation takes a hundred times as long as a pass of the network, and the
            gradient of one window alone says little.
        memory: how many windows are kept for that.
        layer: see LayerSettings.
    """

    steps: Count = 1500
    batch: Count = 3
    learning_rate: NonNegative = 3e-4
    silhouette_weight: NonNegative = 150.0
    rigidity_weight: NonNegative = 0.0
    window: TwoOrMore = 3
    potential_weight: NonNegative = 3.0
    simulation_every: CountOrZero = 10
    substeps: Count = 1
    simulation_weight: NonNegative = 10.0
    silhouette_rays: bool = True
    through_layer: bool = False
    replays: CountOrZero = 3
    memory: Count = 40
    layer: LayerSettings = field(default_factory=LayerSettings)


@dataclass(frozen=True)
class SimulatedFrames:
    """A window with what the layer made of it.

    Attributes:
        samples: its frames.
        images: as the networks got them (F, 4, S, S).
        positions: Ṽ (F, N, 3) [m].
        counts: (F,) bool, whether a frame supervises.
    """

    samples: tuple[Sample, ...]
    images: Tensor
    positions: Tensor
    counts: Tensor


class PhysicsStage(SimNetStage):
    """Trains SimNet by silhouettes, attachment and what the simulation makes of its own output.

    Args:
        See Stage.

    Attributes:
        frames_counted: simulated frames that converged and so supervised, over all steps of this process.
        frames_simulated: all of them.
        workers: simulate the windows of a batch; see ``share``.
    """

    NAME: ClassVar[str] = "physics"
    NUMBER: ClassVar[int] = 3
    settings: PhysicsSettings

    def __init__(self, settings: PhysicsSettings, networks: Networks, data: TrainingSet, seed: Seed) -> None:
        super().__init__(settings, networks, data, seed)
        self.layer = SimulationLayer.of(data.garment, data.subject, settings.layer)
        self.workers = LayerWorkers(self.layer)
        self.frames_counted = self.frames_simulated = 0
        self._memory: list[SimulatedFrames] = []

    def share(self, workers: int) -> None:
        """Have the windows of a batch simulated by so many processes; the digits stay the same.

        Raises:
            InputError: gradients flow through the layer, and do not from process to process.
        """
        if workers > 1 and self.settings.through_layer:
            raise InputError(
                "Gradients through the layer stay within one process",
                where="workers",
                expected="1, with through_layer",
                got=str(workers),
            )
        self.workers = LayerWorkers(self.layer, workers)

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
        world, A, T = self.deformed(batch, images)
        assert world.body is not None
        parts = [slice(k * s.window, (k + 1) * s.window) for k in range(len(windows))]
        terms = self.image_terms(batch, world)
        if s.simulation_every and step % s.simulation_every == 0:
            terms["simulation"] = self._simulated(windows, world, images, rng)
        if s.potential_weight:
            found = [
                potential_loss(self.layer, world.garment[frames], world.body[frames], 1 / data.fps)
                for frames in parts
            ]
            terms["potential"] = s.potential_weight * torch.stack(found).mean()
        graph = self.networks.deformation.garment_mesh.graph
        assert graph is not None
        if s.rigidity_weight:
            terms["rigidity"] = s.rigidity_weight * rigidity_loss(graph, A, T)
        return {**terms, "rotations": s.rotation_weight * rotation_loss(graph, A)}

    def _simulated(
        self,
        windows: Sequence[Sequence[Sample]],
        world: Deformed,
        images: Tensor,
        rng: np.random.Generator,
    ) -> Tensor:
        """Eq. 8 of the step's windows and of some earlier ones, with its weight."""
        s, data = self.settings, self.data
        assert world.body is not None
        earlier = [self._memory[k] for k in _drawn(len(self._memory), s.replays, rng)]
        # What needs no gradients may go to other processes.
        garment = world.garment if s.through_layer else world.garment.detach()
        body = world.body if s.through_layer else world.body.detach()
        asked = [
            LayerWindow(
                x, b, data.fps, s.substeps, self._rays(window) if s.silhouette_rays else (), s.through_layer
            )
            for x, b, window in zip(garment.split(s.window), body.split(s.window), windows, strict=True)
        ]
        targets = self.workers.map(window_on_layer, asked)
        losses = []
        parts = zip(windows, world.garment.split(s.window), images.split(s.window), targets, strict=True)
        for window, part, seen, target in parts:
            self.frames_counted += int(target.counts.sum())
            self.frames_simulated += s.window - 1
            losses.append(simulation_loss(part, target))
            kept = target.positions.detach(), target.counts
            self._memory.append(SimulatedFrames(tuple(window), seen.detach(), *kept))
        self._memory = self._memory[-s.memory :]
        last = self.last
        losses += self._replayed(earlier)
        self.last = last
        # Eqs. 5 and 6 are means over frames, Eq. 8 is a sum over those of a window.
        return s.simulation_weight * torch.stack(losses).mean() / (s.window - 1)

    def teardown(self, stage: str) -> None:
        """Let the processes go that have simulated."""
        self.workers.close()

    def _rays(self, window: Sequence[Sample]) -> list[list[SilhouetteRays]]:
        return [self.data.rays(sample) for sample in window]

    def _replayed(self, windows: Sequence[SimulatedFrames]) -> list[Tensor]:
        """Losses of earlier windows against what was simulated then."""
        if not windows:
            return []
        assert self.sim_net is not None
        batch = self.data.batch([sample for window in windows for sample in window.samples])
        images = torch.cat([window.images for window in windows])
        angles, root = self.posed(batch, images)
        garment = self.placed(batch, self.networks.deformation(angles, root, *self.sim_net(images))).garment
        parts = garment.split([len(window.samples) for window in windows])
        return [
            simulation_loss(part, SimulatedWindow(window.positions, window.counts))
            for part, window in zip(parts, windows, strict=True)
        ]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """See Stage; the windows that are replayed as well."""
        super().on_save_checkpoint(checkpoint)
        checkpoint[STATE]["memory"] = [
            {
                "samples": [(s.clip, s.camera, s.frame) for s in window.samples],
                "images": window.images,
                "positions": window.positions,
                "counts": window.counts,
            }
            for window in self._memory
        ]

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Inverse of on_save_checkpoint."""
        super().on_load_checkpoint(checkpoint)
        self._memory = [
            SimulatedFrames(
                tuple(Sample(*numbers) for numbers in window["samples"]),
                window["images"],
                window["positions"],
                window["counts"],
            )
            for window in checkpoint[STATE]["memory"]
        ]


def _drawn(n: int, most: int, rng: np.random.Generator) -> list[int]:
    """Some of n, each at most once."""
    return [int(k) for k in rng.choice(n, min(n, most), replace=False)] if n and most else []
