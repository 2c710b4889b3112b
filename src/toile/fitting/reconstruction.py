"""One reconstruction problem: a scene, its cloth, the simulator and the unknowns."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from toile.cloth.cloth import Cloth
from toile.cloth.state import State
from toile.fitting.parameters import ClothParameters
from toile.geometry.mesh import grid_faces
from toile.rendering.base import Renderer
from toile.scenes.scene import Scene
from toile.simulators.base import Simulator
from toile.simulators.rollout import Rollout, rollout


class Reconstruction:
    """What every recipe works on.

    Args:
        scene: see Scene; its ground truth is never read here.
        cloth: elements, rest shape and masses.
        make_simulator: builds the simulator from (cloth, sub-step [s]).
        substeps: sub-steps per frame.
        parameters: the unknowns.
        renderer: differentiable renderer.
    """

    def __init__(
        self,
        scene: Scene,
        cloth: Cloth,
        make_simulator: Callable[[Cloth, float], Simulator],
        substeps: int,
        parameters: ClothParameters,
        renderer: Renderer,
    ) -> None:
        self.scene = scene
        self.cloth = cloth
        self.substeps = substeps
        self.simulator = make_simulator(cloth, 1 / scene.fps / substeps)
        self.parameters = parameters
        self.renderer = renderer
        self.faces = grid_faces(*scene.grid)
        self.template = scene.template.reshape(-1, 3).to(torch.float64)
        self.texture_coordinates = scene.texture_coordinates.reshape(-1, 2)
        self.gravity = scene.gravity.to(torch.float64)

    def anchors(self, first: int, last: int) -> Tensor:
        """Positions of the held vertices at frames first ... last, (last - first + 1, n_held, 3) [m]."""
        return self.template[self.cloth.held] + self.parameters.anchor_motion[first : last + 1]

    def initial_state(self) -> State:
        """The template at rest, with the held vertices where the anchors say; batch of one."""
        positions = self.template.clone()
        if len(self.cloth.held):
            positions = positions.index_copy(0, self.cloth.held, self.anchors(0, 0)[0])
        still = torch.zeros_like(positions)
        return State.start(positions[None], still[None], self.simulator.time_step, self.simulator.n_past)

    def simulate(
        self, n_frames: int, warm_start: Tensor | None = None, *, linearize: bool = False, throw: bool = True
    ) -> Rollout:
        """Simulate the first ``n_frames`` frames; differentiable in all parameters but texture_offset."""
        p = self.parameters
        forces = p.forces(self.cloth.masses, self.gravity, 0, n_frames - 1)
        return rollout(
            self.simulator,
            self.initial_state(),
            p.material(),
            forces[None],
            self.anchors(0, n_frames - 1)[None],
            self.substeps,
            warm_start,
            linearize=linearize,
            throw=throw,
        )
