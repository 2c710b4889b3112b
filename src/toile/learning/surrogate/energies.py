"""Internal energy of a pool's cloths by term, for the curves."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.learning.surrogate.states import ClothStates
from toile.physics.surrogate import kernels

TERMS = ("stretching", "shearing", "bending")


@torch.no_grad()
def energies_by_term(states: ClothStates) -> dict[str, Tensor]:
    """Energy of every cloth (paper, Eqs. 7 to 9) per vertex in network units, (n,) for each term."""
    height, width = states.grid
    energies = kernels.energies(
        states.history[:, 0].contiguous(), states.stiffness, states.rest_lengths_i, states.rest_lengths_j
    )
    return dict(zip(TERMS, (energies / (height * width)).unbind(-1), strict=True))
