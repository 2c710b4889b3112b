"""One motion of a data set: what it is, and what is known to be true of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toile.capture.arrays import read_arrays, write_arrays
from toile.errors import InputError
from toile.scenes.views import MultiView

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

TRUTH_FILE = "truth.npz"
_ARRAYS = ("body_positions", "body_faces", "garment_positions", "garment_faces")


@dataclass(frozen=True)
class PlannedClip:
    """A motion to make.

    Attributes:
        number: within the data set.
        motion: its name, one of ``motion.procedural.MOTIONS``.
        seed: of the data set.
    """

    number: int
    motion: str
    seed: int

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return f"{self.number:03d}-{self.motion}"

    def stream(self, purpose: int) -> np.random.Generator:
        """Random numbers for one purpose of this clip."""
        return np.random.default_rng([self.seed, self.number, purpose])


@dataclass(frozen=True)
class Truth:
    """The true motion of body and garment. World: right-handed, y up, floor at y = 0, metres.

    Attributes:
        body_positions: (F, V, 3) [m].
        body_faces: (Tb, 3).
        garment_positions: (F, N, 3) [m].
        garment_faces: (Tg, 3).
        fps: frames per second.
        landmarks: (F, L, 3) [m].
        landmark_names: L names.
        extra: further arrays of the file, e.g. where vertices of a coarser garment are.
    """

    body_positions: Floats
    body_faces: Indices
    garment_positions: Floats
    garment_faces: Indices
    fps: float
    landmarks: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))
    landmark_names: tuple[str, ...] = ()
    extra: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        frames = len(self.body_positions)
        if len(self.garment_positions) != frames:
            raise InputError(
                "Body and garment differ in their frames",
                where="truth",
                expected=f"{frames} frames of the garment",
                got=str(len(self.garment_positions)),
            )
        if not self.landmarks.size:
            object.__setattr__(self, "landmarks", np.zeros((frames, 0, 3)))

    @property
    def n_frames(self) -> int:
        """Number of frames F."""
        return len(self.body_positions)

    def save(self, path: Path, recording: MultiView | None = None) -> Path:
        """Write an .npz, positions in float32 (a tenth of a micrometre), cameras as K, R, t and image sizes.

        Args:
            path: file to write.
            recording: whose cameras are written as well.
        """
        arrays: dict[str, npt.NDArray[Any]] = {
            "body_positions": self.body_positions.astype(np.float32),
            "body_faces": self.body_faces.astype(np.int32),
            "garment_positions": self.garment_positions.astype(np.float32),
            "garment_faces": self.garment_faces.astype(np.int32),
            "fps": np.array(self.fps),
            "landmarks": self.landmarks.astype(np.float32),
            "landmark_names": np.array(self.landmark_names, dtype=np.str_),
            **self.extra,
        }
        if recording is not None:
            arrays |= {
                "camera_names": np.array([view.name for view in recording.views], dtype=np.str_),
                "K": np.stack([camera.K.numpy() for camera in recording.cameras]),
                "R": np.stack([camera.R.numpy() for camera in recording.cameras]),
                "t": np.stack([camera.t.numpy() for camera in recording.cameras]),
                "image_sizes": np.array([(c.height, c.width) for c in recording.cameras]),
            }
        return write_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path | str) -> Truth:
        """Read what ``save`` wrote, or any .npz with the four arrays of body and garment.

        Raises:
            InputError: missing, or the arrays do not fit.
        """
        arrays = read_arrays(path, "Truth", _ARRAYS)
        x, y = arrays["body_positions"], arrays["garment_positions"]
        for name, positions, faces in (
            ("body", x, arrays["body_faces"]),
            ("garment", y, arrays["garment_faces"]),
        ):
            good = positions.ndim == 3 and positions.shape[2] == 3 and faces.ndim == 2 and faces.shape[1] == 3
            if not good or (faces.size and not 0 <= faces.min() <= faces.max() < positions.shape[1]):
                raise InputError(
                    "Truth has arrays that do not fit",
                    where=f"{path}: {name}",
                    expected="positions (F, V, 3) and faces (T, 3) of these vertices",
                    got=f"{positions.shape} and {faces.shape}",
                )
        known = {*_ARRAYS, "fps", "landmarks", "landmark_names"}
        return cls(
            body_positions=x.astype(np.float64),
            body_faces=arrays["body_faces"].astype(np.int64),
            garment_positions=y.astype(np.float64),
            garment_faces=arrays["garment_faces"].astype(np.int64),
            fps=float(arrays.get("fps", np.array(25.0))),
            landmarks=arrays.get("landmarks", np.zeros((len(x), 0, 3))).astype(np.float64),
            landmark_names=tuple(map(str, arrays.get("landmark_names", ()))),
            extra={name: array for name, array in arrays.items() if name not in known},
        )


class Domain(ABC):
    """Where the truth and the images of a data set come from."""

    @abstractmethod
    def describe(self) -> Mapping[str, Any]:
        """Everything that a data set follows from, as JSON values: another description is another set."""

    @abstractmethod
    def plans(self) -> Sequence[PlannedClip]:
        """The clips of the set."""

    @abstractmethod
    def share(self, folder: Path) -> None:
        """Write what all clips share: subject and garment."""

    @abstractmethod
    def truth(self, plan: PlannedClip) -> Truth:
        """Simulate one clip; the same plan gives the same digits.

        Raises:
            SimulationError: no motion.
        """

    @abstractmethod
    def film(self, plan: PlannedClip, truth: Truth, folder: Path) -> MultiView:
        """Write images, masks and landmarks of one clip below ``folder`` and say what they are.

        Returns:
            The recording; files of view k are where ``native_views.view_files(view, "views/<name>")`` says.
        """
