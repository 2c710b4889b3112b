"""What every exporter takes: an animated, textured grid, and the conventions that all of them share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt

from toile.atomic_file import written_atomically
from toile.errors import InputError
from toile.geometry.mesh import grid_faces

Y_UP = np.array([1.0, -1.0, -1.0])
"""OpenCV camera frame (x right, y down, z forward) to y up, z towards the viewer: half a turn about x."""


@dataclass(frozen=True)
class ClothAnimation:
    """An animated cloth grid; vertex (i, j) has index i * W + j in every export.

    Attributes:
        positions: (F, H, W, 3) [m], camera frame (x right, y down, z forward).
        fps: frames per second, the mean where they are unevenly spaced.
        texture_coordinates: (H, W, 2), u to the right and v down from the texture's top-left corner, or None.
        texture: image (h_t, w_t, 3) in [0, 1], row 0 on top, or None.
        name: name of the object in the exported file.
        times: of the frames (F,) [s], increasing; None for frame f at f / fps. OBJ and PLY know no times.
    """

    positions: npt.NDArray[np.float64]
    fps: float
    texture_coordinates: npt.NDArray[np.floating] | None = None
    texture: npt.NDArray[np.floating] | None = None
    name: str = "cloth"
    times: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        x = self.positions
        if x.ndim != 4 or x.shape[-1] != 3 or min(x.shape[:3]) < 1 or min(x.shape[1:3]) < 2:
            raise _bad("positions", "shape (F, H, W, 3) in metres with F >= 1 and H, W >= 2", str(x.shape))
        if not np.isfinite(x).all():
            raise _bad(
                "positions", "finite numbers", f"{int((~np.isfinite(x)).sum())} that are NaN or infinite"
            )
        if not self.fps > 0:
            raise _bad("fps", "a positive number", str(self.fps))
        t = self.times
        if t is not None and (t.shape != x.shape[:1] or not (np.diff(t) > 0).all()):
            raise _bad("times", f"{len(x)} increasing numbers of seconds", str(t.tolist()))
        uv = self.texture_coordinates
        if uv is not None and uv.shape != (*x.shape[1:3], 2):
            raise _bad("texture_coordinates", f"shape {(*x.shape[1:3], 2)}", str(uv.shape))
        if self.texture is not None and (self.texture.ndim != 3 or self.texture.shape[2] != 3 or uv is None):
            got = f"{self.texture.shape}, {'without' if uv is None else 'with'} texture coordinates"
            raise _bad("texture", "shape (h_t, w_t, 3) together with texture coordinates", got)

    @property
    def n_frames(self) -> int:
        """Number of frames F."""
        return int(self.positions.shape[0])

    def frame_times(self) -> npt.NDArray[np.float64]:
        """Times of the frames (F,) [s]."""
        return np.arange(self.n_frames) / self.fps if self.times is None else self.times

    @property
    def grid(self) -> tuple[int, int]:
        """Grid size (H, W)."""
        return int(self.positions.shape[1]), int(self.positions.shape[2])

    def vertices(self, keep_camera_frame: bool = False) -> npt.NDArray[np.float64]:
        """Vertex positions (F, H * W, 3) [m], y up (x, −y, −z) unless the camera frame is to be kept."""
        flat = self.positions.reshape(self.n_frames, -1, 3).astype(np.float64)
        # Adding 0 turns −0 into 0, so that text formats do not print it.
        return flat if keep_camera_frame else flat * Y_UP + 0.0

    def uv(self, v_up: bool) -> npt.NDArray[np.float64] | None:
        """Texture coordinates (H * W, 2), v up from the bottom (OBJ, USD) or down from the top (glTF)."""
        if self.texture_coordinates is None:
            return None
        flat = self.texture_coordinates.reshape(-1, 2).astype(np.float64)
        return np.stack((flat[:, 0], 1.0 - flat[:, 1]), axis=1) if v_up else flat

    def quads(self) -> npt.NDArray[np.int64]:
        """Quads ((H - 1) * (W - 1), 4); same orientation as ``triangles``."""
        H, W = self.grid
        index = np.arange(H * W, dtype=np.int64).reshape(H, W)
        corners = (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
        return np.stack(corners, axis=-1).reshape(-1, 4)

    def triangles(self) -> npt.NDArray[np.int64]:
        """Triangles (2 (H - 1) (W - 1), 3), those of ``geometry.mesh.grid_faces``."""
        return grid_faces(*self.grid).numpy()

    def png(self) -> bytes | None:
        """The texture as PNG, or None."""
        if self.texture is None:
            return None
        image = (np.clip(self.texture, 0.0, 1.0) * 255.0).round().astype(np.uint8)
        return iio.imwrite("<bytes>", image, extension=".png")


def write_texture(animation: ClothAnimation, path: Path) -> bool:
    """Write the texture as PNG where there is one; says whether it did."""
    png = animation.png()
    if png is None:
        return False
    with written_atomically(path) as temporary:
        temporary.write_bytes(png)
    return True


def _bad(where: str, expected: str, got: str) -> InputError:
    return InputError("The animation cannot be exported", where=where, expected=expected, got=got)
