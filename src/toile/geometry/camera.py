"""Pinhole camera in the OpenCV frame: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]

NO_ROTATION: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
NO_TRANSLATION: Row = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera, at the origin of the world unless it has a pose.

    Pixel coordinates are continuous with (0, 0) at the top-left corner of the image, so the centre of the
    pixel in row r and column c is (c + 0.5, r + 0.5).

    Attributes:
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        height, width: image size [px].
        rotation: R, rows of a rotation matrix; world to camera frame is x_cam = R x + t.
        translation: t [m].
    """

    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int
    rotation: Matrix = NO_ROTATION
    translation: Row = NO_TRANSLATION

    @property
    def K(self) -> Tensor:
        """Intrinsic matrix, shape (3, 3), float64 [px]."""
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=torch.float64)

    @property
    def R(self) -> Tensor:
        """Rotation from the world to the camera frame, shape (3, 3), float64."""
        return torch.tensor(self.rotation, dtype=torch.float64)

    @property
    def t(self) -> Tensor:
        """Translation from the world to the camera frame, shape (3,), float64 [m]."""
        return torch.tensor(self.translation, dtype=torch.float64)

    @property
    def posed(self) -> bool:
        """Whether its frame is not that of the world."""
        return self.rotation != NO_ROTATION or self.translation != NO_TRANSLATION

    @property
    def centre(self) -> Tensor:
        """Where it stands in the world, (3,), float64 [m]."""
        return -self.R.T @ self.t

    def from_world(self, points: Tensor) -> Tensor:
        """Points of the world in the camera frame, (..., 3) [m]; the same tensor where it has no pose."""
        if not self.posed:
            return points
        return points @ self.R.T.to(points) + self.t.to(points)

    def project(self, points: Tensor) -> Tensor:
        """Project points of the world (..., 3) [m] to pixel coordinates (..., 2) as (x, y) [px]."""
        x, y, z = self.from_world(points).unbind(-1)
        return torch.stack((self.fx * x / z + self.cx, self.fy * y / z + self.cy), dim=-1)

    def crop(self, top: int, left: int, height: int, width: int) -> Camera:
        """Camera of the image cropped to rows [top, top + height) and columns [left, left + width)."""
        return replace(self, cx=self.cx - left, cy=self.cy - top, height=height, width=width)

    def scaled(self, factor: float) -> Camera:
        """Camera of the image resized by ``factor`` (0.5 halves the size; sizes are rounded)."""
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            height=round(self.height * factor),
            width=round(self.width * factor),
        )

    def with_pose(self, R: Tensor, t: Tensor) -> Camera:
        """The same camera elsewhere: R (3, 3) and t (3,) [m] take the world to its frame."""
        a, b, c = ((float(x), float(y), float(z)) for x, y, z in R.tolist())
        x, y, z = t.tolist()
        return replace(self, rotation=(a, b, c), translation=(float(x), float(y), float(z)))

    def at_origin(self) -> Camera:
        """The same camera with its frame as the world."""
        return replace(self, rotation=NO_ROTATION, translation=NO_TRANSLATION)

    def relative_to(self, other: Camera) -> Camera:
        """The same camera with the frame of another one as the world."""
        R = self.R @ other.R.T
        return self.with_pose(R, self.t - R @ other.t)


def looking_at(camera: Camera, centre: Tensor, target: Tensor, up: Tensor) -> Camera:
    """The camera at a place, turned towards a point and upright.

    Args:
        camera: intrinsics and size.
        centre: where it stands (3,) [m].
        target: what is in the middle of its view (3,) [m]; not straight above or below ``centre``.
        up: direction that points up in its image (3,).
    """
    forward = torch.nn.functional.normalize((target - centre).double(), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.double()), dim=0)
    R = torch.stack((right, torch.linalg.cross(forward, right), forward))
    return camera.with_pose(R, -R @ centre.double())
