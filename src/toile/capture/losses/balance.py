"""Incremental potential of a window of frames: what the networks state, in the metric of the layer.

Eq. 8 of Li et al. (3DV 2021) measures in metres how far the garment is from what the simulation makes of it.
A stretched edge is millimetres off there and counts for nothing beside a fold that is centimetres off, but it
is most of the force that is out of balance. The simulated garment minimises the incremental potential Φ of a
step, so Φ(V) - Φ(Ṽ) is the same distance in joules, and its gradient by V does not depend on Ṽ: no step has
to be solved. So are networks of garments trained by Santesteban, Otaduy and Casas, SNUG: Self-Supervised
Neural Dynamic Garments, CVPR 2022. Ours here, not in the paper.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from toile.capture.garments.garment import attached_targets
from toile.capture.layer.layer import SimulationLayer
from toile.errors import InputError
from toile.physics.contact.body import StepContact


def potential_loss(layer: SimulationLayer, positions: Tensor, bodies: Tensor, frame_time: float) -> Tensor:
    """Mean of Φ over the frames of a window but the first.

    ::

        Φ = ½/h² ‖V^t - 2 V^{t-1} + V^{t-2}‖²_M + E(V^t) - M g·V^t + U(V^t)

    with the layer's elastic energy E and its contact U, whose planes are found at V^t. Frames before V^t are
    given, as in a step of implicit Euler; there is no inertia where two are not there. Attached vertices are
    where the body holds them, as in the layer; friction is left out.

    Args:
        layer: of the garment.
        positions: V_cloth of the network in the world (F, N, 3) [m].
        bodies: V_body in the world (F, V, 3) [m]; without gradients.
        frame_time: h [s].

    Returns:
        Scalar [J], float64; heights count from y = 0.

    Raises:
        InputError: fewer than two frames, or other numbers of frames of body and cloth.
    """
    frames = len(positions)
    if frames < 2 or len(bodies) != frames:
        raise InputError(
            "Window has no potential",
            where="positions, bodies",
            expected="the same number of frames, two or more",
            got=f"{frames} and {len(bodies)}",
        )
    garment, given = layer.garment, bodies.detach().double().cpu()
    held = attached_targets(garment, given, layer.body_faces)
    V = positions.double().cpu().index_copy(1, garment.attached, held)
    now = V[1:]
    total = layer.stored_energy(now).sum()
    before = V.detach()
    for t in range(2, frames):
        off = V[t] - 2 * before[t - 1] + before[t - 2]
        total = total + (layer.cloth.masses[:, None] * off.square()).sum() / (2 * frame_time**2)
    for x, body in zip(now, given[1:].numpy(), strict=True):
        there = x.detach().numpy()
        contact = layer.contact.begin(there, body, body, 0.0, frame_time)
        total = total + _Contact.apply(x, contact)
    return total.to(positions) / (frames - 1)


class _Contact(torch.autograd.Function):
    """Energy of given contacts, with its gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, contact: StepContact) -> Tensor:
        values = x.detach().numpy()
        ctx.save_for_backward(torch.from_numpy(contact.gradient(values)))
        return x.new_tensor(contact.total(values, np.ones_like(values)))

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return gradients[0] * slope, None
