"""A template without a video: geometry, texture and camera for generated scenes."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from toile.geometry.camera import Camera


@dataclass(frozen=True)
class Template:
    """A textured cloth template in the OpenCV camera frame.

    Attributes:
        name: name of the scene it belongs to, e.g. "R2".
        positions: (H, W, 3) [m], float64, grid (row i, column j).
        faces: triangles (2(H-1)(W-1), 3), int64, over the flattened grid (geometry.mesh.grid_faces).
        texture: (h_t, w_t, 3), float32 in [0, 1], row 0 on top.
        texture_coordinates: (H, W, 2), float32, u to the right and v down from the texture's top-left corner.
        cloth_size: rest length of the two sides [m], along grid axis 0 and axis 1.
        camera: camera of the uncropped image the template was made in.
        pinned_vertices: flattened grid indices of the vertices the data set holds.
        notes: what the loader changed or found remarkable.
    """

    name: str
    positions: Tensor
    faces: Tensor
    texture: Tensor
    texture_coordinates: Tensor
    cloth_size: tuple[float, float]
    camera: Camera
    pinned_vertices: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def grid(self) -> tuple[int, int]:
        """Grid size (H, W)."""
        return int(self.positions.shape[0]), int(self.positions.shape[1])
