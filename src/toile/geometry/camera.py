"""Pinhole camera in the OpenCV frame: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """Pinhole camera at the origin of the world.

    Pixel coordinates are continuous with (0, 0) at the top-left corner of the image, so the centre of the
    pixel in row r and column c is (c + 0.5, r + 0.5).

    Attributes:
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        height, width: image size [px].
    """

    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int

    @property
    def K(self) -> Tensor:
        """Intrinsic matrix, shape (3, 3), float64 [px]."""
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float64)

    def project(self, points: Tensor) -> Tensor:
        """Project points (..., 3) [m] to pixel coordinates (..., 2) as (x, y) [px]."""
        x, y, z = points.unbind(-1)
        return torch.stack((self.fx * x / z + self.cx, self.fy * y / z + self.cy), dim=-1)

    def crop(self, top: int, left: int, height: int, width: int) -> Camera:
        """Camera of the image cropped to rows [top, top + height) and columns [left, left + width)."""
        return Camera(self.fx, self.fy, self.cx - left, self.cy - top, height, width)

    def scaled(self, factor: float) -> Camera:
        """Camera of the image resized by ``factor`` (0.5 halves the size; sizes are rounded)."""
        return Camera(
            self.fx * factor,
            self.fy * factor,
            self.cx * factor,
            self.cy * factor,
            round(self.height * factor),
            round(self.width * factor),
        )
