"""Tracking by Gauss-Newton in sliding windows: the default recipe.

The external forces of the last few frames are found together, each window starting from the state that the
previous one has reached. What comes out is one simulation from frame 0 to the end under the forces found,
with no break between windows.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.errors import InputError
from toile.limits import Count, Positive, Unit
from toile.reconstruction.gauss_newton.unknowns import Priors, WindowUnknowns, force_change
from toile.reconstruction.gauss_newton.window import minimise_window, state_at
from toile.reconstruction.image_terms.texture_points import PointTermSettings, TexturePointTerm, visible
from toile.reconstruction.image_terms.tracked_positions import PositionTermSettings, TrackedPositionTerm
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.recipe import CycleReport, Recipe

Array = NDArray[np.float64]


class Windows(ABC):
    """Which windows of frames a stage goes through."""

    @abstractmethod
    def plan(self, n_frames: int) -> list[tuple[int, int]]:
        """(first, last) frame of every window."""


class SlidingWindows(Windows):
    """Windows of at most ``lag`` frames whose end advances by ``stride`` frames.

    Args:
        lag: frames whose forces are found together; None: all from frame 0 on.
        stride: frames by which the window advances, ``lag`` at most; None, with no ``lag``: the whole clip at
            once.
        repeats: how often the clip is gone through.

    Raises:
        InputError: windows would leave frames out between them.
    """

    def __init__(
        self,
        lag: Annotated[Count, Unit("frames")] | None,
        stride: Annotated[Count, Unit("frames")] | None,
        repeats: Count,
    ) -> None:
        if lag is not None and (stride is None or stride > lag):
            # The first one would not even begin at the clip's first frame.
            raise InputError(
                "Windows would leave frames out",
                where="windows.stride",
                expected=f"{lag} frames (windows.lag) at most, or windows.lag=null for the whole clip",
                got="null" if stride is None else str(stride),
            )
        self.lag = lag
        self.stride = stride
        self.repeats = repeats

    def plan(self, n_frames: int) -> list[tuple[int, int]]:
        """See Windows."""
        before = [] if self.stride is None else range(self.stride, n_frames - 1, self.stride)
        ends = [*before, n_frames - 1]
        return [(0 if self.lag is None else max(0, end - self.lag), end) for end in ends] * self.repeats


class GrowingWindows(Windows):
    """Windows from frame 0 that grow by ``stride`` frames (the paper's successive frames).

    Args:
        start: frames in the first window.
        stride: frames added each time.
        repeats: how often the whole clip is treated at the end.
    """

    def __init__(
        self,
        start: Annotated[Count, Unit("frames")],
        stride: Annotated[Count, Unit("frames")],
        repeats: Count,
    ) -> None:
        self.start = start
        self.stride = stride
        self.repeats = repeats

    def plan(self, n_frames: int) -> list[tuple[int, int]]:
        """See Windows."""
        ends = [end for end in range(self.start, n_frames - 1, self.stride)]
        return [(0, end) for end in ends] + [(0, n_frames - 1)] * self.repeats


@dataclass(frozen=True)
class TrackingStage:
    """One pass over the clip.

    Attributes:
        windows: see Windows.
        term: what the motion is compared with: images, or the positions tracked by the stages before.
        priors: what is free and how much.
        iterations: Gauss-Newton iterations per window.
        cg_iterations, cg_tolerance: of the linear solver.
        visibility: leave out points that the cloth itself hides.
        settle: at the end, set stiffness, wind and effects to their means over the second half of the
            windows; for stages in which they walk.
        discard_turbulence: begin with none.
    """

    windows: Windows
    term: PointTermSettings | PositionTermSettings
    priors: Priors
    iterations: Count
    cg_iterations: Count
    cg_tolerance: Positive
    visibility: bool
    settle: bool
    discard_turbulence: bool


class TrackingRecipe(Recipe):
    """Passes over the clip, window by window; one window is one cycle.

    Args:
        stages: passes in the order they run, by name; None leaves one out.
    """

    def __init__(self, stages: Mapping[str, TrackingStage | None]) -> None:
        self._by_name = dict(stages)
        self.stages = [stage for stage in stages.values() if stage is not None]
        self._plan: list[tuple[TrackingStage, int, int]] = []
        self._positions: Array | None = None
        self._covered = 0
        self._seed = 0
        self._walk: list[Array] = []
        self._tracked: Array | None = None
        self._start_stiffness = np.zeros(3)
        self._stage: TrackingStage | None = None
        self._term: TexturePointTerm | TrackedPositionTerm | None = None

    def n_cycles(self, reconstruction: Reconstruction) -> int:
        """See Recipe."""
        return sum(len(stage.windows.plan(reconstruction.scene.n_frames)) for stage in self.stages)

    def start(self, reconstruction: Reconstruction) -> None:
        """See Recipe.

        Raises:
            InputError: there is no stage.
        """
        if not self.stages:
            raise InputError(
                "The recipe has no stage", where="optimization.stages", expected="at least one", got="none"
            )
        self._seed = int(torch.randint(2**31, ()))
        n = reconstruction.scene.n_frames
        self._plan = [(stage, a, b) for stage in self.stages for a, b in stage.windows.plan(n)]
        self._positions = None
        self._covered = 0
        self._walk = []
        self._tracked = None
        self._stage = self._term = None
        p = reconstruction.parameters
        self._relative_mass = (reconstruction.cloth.masses / p.units.mass)[:, None]
        self._start_stiffness = p.stiffness().numpy()

    def cycle(self, reconstruction: Reconstruction, index: int) -> CycleReport:
        """See Recipe."""
        stage, first, last = self._plan[index]
        if index > 0 and self._plan[index - 1][0] is not stage:
            self._leave(reconstruction, stage)
        self._enter(stage, reconstruction)
        assert self._term is not None
        if last > self._covered:
            self._extend(reconstruction.parameters, last)
        frame_steps = reconstruction.frame_steps
        start, end = frame_steps.ends[first], frame_steps.ends[last] + 1
        warm = None
        if self._positions is not None and len(self._positions) > start + 1:
            warm = self._positions[start:end]
        unknowns = WindowUnknowns(reconstruction, stage.priors, self._start_stiffness, first, last)
        visibility = None
        if stage.visibility and isinstance(self._term, TexturePointTerm):
            visibility = partial(visible, reconstruction, self._term.points)
        result = minimise_window(
            reconstruction,
            unknowns,
            self._term,
            visibility,
            state_at(reconstruction, self._positions, first),
            warm,
            iterations=stage.iterations,
            cg_iterations=stage.cg_iterations,
            cg_tolerance=stage.cg_tolerance,
        )
        if self._positions is None or first == 0:
            before: list[Array] = []
        else:
            before = [self._positions[:start]]
        after = [] if self._positions is None else [self._positions[end:]]
        self._positions = np.concatenate([*before, result.positions, *after])
        self._covered = max(self._covered, last)
        if stage.settle:
            self._settle(reconstruction, last_window=self._is_last_of_stage(index))
        losses = {
            "objective": result.objective,
            "colour": float(result.colour.mean()),
            "mask": float(result.mask.mean()),
            "gauss_newton_iterations": float(result.iterations),
            "conjugate_gradient_iterations": float(result.conjugate_gradients),
            "newton_iterations": float(result.newton),
        }
        motion = torch.from_numpy(frame_steps.at_frames(self._positions[:end]))
        return CycleReport(losses, last + 1, motion, tuple(result.notes), max(1, len(result.colour)))

    def with_heavier_silhouette(self, factor: float) -> TrackingRecipe | None:
        """See Recipe; later stages start from the motion that the first one has found."""
        for name, stage in self._by_name.items():
            if stage is not None and isinstance(stage.term, PointTermSettings) and stage.term.mask_weight > 0:
                term = replace(stage.term, mask_weight=factor * stage.term.mask_weight)
                return TrackingRecipe({**self._by_name, name: replace(stage, term=term)})
        return None

    def substep_positions(self) -> Tensor | None:
        """See Recipe."""
        return None if self._positions is None else torch.from_numpy(self._positions)[None]

    def state_dict(self) -> dict[str, Any]:
        """See Recipe."""
        return {
            "positions": None if self._positions is None else torch.from_numpy(self._positions.copy()),
            "covered": self._covered,
            "tracked": None if self._tracked is None else torch.from_numpy(self._tracked.copy()),
            "walk": torch.from_numpy(np.stack(self._walk) if self._walk else np.zeros((0, 6))),
            "start_stiffness": torch.from_numpy(self._start_stiffness.copy()),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See Recipe."""
        positions = state["positions"]
        self._positions = None if positions is None else positions.numpy().copy()
        self._covered = int(state["covered"])
        tracked = state["tracked"]
        self._tracked = None if tracked is None else tracked.numpy().copy()
        self._walk = list(state["walk"].numpy().copy())
        self._start_stiffness = state["start_stiffness"].numpy().copy()

    def _leave(self, reconstruction: Reconstruction, following: TrackingStage) -> None:
        """Keep what the stage before has tracked, and prepare the parameters for the one that follows."""
        assert self._positions is not None
        if isinstance(following.term, PositionTermSettings) and self._tracked is None:
            self._tracked = reconstruction.frame_steps.at_frames(self._positions).copy()
        if following.discard_turbulence:
            with torch.no_grad():
                reconstruction.parameters.turbulence.zero_()

    def _enter(self, stage: TrackingStage, reconstruction: Reconstruction) -> None:
        if stage is self._stage:
            return
        settings = stage.term
        self._stage = stage
        if isinstance(settings, PositionTermSettings):
            if self._tracked is None:
                raise ValueError("a stage that fits tracked positions needs a stage that tracks before it")
            self._term = TrackedPositionTerm(self._tracked, settings)
            return
        self._term = TexturePointTerm.of(reconstruction, settings, self._seed)

    def _is_last_of_stage(self, index: int) -> bool:
        return index + 1 == len(self._plan) or self._plan[index + 1][0] is not self._plan[index][0]

    def _settle(self, reconstruction: Reconstruction, *, last_window: bool) -> None:
        """Note stiffness, wind and effects of this window; after the last one, return to their mean."""
        p, effects = reconstruction.parameters, reconstruction.effects
        stiffness = p.stiffness().numpy()
        self._walk.append(np.concatenate((np.log(stiffness), p.wind.detach().numpy(), effects.current())))
        if not last_window:
            return
        mean = np.mean(self._walk[len(self._walk) // 2 :], axis=0)
        stiffness, wind, values = np.split(mean, [len(stiffness), len(stiffness) + 3])
        self._walk = []
        with torch.no_grad():
            p.set_stiffness(np.exp(stiffness).tolist())
            if len(effects):
                p.turbulence.add_(force_change(reconstruction, values, wind))
            else:
                p.turbulence.add_(self._relative_mass * (p.wind - torch.from_numpy(wind)))
            p.wind.copy_(torch.from_numpy(wind))
            if effects.values is not None:
                effects.values.copy_(torch.from_numpy(values))

    def _extend(self, p: ClothParameters, last: int) -> None:
        """Start new frames from the forces and boundary positions of the last known ones."""
        known = self._covered
        if known == 0:
            return
        with torch.no_grad():
            p.turbulence[known:last] = p.turbulence[known - 1]
            p.boundary_motion[known + 1 : last + 1] = p.boundary_motion[known]
