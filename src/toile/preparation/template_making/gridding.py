"""A regular grid on a disc: flatten, find the corners, fill the quadrilateral, go back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toile.errors import InputError
from toile.geometry.flattening import flatten, stretches
from toile.geometry.quadrilateral import (
    SideFit,
    four_corners,
    grid_between,
    named_corners,
    require_quadrilateral,
    sides,
)
from toile.geometry.surface import Floats, Indices, SurfacePoints, TriangleMesh, nearest_points
from toile.preparation.template_making.still import Still
from toile.preparation.template_making.surface import Layout, project, require_clockwise

_FARTHEST_CORNER = 0.05  # of the outline's diameter, that a corner given by hand may be beside it


@dataclass(frozen=True)
class Gridding:
    """A grid on a surface, and how much the surface resisted being laid flat.

    Attributes:
        positions: (H, W, 3) [m].
        stretch: mean and largest relative change of length by flattening.
    """

    positions: Floats
    stretch: tuple[float, float]


def grid_on_disc(
    mesh: TriangleMesh,
    border: Indices,
    outline: SurfacePoints,
    still: Still,
    layout: Layout,
    fit: SideFit,
    where: str,
) -> Gridding:
    """Lay a grid with edges of equal length, as far as the surface can be laid flat.

    Args:
        mesh: a disc in the camera frame [m].
        border: its border loop.
        outline: the outline of the cloth on it, in order: the border itself, or a line inside it.
        still: the first frame.
        layout: size of the grid, and its corners if known.
        fit: how points on a side are found.
        where: for messages.

    Raises:
        InputError: it overlaps itself when laid flat, or has not four corners.
    """
    flat = flatten(mesh, border, where)
    laid = outline.of(flat)
    pixels = project(still.camera, outline.of(mesh.vertices))
    if layout.corners is None:
        found = four_corners(laid, where)
        corners = [found[k] for k in named_corners(pixels[list(found)])]
    else:
        corners = _given_corners(layout.corners, pixels, laid, where)
    plane = grid_between(sides(laid, corners), layout.grid, fit).reshape(-1, 2)
    points, _ = nearest_points(plane, flat, mesh.faces)
    change = np.abs(stretches(mesh, flat) - 1)
    return Gridding(
        points.of(mesh.vertices).reshape(*layout.grid, 3), (float(change.mean()), float(change.max()))
    )


def _given_corners(wanted: Floats, pixels: Floats, laid: Floats, where: str) -> list[int]:
    """Indices of the outline's points nearest to corners given in the image."""
    require_clockwise(wanted, "corners")
    distance = np.linalg.norm(pixels[:, None] - wanted[None], axis=-1)
    corners = [int(k) for k in distance.argmin(0)]
    farthest = float(distance.min(0).max())
    if farthest > _FARTHEST_CORNER * float(np.ptp(pixels, axis=0).max()):
        raise InputError(
            "A corner is not on the outline of the surface",
            where="corners",
            expected="pixels [x, y] of the cloth's four corners in frame 0",
            got=f"{farthest:.1f} px away from the outline",
        )
    require_quadrilateral(laid, corners, where)
    return corners
