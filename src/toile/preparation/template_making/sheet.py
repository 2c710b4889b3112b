"""A template without any measured surface: a flat sheet of known size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from toile.errors import InputError
from toile.geometry.quadrilateral import four_corners, named_corners
from toile.geometry.rectangle_pose import rectangle_grid, rectangle_pose
from toile.limits import Positive, Unit
from toile.preparation.template_making.still import Still
from toile.preparation.template_making.surface import Layout, SurfaceGrid, require_clockwise
from toile.scenes.masks import outline_of


@dataclass(frozen=True)
class SheetSurface:
    """A flat rectangle of known size whose corners are those of the mask.

    Attributes:
        maximum_error: root mean square distance of the corners, as a fraction of the mean side in the image,
            above which the mask cannot be that of such a rectangle.
    """

    maximum_error: Annotated[Positive, Unit("px")]

    def lay_grid(self, still: Still, layout: Layout) -> SurfaceGrid:
        """Put a flat grid where the corners are seen; see Surface."""
        if layout.cloth_size is None:
            raise InputError(
                "Size of the cloth is not known",
                where="cloth_size",
                expected="cloth_size=[along the upper side, down the sides] in m; one camera cannot see it",
                got="none",
            )
        if layout.corners is None:
            outline = outline_of(still.mask)
            found = four_corners(outline, "mask 0")
            corners = outline[[found[k] for k in named_corners(outline[list(found)])]]
        else:
            corners = layout.corners
            require_clockwise(corners, "corners")
        rotation, translation, error = rectangle_pose(layout.cloth_size, corners, still.camera.K.numpy())
        side = float(np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1).mean())
        if translation[2] <= 0 or error > self.maximum_error * side:
            raise InputError(
                "Corners are not those of a flat rectangle of this size",
                where="cloth_size, corners, camera",
                expected=f"corners within {self.maximum_error * side:.1f} px of the projected rectangle",
                got=f"{error:.1f} px away (root mean square), sides {layout.cloth_size[0]:g} m and "
                f"{layout.cloth_size[1]:g} m, corners {corners.round(1).tolist()}",
            )
        positions = rectangle_grid(layout.cloth_size, layout.grid) @ rotation.T + translation
        tilt = float(np.degrees(np.arccos(min(1.0, abs(rotation[2, 2])))))
        return SurfaceGrid(
            positions,
            remarks={
                "input": "flat sheet (assumed)",
                "corners": f"{error:.2f} px from the mask's (root mean square)",
                "pose": f"{translation[2]:.3f} m away, tilted by {tilt:.1f} degrees",
            },
        )
