"""One reconstruction problem: a scene, its cloth, the simulator and the unknowns."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from toile.effects.base import Effect, Surroundings
from toile.effects.setting import Setting, setting
from toile.geometry.mesh import grid_faces
from toile.physics.cloth import Cloth
from toile.physics.frame_steps import FrameSteps
from toile.physics.rollout import Rollout, rollout
from toile.physics.simulator import Simulator
from toile.physics.state import State
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.parameters import ClothParameters
from toile.rendering.base import Renderer
from toile.scenes.scene import Scene, require_one_camera


class Reconstruction:
    """What every recipe works on.

    Args:
        scene: see Scene, of one camera; its ground truth is never read here.
        cloth: elements, rest shape and masses.
        make_simulator: builds the simulator from (cloth, sub-step [s]), and ``terms`` where there are any.
        substeps: sub-steps per frame, or which lie between which frames where those are unevenly spaced.
        parameters: the unknowns.
        renderer: differentiable renderer.
        effects: what acts beside inertia, the three energies, gravity and wind; None for nothing.

    Attributes:
        frame_steps: which sub-steps lie between which frames.
        simulator: without any effects.
        around: the clip as the effects know it.
    """

    def __init__(
        self,
        scene: Scene,
        cloth: Cloth,
        make_simulator: Callable[..., Simulator],
        substeps: int | FrameSteps,
        parameters: ClothParameters,
        renderer: Renderer,
        effects: FitEffects | None = None,
    ) -> None:
        self.scene = require_one_camera(scene)
        self.cloth = cloth
        self.frame_steps = _frame_steps(substeps, scene)
        self.simulator = make_simulator(cloth, 1 / scene.fps / self.frame_steps.per_frame)
        self.parameters = parameters
        self.renderer = renderer
        self.faces = grid_faces(*scene.grid)
        self.template = scene.template.reshape(-1, 3).to(torch.float64)
        self.texture_coordinates = scene.texture_coordinates.reshape(-1, 2)
        self.gravity = scene.gravity.to(torch.float64)
        self.effects = effects or FitEffects()
        self.around = Surroundings(
            cloth, scene.cloth_size, self.gravity, scene.fps, scene.n_frames, scene.times
        )
        self._make_simulator = make_simulator

    def setting(
        self,
        effects: Sequence[Effect] | None = None,
        boundary_motion: Tensor | None = None,
        wind: Tensor | None = None,
    ) -> Setting:
        """What the whole clip is under the effects; forces are without the turbulence.

        Args:
            effects: with the coefficients they have; None takes those of the fit as they are now.
            boundary_motion: (F, n_pinned, 3) [m]; None takes the parameter.
            wind: (3,) [m/s²]; None takes the parameter.
        """
        p = self.parameters
        motion = p.boundary_motion if boundary_motion is None else boundary_motion
        return setting(
            self.effects.acting() if effects is None else effects,
            self.around,
            self.template[self.cloth.pinned] + motion,
            p.wind if wind is None else wind,
        )

    def simulator_of(self, given: Setting) -> Simulator:
        """The simulator for that setting; ``simulator`` where nothing of the kind is changed."""
        interval, nominal = given.frame_interval, 1 / self.scene.fps
        same_time = not interval.requires_grad and float(interval) == nominal
        if given.cloth is self.cloth and same_time and not given.terms:
            return self.simulator
        per_frame = self.frame_steps.per_frame
        step = interval / per_frame if interval.requires_grad else float(interval) / per_frame
        terms = {"terms": given.terms} if given.terms else {}
        return self._make_simulator(given.cloth, step, **terms)

    def forces(self, given: Setting, first: int, last: int) -> Tensor:
        """External forces of frames first + 1 ... last, turbulence included, (last - first, N, 3) [N]."""
        p = self.parameters
        if not len(self.effects):
            return p.forces(self.cloth.masses, self.gravity, first, last)
        return given.forces[first:last] + p.units.mass * p.turbulence[first:last]

    def boundary(self, first: int, last: int) -> Tensor:
        """Positions of the pinned vertices at frames first ... last, (last - first + 1, n_pinned, 3) [m]."""
        return self.setting().boundary[first : last + 1]

    def initial_state(self) -> State:
        """The template at rest, with the pinned vertices where the boundary positions say; batch of one."""
        positions = self.template.clone()
        if len(self.cloth.pinned):
            positions = positions.index_copy(0, self.cloth.pinned, self.boundary(0, 0)[0])
        still = torch.zeros_like(positions)
        return State.start(positions[None], still[None], self.simulator.time_step, self.simulator.n_past)

    def simulate(
        self, n_frames: int, warm_start: Tensor | None = None, *, linearize: bool = False, throw: bool = True
    ) -> Rollout:
        """Simulate the first ``n_frames`` frames; differentiable in all parameters but texture_offset."""
        given = self.setting()
        return rollout(
            self.simulator_of(given),
            self.initial_state(),
            self.parameters.material(),
            self.forces(given, 0, n_frames - 1)[None],
            given.boundary[None, :n_frames],
            self.frame_steps.window(0, n_frames - 1),
            warm_start,
            linearize=linearize,
            throw=throw,
        )


def _frame_steps(substeps: int | FrameSteps, scene: Scene) -> FrameSteps:
    """The sub-steps of a scene; a number per frame means nothing where the frames are unevenly spaced."""
    if isinstance(substeps, int):
        if scene.times is not None:
            raise ValueError("substeps: expected FrameSteps for a scene with times, got a number per frame")
        return FrameSteps.regular(substeps, scene.n_frames)
    if substeps.n_frames != scene.n_frames:
        raise ValueError(f"substeps: expected {scene.n_frames} frames, got {substeps.n_frames}")
    return substeps
