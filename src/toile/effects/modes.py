"""Smooth fields over a grid: products of cosines, the eigenmodes of the Laplacian with free borders."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.effects.base import Parameter
from toile.errors import InputError
from toile.physics.cloth import Cloth

# Half waves along grid axis 0 and 1. All have zero mean over the area.
MODES = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))


def mode_parameters(low: float, high: float, scale: float, what: str) -> tuple[Parameter, ...]:
    """One parameter per mode, a pure number."""
    return tuple(
        Parameter(f"mode_{p}{q}", "1", low, high, scale, f"{what}, {p} half waves along axis 0, {q} along 1")
        for p, q in MODES
    )


def cosine_modes(cloth: Cloth) -> Tensor:
    """Modes cos(pπu) cos(qπv) at the vertices, (N, 5), u and v from 0 to 1 along grid axis 0 and 1."""
    if cloth.grid is None:
        raise InputError(
            "smooth modes need a cloth on a grid", where="cloth", expected="a grid", got="a general mesh"
        )
    u, v = (torch.linspace(0, torch.pi, n, dtype=torch.float64) for n in cloth.grid)
    modes = [torch.cos(p * u)[:, None] * torch.cos(q * v)[None, :] for p, q in MODES]
    return torch.stack(modes, -1).reshape(-1, len(MODES))
