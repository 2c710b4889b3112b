"""Two ways to give the template its texture, as interchangeable callables.

A loader takes one of these functions (or any other of the same signature) and calls it once with the
uncropped first frame, so no name is compared anywhere.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from toile.geometry.camera import Camera


class Texturing(Protocol):
    """Chooses texture and texture coordinates of a scene."""

    def __call__(
        self,
        *,
        template: Tensor,
        camera: Camera,
        first_frame: Tensor,
        texture: Tensor,
        texture_coordinates: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the texture (h_t, w_t, 3) and the coordinates (H, W, 2), v down, that go together.

        Args:
            template: (H, W, 3) [m], OpenCV camera frame.
            camera: camera of the uncropped first frame.
            first_frame: (h, w, 3), float32 in [0, 1], uncropped.
            texture: texture of the data set, (h_t, w_t, 3), float32 in [0, 1], upright.
            texture_coordinates: those of the data set, (H, W, 2), float32, v down.
        """


def from_file(
    *, template: Tensor, camera: Camera, first_frame: Tensor, texture: Tensor, texture_coordinates: Tensor
) -> tuple[Tensor, Tensor]:
    """Texture and coordinates as the data set has them."""
    return texture, texture_coordinates


def projected(
    *, template: Tensor, camera: Camera, first_frame: Tensor, texture: Tensor, texture_coordinates: Tensor
) -> tuple[Tensor, Tensor]:
    """The template projected into the first frame, which is the texture: u = x / width, v = y / height.

    Removes the 1 to 10 px by which the φ-SfT files' coordinates disagree with their own camera and template
    (4.8 px on R1). Vertices that project beside the mask take the background's colour.
    """
    return first_frame, project_coordinates(template, camera)


def project_coordinates(template: Tensor, camera: Camera) -> Tensor:
    """Coordinates (H, W, 2), float32, of a template (H, W, 3) [m] whose texture is the camera's image."""
    size = torch.tensor([camera.width, camera.height], dtype=template.dtype)
    return (camera.project(template) / size).to(torch.float32)
