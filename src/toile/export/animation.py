"""What exporters take: animated meshes, a textured grid above all, and the conventions that all share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
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


class Animation(ABC):
    """An animated mesh, as the exporters to one file see it.

    Attributes:
        fps: frames per second, the mean where they are unevenly spaced.
        name: name of the object in the exported file.
        times: of the frames (F,) [s], increasing; None for frame f at f / fps.
    """

    fps: float
    name: str
    times: npt.NDArray[np.float64] | None

    @property
    @abstractmethod
    def n_frames(self) -> int:
        """Number of frames F."""

    @abstractmethod
    def vertices(self, keep_camera_frame: bool = False) -> npt.NDArray[np.float64]:
        """Vertex positions (F, V, 3) [m], y up unless a camera frame is to be kept."""

    @abstractmethod
    def polygons(self) -> npt.NDArray[np.int64]:
        """Faces (P, 3) or (P, 4) as they are modelled."""

    @abstractmethod
    def triangles(self) -> npt.NDArray[np.int64]:
        """Faces (T, 3)."""

    def frame_times(self) -> npt.NDArray[np.float64]:
        """Times of the frames (F,) [s]."""
        return np.arange(self.n_frames) / self.fps if self.times is None else self.times

    def uv(self, v_up: bool) -> npt.NDArray[np.float64] | None:
        """Texture coordinates (V, 2), v up from the bottom or down from the top; None for none."""
        return None

    def png(self) -> bytes | None:
        """The texture as PNG, or None."""
        return None


@dataclass(frozen=True)
class MeshAnimation(Animation):
    """An animated triangle mesh without a texture; y up.

    Attributes:
        positions: (F, V, 3) [m], y up.
        faces: (T, 3).
        fps: frames per second.
        name: name of the object in the exported file.
        times: of the frames (F,) [s]; None for frame f at f / fps.
    """

    positions: npt.NDArray[np.floating]
    faces: npt.NDArray[np.integer]
    fps: float
    name: str = "mesh"
    times: npt.NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        x, faces = self.positions, self.faces
        if x.ndim != 3 or x.shape[-1] != 3 or min(x.shape[:2]) < 1:
            raise _bad("positions", "shape (F, V, 3) in metres with F >= 1", str(x.shape))
        _check_numbers(x, self.fps, self.times)
        good = faces.ndim == 2 and faces.shape[1] == 3 and len(faces) > 0
        if not good or not 0 <= faces.min() <= faces.max() < x.shape[1]:
            raise _bad("faces", f"shape (T, 3), indices below {x.shape[1]}", str(faces.shape))

    @property
    def n_frames(self) -> int:
        """Number of frames F."""
        return int(self.positions.shape[0])

    def vertices(self, keep_camera_frame: bool = False) -> npt.NDArray[np.float64]:
        """Vertex positions (F, V, 3) [m]; the world has y up already."""
        return self.positions.astype(np.float64)

    def polygons(self) -> npt.NDArray[np.int64]:
        """Faces (T, 3)."""
        return self.faces.astype(np.int64)

    def triangles(self) -> npt.NDArray[np.int64]:
        """Faces (T, 3)."""
        return self.faces.astype(np.int64)


@dataclass(frozen=True)
class ClothAnimation(Animation):
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
        _check_numbers(x, self.fps, self.times)
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

    def polygons(self) -> npt.NDArray[np.int64]:
        """The quads."""
        return self.quads()

    def triangles(self) -> npt.NDArray[np.int64]:
        """Triangles (2 (H - 1) (W - 1), 3), those of ``geometry.mesh.grid_faces``."""
        return grid_faces(*self.grid).numpy()

    def png(self) -> bytes | None:
        """The texture as PNG, or None."""
        if self.texture is None:
            return None
        image = (np.clip(self.texture, 0.0, 1.0) * 255.0).round().astype(np.uint8)
        return iio.imwrite("<bytes>", image, extension=".png")


def of_equal_length(animations: Animation | Sequence[Animation]) -> tuple[Animation, ...]:
    """One animation or several that belong into one file.

    Raises:
        InputError: none, two of one name, or other frames than the first one's.
    """
    found = (animations,) if isinstance(animations, Animation) else tuple(animations)
    if not found:
        raise _bad("animations", "at least one", "none")
    names = [a.name for a in found]
    if len(set(names)) < len(names):
        raise _bad("names", "a name of its own for every mesh", ", ".join(names))
    first = found[0]
    for other in found[1:]:
        if other.fps != first.fps or not np.array_equal(other.frame_times(), first.frame_times()):
            expected = f"{first.n_frames} frames at {first.fps:g} a second, as {first.name}"
            raise _bad(other.name, expected, f"{other.n_frames} at {other.fps:g}")
    return found


def remove_later_frames(folder: Path, suffix: str, n_frames: int) -> None:
    """Remove files of frames that an earlier, longer animation has left: they would pass for its own.

    Args:
        folder: of ``frame_0000.obj`` and its like.
        suffix: of the files.
        n_frames: of this animation.
    """
    for path in folder.glob(f"frame_*{suffix}"):
        number = path.stem.removeprefix("frame_")
        if number.isdigit() and int(number) >= n_frames:
            path.unlink()


def write_texture(animation: Animation, path: Path) -> bool:
    """Write the texture as PNG where there is one; says whether it did."""
    png = animation.png()
    if png is None:
        return False
    with written_atomically(path) as temporary:
        temporary.write_bytes(png)
    return True


def _check_numbers(x: npt.NDArray[np.floating], fps: float, t: npt.NDArray[np.float64] | None) -> None:
    if not np.isfinite(x).all():
        raise _bad("positions", "finite numbers", f"{int((~np.isfinite(x)).sum())} that are NaN or infinite")
    if not fps > 0:
        raise _bad("fps", "a positive number", str(fps))
    if t is not None and (t.shape != x.shape[:1] or not (np.diff(t) > 0).all()):
        raise _bad("times", f"{len(x)} increasing numbers of seconds", str(t.tolist()))


def _bad(where: str, expected: str, got: str) -> InputError:
    return InputError("The animation cannot be exported", where=where, expected=expected, got=got)
