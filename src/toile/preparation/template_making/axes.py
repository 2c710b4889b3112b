"""How the axes and the unit of a file become the camera frame in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from toile.errors import InputError
from toile.geometry.surface import Floats
from toile.limits import Positive


@dataclass(frozen=True)
class Axes:
    """position in the camera frame [m] = scale · rotation @ position in the file + translation.

    Attributes:
        rotation: 3×3, by rows; a reflection is allowed (files may be left-handed), a scaling is not.
        translation: (3,) [m].
        scale: metres per unit of the file.
    """

    rotation: Sequence[Sequence[float]]
    translation: Sequence[float]
    scale: Positive

    def to_camera(self, points: Floats) -> Floats:
        """Positions (N, 3) of the file in the OpenCV camera frame [m].

        Raises:
            InputError: the rotation is no rotation or reflection, or the scale is not positive.
        """
        rotation = np.array(self.rotation, dtype=np.float64)
        orthogonal = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        if not orthogonal or len(self.translation) != 3 or not self.scale > 0:
            turned = f"rotation {rotation.tolist()}"
            raise InputError(
                "Axes are no rotation or reflection",
                where="axes",
                expected="three orthogonal unit rows, three numbers of translation, scale > 0",
                got=f"{turned}, translation {list(self.translation)}, scale {self.scale:g}",
            )
        moved: Floats = self.scale * points @ rotation.T + np.array(self.translation, dtype=np.float64)
        return moved
