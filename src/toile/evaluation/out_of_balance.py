"""Out-of-balance force: by how much a trajectory violates Newton's second law (Li et al. 2021, 4.1.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from toile.errors import InputError

OUT_OF_BALANCE_PROTOCOL = (
    "out-of-balance force (Li et al., 3DV 2021, 4.1.2): r = M a − F_int(x) − F_ext with the centred "
    "difference a_t = (x_{t+1} − 2 x_t + x_{t−1}) / Δt² at the frame rate; mean of |r| over the vertices "
    "that are not pinned, divided by their mean weight m |g|; first and last frame have none; mean over the "
    "other frames"
)


@dataclass(frozen=True)
class OutOfBalanceForce:
    """Out-of-balance force of a trajectory.

    Attributes:
        residual: force residual r of every vertex in the inner frames (F - 2, H, W, 3) [N]; zero at pinned
            vertices.
        per_frame: mean of |r| over free vertices / mean free weight, (F,) [1]; NaN in the first and last
            frame.
        mean: mean of ``per_frame`` over the inner frames [1].
        maximum: largest |r| of a free vertex in any frame / mean free weight [1].
        mean_weight: the normalisation, mean of m |g| over the free vertices [N].
    """

    residual: Tensor
    per_frame: npt.NDArray[np.float64]
    mean: float
    maximum: float
    mean_weight: float


def out_of_balance_force(
    positions: Tensor,
    *,
    masses: Tensor,
    internal_forces: Callable[[Tensor], Tensor],
    external_forces: Tensor,
    frame_time: float | Tensor,
    gravity: Tensor,
    pinned_vertices: tuple[int, ...] = (),
) -> OutOfBalanceForce:
    """Residual of Newton's second law along a trajectory.

    For every inner frame t::

        r_t = M (x_{t+1} − 2 x_t + x_{t−1}) / Δt² − F_int(x_t) − F_ext,t

    It vanishes up to the O(Δt²) error of the centred difference for physical motion. Where the times before
    and after a frame differ, a_t is the second derivative of the parabola through the three positions, which
    is wrong by a third of their difference times the third derivative of the motion. Forces of the holding
    hand are unknown, so pinned vertices are left out of every figure. The normalisation by the mean vertex
    weight makes grids and cloths comparable: 1 means that a vertex misses a force as large as its own weight.

    Args:
        positions: trajectory (F, H, W, 3) [m], F at least 3.
        masses: vertex masses (H, W) [kg].
        internal_forces: maps positions (n, H, W, 3) [m] to the elastic forces on the vertices
            (n, H, W, 3) [N], that is −∂E/∂x of the summed elastic energies.
        external_forces: all other forces including gravity [N], broadcastable to (F - 2, H, W, 3): frames
            1 to F - 2.
        frame_time: time Δt between two frames [s], or all those times (F - 1,) where they differ.
        gravity: (3,) [m/s²]; only its magnitude is used, for the normalisation.
        pinned_vertices: flattened grid indices i * W + j to leave out.

    Raises:
        InputError: fewer than 3 frames, a force of wrong shape, a time step or gravity that is not
            positive, or no free vertex.
    """
    x = positions.detach().cpu().double()
    if x.ndim != 4 or x.shape[-1] != 3 or x.shape[0] < 3:
        raise _bad("positions", "shape (F, H, W, 3) in metres with F >= 3", str(tuple(x.shape)))
    if isinstance(frame_time, Tensor):
        if frame_time.shape != (len(x) - 1,) or not bool((frame_time > 0).all()):
            raise _bad("frame_time", f"{len(x) - 1} positive numbers of seconds", str(frame_time.tolist()))
    elif not frame_time > 0:
        raise _bad("frame_time", "a positive number of seconds", str(frame_time))
    m = masses.detach().cpu().double()
    if m.shape != x.shape[1:3]:
        raise _bad("masses", f"shape {tuple(x.shape[1:3])} in kg", str(tuple(m.shape)))
    free = torch.ones(m.numel(), dtype=torch.bool)
    free[list(pinned_vertices)] = False
    mean_weight = (
        float(m.flatten()[free].mean() * gravity.detach().cpu().double().norm()) if free.any() else 0.0
    )
    if not mean_weight > 0:
        raise _bad("normalisation", "free vertices of positive mean weight m |g|", f"{mean_weight} N")

    inner = x[1:-1]
    if isinstance(frame_time, Tensor):
        speeds = x.diff(dim=0) / frame_time[:, None, None, None]
        acceleration = 2 * speeds.diff(dim=0) / (frame_time[1:] + frame_time[:-1])[:, None, None, None]
    else:
        acceleration = (x[2:] - 2 * inner + x[:-2]) / frame_time**2
    internal = internal_forces(inner).detach().cpu().double()
    if internal.shape != inner.shape:
        raise _bad(
            "internal_forces", f"forces of shape {tuple(inner.shape)} in N", str(tuple(internal.shape))
        )
    residual = m[..., None] * acceleration - internal - external_forces.detach().cpu().double()
    if residual.shape != inner.shape:
        raise _bad(
            "external_forces",
            f"shape broadcastable to {tuple(inner.shape)}",
            str(tuple(external_forces.shape)),
        )
    residual = residual * free.reshape(m.shape)[..., None]
    magnitude = residual.norm(dim=-1).flatten(1)[:, free] / mean_weight
    per_frame = np.full(x.shape[0], np.nan)
    per_frame[1:-1] = magnitude.mean(1).numpy()
    return OutOfBalanceForce(
        residual=residual,
        per_frame=per_frame,
        mean=float(magnitude.mean()),
        maximum=float(magnitude.max()),
        mean_weight=mean_weight,
    )


def _bad(where: str, expected: str, got: str) -> InputError:
    return InputError("Cannot compute the out-of-balance force", where=where, expected=expected, got=got)
