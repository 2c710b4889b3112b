"""What a template is made of: one class per kind of surface, all with the same method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from scipy import ndimage

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.geometry.quadrilateral import signed_area
from toile.geometry.surface import Floats
from toile.preparation.template_making.still import Still

FLIPS = {
    "x and y negated (axes=phi_sft)": (-1.0, -1.0, 1.0),
    "y and z negated (axes=opengl)": (1.0, -1.0, -1.0),
    "x negated": (-1.0, 1.0, 1.0),
    "y negated": (1.0, -1.0, 1.0),
}
"""Usual mistakes, tried to say which one it may be."""


@dataclass(frozen=True)
class Layout:
    """How the grid is to lie on the surface.

    Attributes:
        grid: (H, W).
        cloth_size: rest length [m] along axis 0 (the upper side) and axis 1, or None if not known.
        corners: pixels (4, 2) of the corners, clockwise from that of vertex [0, 0] on, or None to find them.
    """

    grid: tuple[int, int]
    cloth_size: tuple[float, float] | None
    corners: Floats | None


@dataclass(frozen=True)
class SurfaceGrid:
    """A grid on a surface.

    Attributes:
        positions: (H, W, 3) [m], camera frame; row-major, clockwise as the camera sees it.
        to_template: distances [m] from the input surface to the grid, empty if there was no input surface.
        to_surface: distances [m] from the grid's vertices to the input surface, empty as above.
        remarks: measured on the way, name and value for people.
    """

    positions: Floats
    to_template: Floats = field(default_factory=lambda: np.zeros(0))
    to_surface: Floats = field(default_factory=lambda: np.zeros(0))
    remarks: dict[str, str] = field(default_factory=dict)


class Surface(Protocol):
    """A surface that a template can be made of."""

    def lay_grid(self, still: Still, layout: Layout) -> SurfaceGrid:
        """Lay a grid on the cloth.

        Raises:
            InputError: the surface cannot be that of the cloth in the still.
        """


def project(camera: Camera, points: Floats) -> Floats:
    """Pixels (N, 2) of positions (N, 3)."""
    pixels: Floats = camera.project(torch.from_numpy(np.ascontiguousarray(points))).numpy()
    return pixels


def inside_mask(points: Floats, still: Still, margin: int = 0) -> np.ndarray:
    """Which positions (N, 3) are in front of the camera and project into the mask, widened by some pixels."""
    mask = still.mask.numpy() > 0.5
    if margin:
        mask = ndimage.binary_dilation(mask, iterations=margin)
    z = points[:, 2]
    front = points[z > 0]
    seen = np.zeros(len(points), dtype=bool)
    pixels = np.floor(project(still.camera, front))
    h, w = mask.shape
    visible = ((pixels >= 0) & (pixels < (w, h))).all(1)
    column, row = pixels[visible].astype(int).T
    hit = np.zeros(len(front), dtype=bool)
    hit[visible] = mask[row, column]
    seen[z > 0] = hit
    return seen


def require_seen(points: Floats, still: Still, least: float, where: str) -> None:
    """Raise InputError unless a fraction of the positions (N, 3) projects into the mask."""
    fraction = _fraction_inside(points, still)
    if fraction >= least:
        return
    flips = {name: _fraction_inside(points * np.array(f), still) for name, f in FLIPS.items()}
    best = max(flips, key=lambda name: flips[name])
    got = f"{100 * fraction:.1f} % of {len(points)} points"
    if flips[best] >= max(least, 1.2 * fraction):
        got += f"; with {best} it would be {100 * flips[best]:.1f} %"
    elif float(np.median(points[:, 2])) <= 0:
        got += f"; most are behind the camera, median z {float(np.median(points[:, 2])):.4g} m"
    elif float(np.median(points[:, 2])) > 50:
        got += f"; median z {float(np.median(points[:, 2])):.4g} m, is the file in mm (axes.scale=0.001)?"
    raise InputError(
        "Surface does not project onto the mask",
        where=where,
        expected=f"at least {100 * least:.0f} % of the points inside mask 0, seen from the camera frame "
        "(x right, y down, z forward, metres)",
        got=got,
    )


def _fraction_inside(points: Floats, still: Still) -> float:
    # A vertex of the border projects onto the mask's border, one side or the other.
    return float(inside_mask(points, still, margin=2).mean())


def require_clockwise(corners: Floats, where: str) -> None:
    """Raise InputError unless pixels (4, 2) run clockwise, as otherwise the texture would be mirrored."""
    if signed_area(corners) <= 0:
        raise InputError(
            "Corners do not run clockwise in the image",
            where=where,
            expected="[[x, y], ...] in px: upper left, upper right, lower right, lower left",
            got=str(corners.round(1).tolist()),
        )
