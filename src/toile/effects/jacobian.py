"""Derivatives of many outputs by the few coefficients of effects."""

from __future__ import annotations

import torch
from torch import Tensor


def jacobian(outputs: Tensor, values: Tensor) -> Tensor:
    """Derivatives (k, ...) of outputs (...) by few values (k,), which they were made of.

    The product of the transposed Jacobian and a vector is linear in the vector; its own derivatives are the
    columns.
    """
    found = torch.zeros(len(values), *outputs.shape, dtype=outputs.dtype)
    if not outputs.requires_grad:
        return found
    dummy = torch.zeros_like(outputs, requires_grad=True)
    (products,) = torch.autograd.grad(outputs, values, dummy, create_graph=True, materialize_grads=True)
    for column, product in zip(found, products, strict=True):
        if product.requires_grad:
            (derivative,) = torch.autograd.grad(product, dummy, retain_graph=True, materialize_grads=True)
            column.copy_(derivative)
    return found
