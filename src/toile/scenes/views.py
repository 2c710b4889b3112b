"""What several calibrated cameras recorded at the same times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.scenes.images import read_mask, read_rgb

BODY_25 = (
    "nose",
    "neck",
    "right_shoulder",
    "right_elbow",
    "right_wrist",
    "left_shoulder",
    "left_elbow",
    "left_wrist",
    "mid_hip",
    "right_hip",
    "right_knee",
    "right_ankle",
    "left_hip",
    "left_knee",
    "left_ankle",
    "right_eye",
    "left_eye",
    "right_ear",
    "left_ear",
    "left_big_toe",
    "left_small_toe",
    "left_heel",
    "right_big_toe",
    "right_small_toe",
    "right_heel",
)
"""Landmarks of OpenPose's BODY_25, in its order."""


@dataclass(frozen=True)
class View:
    """What one camera recorded; images are read when they are asked for, since a recording may be long.

    Attributes:
        name: of the camera.
        camera: with its pose in the world; of the images as ``frame`` returns them.
        frame_paths: one RGB image per frame; empty where only masks are there.
        mask_paths: one mask of the person, garment included, per frame; empty where there is none.
        garment_mask_paths: one mask of the garment alone per frame; empty where there is none.
        landmarks: (F, L, 3), float32: x, y [px] in these images, confidence in [0, 1], 0 where not seen;
            None where there are none.
        distortion: OpenCV's coefficients k1, k2, p1, p2, ... of the files' lens, taken out when they are
            read.
    """

    name: str
    camera: Camera
    frame_paths: tuple[Path, ...] = ()
    mask_paths: tuple[Path, ...] = ()
    garment_mask_paths: tuple[Path, ...] = ()
    landmarks: Tensor | None = None
    distortion: tuple[float, ...] = ()

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return max(len(self.frame_paths), len(self.mask_paths))

    def frame(self, k: int) -> Tensor:
        """RGB frame k, (h, w, 3), float32 in [0, 1].

        Raises:
            InputError: it is missing or cannot be read.
        """
        return self._straight(read_rgb(self.frame_paths[k]))

    def mask(self, k: int) -> Tensor:
        """Mask k of the person, (h, w), float32 in [0, 1].

        Raises:
            InputError: it is missing or cannot be read.
        """
        return self._straight(read_mask(self.mask_paths[k]))

    def garment_mask(self, k: int) -> Tensor:
        """Mask k of the garment, (h, w), float32 in [0, 1].

        Raises:
            InputError: it is missing or cannot be read.
        """
        return self._straight(read_mask(self.garment_mask_paths[k]))

    def _straight(self, image: Tensor) -> Tensor:
        """The image without the lens's distortion, in [0, 1]."""
        if any(self.distortion):
            import cv2

            straight = cv2.undistort(image.numpy(), opencv_matrix(self.camera), np.array(self.distortion))
            image = torch.from_numpy(straight)
        return image.to(torch.float32) / 255


@dataclass(frozen=True)
class MultiView:
    """A recording by one or more calibrated cameras, without a template: those of a person are elsewhere.

    World: right-handed, y up, metres; every camera has its pose.

    Attributes:
        name: of the recording.
        views: one per camera.
        fps: frames per second, the same for all.
        landmark_names: of the 2D landmarks, empty where there are none.
        gravity: (3,) float64 [m/s²].
        source: folder it was read from, or None.
        notes: what the loader changed or found remarkable.
    """

    name: str
    views: tuple[View, ...]
    fps: float
    landmark_names: tuple[str, ...] = ()
    gravity: Tensor = field(default_factory=lambda: torch.tensor([0.0, -9.81, 0.0], dtype=torch.float64))
    source: Path | None = None
    notes: tuple[str, ...] = ()

    @property
    def n_frames(self) -> int:
        """Number of frames F."""
        return self.views[0].n_frames

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Every camera, with its pose."""
        return tuple(view.camera for view in self.views)

    def landmarks(self, names: Sequence[str]) -> Tensor:
        """2D landmarks of the named skeleton in all views, (C, F, L, 3): x, y [px], confidence.

        Args:
            names: of the landmarks wanted, in the order wanted, e.g. those of a subject.

        Raises:
            InputError: the recording has none, or those of another skeleton.
        """
        missing = [name for name in names if name not in self.landmark_names]
        where = str(self.source or self.name)
        if missing:
            raise InputError(
                "Landmarks are of another skeleton",
                where=where,
                expected=f"{len(names)} landmarks, among them {', '.join(missing[:5])}",
                got=", ".join(self.landmark_names[:30]) or "no landmarks",
            )
        chosen = [self.landmark_names.index(name) for name in names]
        found = [view.landmarks for view in self.views]
        without = [view.name for view in self.views if view.landmarks is None]
        if without:
            raise InputError(
                "Cameras lack landmarks",
                where=where,
                expected="landmarks of every camera",
                got=f"none of {', '.join(without)}",
            )
        return torch.stack([marks[:, chosen] for marks in found if marks is not None])


def opencv_matrix(camera: Camera) -> np.ndarray:
    """Intrinsic matrix (3, 3) as OpenCV counts pixels: (0, 0) is the centre of the top-left one."""
    K = camera.K.numpy().copy()
    K[:2, 2] -= 0.5
    return K
