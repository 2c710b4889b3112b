"""Overlap of the rendered silhouette with the observed mask."""

from __future__ import annotations

import torch
from torch import Tensor

from toile.errors import InputError

SILHOUETTE_PROTOCOL = (
    "intersection over union of the rendered silhouette > ½ and the observed mask > ½, in the pixels of "
    "the scene's crop; 1 where both are empty; mean over all frames"
)


def intersection_over_union(silhouette: Tensor, mask: Tensor) -> Tensor:
    """IoU of rendered silhouettes and observed masks, both (..., h, w) in [0, 1]; returns (...), float64.

    Raises:
        InputError: the shapes differ.
    """
    if silhouette.shape != mask.shape:
        raise InputError(
            "Silhouette and mask differ in size",
            where="silhouette IoU",
            expected=f"silhouettes of shape {tuple(mask.shape)}, as the masks",
            got=str(tuple(silhouette.shape)),
        )
    a, b = silhouette.detach().cpu() > 0.5, mask.detach().cpu() > 0.5
    both = (a & b).flatten(-2).sum(-1).double()
    either = (a | b).flatten(-2).sum(-1).double()
    return torch.where(either > 0, both / either.clamp(min=1), torch.ones_like(either))
