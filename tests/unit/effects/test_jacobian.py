"""Derivatives by few values against torch's own Jacobian."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.effects.jacobian import jacobian


def outputs(values: Tensor) -> Tensor:
    """Nonlinear in the first two values, linear in the third, without the fourth."""
    x = torch.arange(6, dtype=torch.float64).reshape(2, 3)
    return torch.sin(values[0] * x) * values[1] + values[2] * x


def test_it_is_torchs_jacobian() -> None:
    values = torch.tensor([0.3, 2.0, -1.0, 5.0], dtype=torch.float64, requires_grad=True)
    expected = torch.autograd.functional.jacobian(outputs, values.detach()).permute(2, 0, 1)
    found = jacobian(outputs(values), values)
    torch.testing.assert_close(found, expected)
    assert not found[3].any()


def test_what_does_not_depend_on_the_values_has_none() -> None:
    values = torch.ones(2, dtype=torch.float64, requires_grad=True)
    assert torch.equal(jacobian(torch.ones(3, 2), values), torch.zeros(2, 3, 2))
    # Linear in one of them, so that its derivative carries no graph.
    linear = values[0] * torch.arange(3.0, dtype=torch.float64)
    assert jacobian(linear, values).tolist() == [[0.0, 1.0, 2.0], [0.0, 0.0, 0.0]]
