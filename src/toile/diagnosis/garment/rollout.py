"""Roll-outs of a garment on an estimated body, and what cameras see of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.capture.body.subject import Subject
from toile.capture.garments import Garment, attached_targets
from toile.capture.layer.layer import SimulationLayer
from toile.diagnosis.garment.bodies import EstimatedBody
from toile.diagnosis.garment.masks import MaskRenderer
from toile.diagnosis.garment.scene import Scene
from toile.effects.air_drag import AirDrag
from toile.geometry.camera import Camera
from toile.limits import Count
from toile.physics.energies.membrane import Membrane, NeoHookean
from toile.physics.simulator import SimulationError

Floats = NDArray[np.float64]

SETTLED = 5
"""Frames at the beginning that nothing is judged by: the garment settles, and the waistband slips."""


@dataclass(frozen=True)
class Discretisation:
    """How a garment is simulated.

    Attributes:
        substeps: per frame.
        membrane: law of in-plane strain.
    """

    substeps: Count = 2
    membrane: type[Membrane] = NeoHookean


@dataclass(frozen=True)
class Seen:
    """What is known of a roll-out, without the frames that settle.

    Attributes:
        vertices: of the garment (F, N, 3) [m].
        masks: of person and garment in every camera (C, 2, F, h, w) in [0, 1].
        converged: share of the layer's steps.
    """

    vertices: Floats
    masks: Floats
    converged: float


class RollOuts:
    """A garment on a moving person before some cameras.

    Args:
        subject: who.
        garment: on them; starts at rest.
        body: its motion, as it was estimated.
        cameras: C of them.
        fps: frames per second.
        discretisation: see Discretisation.
        kept: motions that are remembered.
    """

    def __init__(
        self,
        subject: Subject,
        garment: Garment,
        body: EstimatedBody,
        cameras: Sequence[Camera],
        fps: float,
        discretisation: Discretisation | None = None,
        kept: int = 1,
    ) -> None:
        self.subject, self.garment, self.body, self.fps = subject, garment, body, fps
        self.cameras = tuple(cameras)
        self.discretisation = discretisation or Discretisation()
        self._draw = MaskRenderer(subject.faces, garment.faces, len(subject.rest_vertices))
        self._kept = kept
        self._known: dict[Scene, tuple[Tensor, float]] = {}
        self._bodies: tuple[tuple[float, float], Tensor] | None = None

    def __call__(self, scene: Scene, cameras: int | None = None) -> Seen:
        """Roll out and look.

        Args:
            scene: see Scene.
            cameras: only so many, the first ones; all if None.

        Raises:
            SimulationError: positions are no longer finite.
        """
        if scene.moving not in self._known:
            while len(self._known) >= self._kept:
                del self._known[next(iter(self._known))]
            self._known[scene.moving] = self._rolled(scene)
        x, converged = self._known[scene.moving]
        used = self.cameras[: len(self.cameras) if cameras is None else cameras]
        keep = slice(SETTLED, None)
        masks = self._draw(x[keep], self._moved(scene)[keep], used, scene.bias)
        return Seen(x[keep].numpy(), masks, converged)

    def _moved(self, scene: Scene) -> Tensor:
        """The body (F, V, 3); the last one is remembered, as most scenes share it."""
        key = (scene.thigh, scene.girth)
        if self._bodies is None or self._bodies[0] != key:
            self._bodies = (key, self.body.moved(*key))
        return self._bodies[1]

    def _rolled(self, scene: Scene) -> tuple[Tensor, float]:
        """Motion of the garment (F, N, 3), and the share of steps that converged."""
        bodies = self._moved(scene)
        substeps = self.discretisation.substeps
        drag = AirDrag({"linear": 0.0, "normal": scene.drag})
        layer = SimulationLayer.of(
            self.garment, self.subject, membrane=self.discretisation.membrane, terms=(drag,)
        )
        m = self.garment.material
        material = layer.cloth.material(
            young=scene.stiffness * m.young, poisson=m.poisson, bending=scene.stiffness * m.bending
        )
        down = torch.tensor([0.0, -scene.slip, 0.0], dtype=torch.float64)
        x, v = self.garment.rest_vertices.clone(), torch.zeros_like(self.garment.rest_vertices)
        frames, converged = [x], []
        body = bodies[0]
        with torch.no_grad():
            for f in range(1, len(bodies)):
                for sub in range(1, substeps + 1):
                    after = torch.lerp(bodies[f - 1], bodies[f], sub / substeps)
                    # The waistband slips within the frames that are left out.
                    share = min(1.0, (f - 1 + sub / substeps) / (SETTLED - 1))
                    held = attached_targets(self.garment, after, self.subject.faces) + share * down
                    step = layer.step(
                        x,
                        v,
                        body,
                        after,
                        1 / (self.fps * substeps),
                        material=material,
                        friction=scene.friction * m.friction,
                        attached=held,
                    )
                    x, v, body = step.positions, step.velocities, after
                    converged.append(step.converged)
                    if not bool(torch.isfinite(x).all()):
                        raise SimulationError(f"frame {f}: positions are not finite; try more sub-steps")
                frames.append(x)
        return torch.stack(frames), float(np.mean(converged))
