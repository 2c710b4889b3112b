"""Simulation loss over windows of frames (Li et al. 2021, Eqs. 7 and 8)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from toile.capture.layer.layer import SimulationLayer
from toile.capture.layer.silhouette import SilhouetteRays
from toile.errors import InputError


class Stepped(NamedTuple):
    """Outcome of the simulation of one frame.

    Attributes:
        positions: (N, 3) [m].
        converged: whether it is a solution.
    """

    positions: Tensor
    converged: bool


class FrameStep(Protocol):
    """S: simulates from one frame of the video to the next."""

    def __call__(
        self, positions: Tensor, velocities: Tensor, body: Tensor, next_body: Tensor, frame: int
    ) -> Stepped:
        """Garment at the next frame.

        Args:
            positions: (N, 3) [m] at the frame before.
            velocities: (N, 3) [m/s] there.
            body: (V, 3) [m] there.
            next_body: (V, 3) [m] at the frame that is asked for.
            frame: its number in the window, 1 to F - 1, e.g. for its silhouettes.
        """


@dataclass(frozen=True)
class LayerFrameStep:
    """Frames simulated by a simulation layer, in sub-steps over which the body moves linearly.

    Attributes:
        layer: of the garment.
        fps: frames per second.
        substeps: per frame.
        silhouettes: of every frame's views, for Eq. 1 in the sub-step that ends there; none if empty.
    """

    layer: SimulationLayer
    fps: float
    substeps: int = 4
    silhouettes: Sequence[Sequence[SilhouetteRays]] = ()

    def __call__(
        self, positions: Tensor, velocities: Tensor, body: Tensor, next_body: Tensor, frame: int
    ) -> Stepped:
        """See FrameStep; computed in double precision, the body has no gradients."""
        h = 1.0 / (self.fps * self.substeps)
        before, after = body.detach().double().cpu(), next_body.detach().double().cpu()
        x, v, begin, converged = positions.double().cpu(), velocities.double().cpu(), before, True
        for sub in range(1, self.substeps + 1):
            end = after if sub == self.substeps else torch.lerp(before, after, sub / self.substeps)
            seen = self.silhouettes[frame] if self.silhouettes and sub == self.substeps else ()
            step = self.layer.step(x, v, begin, end, h, silhouettes=seen)
            x, v, begin = step.positions, step.velocities, end
            converged = converged and step.converged
        return Stepped(x.to(positions), converged)


@dataclass(frozen=True)
class SimulatedWindow:
    """Ṽ of a window.

    Attributes:
        positions: (F, N, 3) [m]; frame 0 is the network's, as are those that ``counts`` leaves out.
        counts: (F,) bool, whether a frame supervises: not the first, none from a failed step on.
    """

    positions: Tensor
    counts: Tensor


def simulated_window(
    positions: Tensor, bodies: Tensor, step: FrameStep, frame_time: float, *, through_step: bool = False
) -> SimulatedWindow:
    """Ṽ by the cases of Eq. 8.

    - t = t': Ṽ = V.
    - t = t' + 1: S starts from the network's V at t' with velocity (V^{t'+1} - V^{t'}) / h.
    - later: S starts from the simulated Ṽ^{t-1} with velocity (Ṽ^{t-1} - Ṽ^{t-2}) / h.

    Args:
        positions: V_cloth of the network in the world (F, N, 3) [m].
        bodies: V_body in the world (F, V, 3) [m].
        step: S, over one frame.
        frame_time: h [s].
        through_step: whether gradients flow from Ṽ through S to V. The paper's do not; ours to try. Frame 0
            is a copy of V without gradients in any case.

    Returns:
        See SimulatedWindow.

    Raises:
        InputError: fewer than two frames, or other numbers of frames of body and cloth.
    """
    frames = len(positions)
    if frames < 2 or len(bodies) != frames:
        raise InputError(
            "Window cannot be simulated",
            where="positions, bodies",
            expected="the same number of frames, two or more",
            got=f"{frames} and {len(bodies)}",
        )
    network = positions if through_step else positions.detach()
    simulated = [network[0]]
    counts = torch.zeros(frames, dtype=torch.bool, device=positions.device)
    with nullcontext() if through_step else torch.no_grad():
        for t in range(1, frames):
            begin = simulated[t - 1]
            moved = network[1] - network[0] if t == 1 else begin - simulated[t - 2]
            result = step(begin, moved / frame_time, bodies[t - 1].detach(), bodies[t].detach(), t)
            if not (result.converged and bool(torch.isfinite(result.positions).all())):
                simulated += list(positions[t:].detach())
                break
            simulated.append(result.positions)
            counts[t] = True
    simulated[0] = positions[0].detach()
    return SimulatedWindow(torch.stack(simulated), counts)


@dataclass(frozen=True)
class LayerWindow:
    """A window that a layer simulates.

    Attributes:
        positions: see ``simulated_window``.
        bodies: see ``simulated_window``.
        fps: see LayerFrameStep.
        substeps: see LayerFrameStep.
        silhouettes: see LayerFrameStep.
        through_step: see ``simulated_window``.
    """

    positions: Tensor
    bodies: Tensor
    fps: float
    substeps: int
    silhouettes: Sequence[Sequence[SilhouetteRays]] = ()
    through_step: bool = False


def window_on_layer(layer: SimulationLayer, window: LayerWindow) -> SimulatedWindow:
    """Ṽ of a window by a layer, e.g. in ``LayerWorkers.map``; see ``simulated_window``."""
    step = LayerFrameStep(layer, window.fps, window.substeps, window.silhouettes)
    through = window.through_step
    return simulated_window(window.positions, window.bodies, step, 1 / window.fps, through_step=through)


def simulation_loss(positions: Tensor, window: SimulatedWindow) -> Tensor:
    """L_sim = Σ_i Σ_{t>t'} ‖V_i^t - Ṽ_i^t‖², of one window.

    Args:
        positions: V_cloth of the network in the world (F, N, 3) [m].
        window: Ṽ, see ``simulated_window``.

    Returns:
        Scalar [m²]; 0, with gradients of 0, if no frame counts.
    """
    apart = (positions - window.positions).square().sum((1, 2))
    return (apart * window.counts).sum()


def physics_loss(
    positions: Tensor, bodies: Tensor, step: FrameStep, frame_time: float, *, through_step: bool = False
) -> Tensor:
    """L_sim of the network's window, simulated on the fly; see ``simulated_window``, ``simulation_loss``."""
    window = simulated_window(positions, bodies, step, frame_time, through_step=through_step)
    return simulation_loss(positions, window)
