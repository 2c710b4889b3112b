"""Material: the three stiffnesses of a cloth."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Material:
    """Stiffnesses in SI units, one per scene of the batch.

    Attributes:
        stretching: Y [N/m], shape (B,).
        shearing: S [N·m], shape (B,); belongs to the grid spacing it was measured on.
        bending: B [N·m], shape (B,).
    """

    stretching: Tensor
    shearing: Tensor
    bending: Tensor
