"""Material: the numbers that the internal energy of a cloth depends on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from toile.physics.parameter_vector import ParameterVector


@dataclass(frozen=True)
class Material:
    """Values of a cloth's parameters in SI units, one row per scene of the batch.

    Attributes:
        parameters: which column is what, as ``cloth.energies.parameters`` says.
        values: (B, P).
    """

    parameters: ParameterVector
    values: Tensor

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.parameters):
            raise ValueError(
                f"values: expected shape (B, {len(self.parameters)}) for {', '.join(self.parameters.names)}, "
                f"got {tuple(self.values.shape)}"
            )

    @staticmethod
    def of(parameters: ParameterVector, values: Mapping[str, Tensor | float]) -> Material:
        """From values by name, numbers for a batch of one or tensors (B,); see ParameterVector.pack."""
        columns = {n: torch.as_tensor(v, dtype=torch.float64).reshape(-1) for n, v in values.items()}
        return Material(parameters, parameters.pack(columns))

    def __getitem__(self, name: str) -> Tensor:
        """Values of one parameter, (B,)."""
        return self.values[:, self.parameters.index(name)]

    def scene(self, index: int) -> Material:
        """One scene of the batch, as a batch of one."""
        return Material(self.parameters, self.values[index : index + 1])

    def detached(self) -> Material:
        """The same without gradients."""
        return Material(self.parameters, self.values.detach())
