"""The one description of a recorded or generated video that everything downstream takes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.scenes.views import View


@dataclass(frozen=True)
class GroundTruth:
    """What is known of the true motion; used for evaluation only, never by a fit.

    Attributes:
        vertices: true grid positions (F, H, W, 3) [m], camera frame, or None.
        point_clouds: one (N_f, 3) float32 cloud [m] per frame, or None.
    """

    vertices: Tensor | None = None
    point_clouds: tuple[Tensor, ...] | None = None


@dataclass(frozen=True)
class Scene:
    """A video of one cloth, with its template and camera, in the OpenCV camera frame.

    Further cameras may have recorded it, too; what works on one view refuses such a scene
    (``require_one_camera``).

    Attributes:
        name: scene name, e.g. "R1".
        frames: RGB frames (F, h, w, 3), float32 in [0, 1], cropped to the cloth.
        masks: observed masks (F, h, w), float32 in [0, 1].
        camera: camera of the cropped frames.
        texture: texture image (h_t, w_t, 3), float32 in [0, 1], row 0 on top.
        texture_coordinates: (H, W, 2), float32, (u, v) in [0, 1] with u to the right and v DOWN
            from the texture's top-left corner.
        template: vertex positions at frame 0 (H, W, 3) [m], float64, grid (row i, column j).
        cloth_size: rest length of the two sides [m], along grid axis 0 (i) and axis 1 (j).
        gravity: (3,) float64 [m/s²].
        fps: frames per second, the mean where they are unevenly spaced.
        pinned_vertices: flattened grid indices i * W + j of pinned vertices.
        crop: (top, left) of the crop in the original image [px].
        original_size: (height, width) of the original image [px].
        ground_truth: see GroundTruth, or None.
        source: folder the scene was read from, or None.
        notes: what the loader changed or found remarkable, for the doctor and the log.
        times: of the frames (F,) float64 [s], the first 0; None where they are evenly spaced at ``fps``.
        views: of further cameras, whole images, with poses relative to ``camera``; () for a single one.
    """

    name: str
    frames: Tensor
    masks: Tensor
    camera: Camera
    texture: Tensor
    texture_coordinates: Tensor
    template: Tensor
    cloth_size: tuple[float, float]
    gravity: Tensor
    fps: float
    pinned_vertices: tuple[int, ...]
    crop: tuple[int, int] = (0, 0)
    original_size: tuple[int, int] = (0, 0)
    ground_truth: GroundTruth | None = None
    source: Path | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)
    times: Tensor | None = None
    views: tuple[View, ...] = ()

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """All calibrated cameras; the first is ``camera``, in whose frame the others' poses are."""
        return (self.camera, *(view.camera for view in self.views))

    @property
    def n_frames(self) -> int:
        """Number of frames F."""
        return int(self.frames.shape[0])

    @property
    def grid(self) -> tuple[int, int]:
        """Grid size (H, W)."""
        return int(self.template.shape[0]), int(self.template.shape[1])

    def with_texture_offset(self, offset: Tensor) -> Scene:
        """The scene with an offset, (H, W, 2) or flattened, added to its texture coordinates."""
        uv = self.texture_coordinates
        return replace(self, texture_coordinates=uv + offset.to(uv.dtype).reshape(uv.shape))


def require_one_camera(scene: Scene) -> Scene:
    """The scene, if a single camera recorded it.

    Raises:
        InputError: several did; to look at the first only would give their images away without a word.
    """
    if scene.views:
        raise InputError(
            f"Scene {scene.name} has several cameras",
            where=str(scene.source or scene.name),
            expected="one camera; dataclasses.replace(scene, views=()), or scene.json without cameras, keeps "
            "the first alone",
            got=", ".join(["the scene's own", *(view.name for view in scene.views)]),
        )
    return scene
