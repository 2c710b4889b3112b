"""Errors of vertices, for scenes whose true vertex positions are known."""

from __future__ import annotations

from torch import Tensor

from toile.errors import InputError

VERTEX_PROTOCOL = (
    "mean Euclidean distance between a reconstructed vertex and the true position of the same vertex, mm; "
    "unaligned; mean over all vertices and frames including frame 0"
)
VERTEX_PERCENT_PROTOCOL = (
    "the mean vertex distance in percent of the cloth's width (rest length along grid axis 0, its upper side)"
)


def vertex_distances(positions: Tensor, true_positions: Tensor) -> Tensor:
    """Distance of every vertex to its true position; two tensors (..., 3) [m] -> (...) [m], float64.

    Raises:
        InputError: the shapes differ.
    """
    if positions.shape != true_positions.shape:
        raise InputError(
            "Reconstruction and ground truth do not match",
            where="vertex error",
            expected=f"positions of shape {tuple(true_positions.shape)} in metres, as the ground truth",
            got=str(tuple(positions.shape)),
        )
    return (positions.detach().cpu().double() - true_positions.detach().cpu().double()).norm(dim=-1)


def vertex_error(positions: Tensor, true_positions: Tensor) -> Tensor:
    """Mean 3D vertex error per frame; two tensors (F, H, W, 3) [m] -> (F,) [m], float64."""
    return vertex_distances(positions, true_positions).flatten(1).mean(1)
