"""Frames of a data set as networks see them: crops around the person, and what all cameras say of a frame."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample, interpolate, pad

from toile.atomic_file import written_atomically
from toile.capture.body.subject import Subject
from toile.capture.data.making import DATA_FILE, clips_of
from toile.capture.garments.garment import Garment
from toile.capture.layer.silhouette import SilhouetteRays
from toile.capture.losses.silhouette import distance_field
from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.limits import Count, Fraction, NonNegative
from toile.progress import Report, counted, silent
from toile.scenes.multi_view import load_multi_view
from toile.scenes.views import MultiView, View

_MARGIN = 0.08
"""Free space around the person's mask, of the longer side of its box."""
_FIELD_UNIT = 1 / 32  # px; in which distances are kept
_CACHE = "frames"


@dataclass(frozen=True)
class CameraFrames:
    """What one camera has seen of F frames; fits ``prediction.SeenFrames``.

    Attributes:
        images: segmented crops (F, 4, S, S), float32, see ``networks.backbone.CHANNELS``.
        boxes: left, top, side of the crops in the camera's image (F, 3) [px].
        detections: 2D landmarks (F, L, 2) [px] in the camera's image.
        confidences: of these (F, L), 0 where there is none.
        camera: with its pose.
        fps: frames per second.
    """

    images: Tensor
    boxes: Tensor
    detections: Tensor
    confidences: Tensor
    camera: Camera
    fps: float


def camera_frames(
    recording: MultiView, view: int, landmark_names: Sequence[str], side: int, report: Report = silent
) -> CameraFrames:
    """The frames of one camera of a recording.

    Args:
        recording: with images, masks of person and garment, and landmarks.
        view: number of the camera.
        landmark_names: of the subject.
        side: S [px].
        report: progress.

    Raises:
        InputError: no such view, no images, masks or landmarks, or a frame without a person.
    """
    if not 0 <= view < len(recording.views):
        raise InputError(
            "No such camera",
            where=str(recording.source or recording.name),
            expected=f"0 to {len(recording.views) - 1}",
            got=str(view),
        )
    seen = recording.views[view]
    marks = recording.landmarks(landmark_names)[view]
    crops, boxes = [], []
    for frame in counted(range(recording.n_frames), report, "frames read", recording.n_frames):
        crop, box = segmented_crop(seen, frame, side)
        crops.append(crop)
        boxes.append(box)
    return CameraFrames(
        torch.stack(crops).float() / 255,
        torch.tensor(boxes),
        marks[..., :2].double(),
        marks[..., 2].double(),
        seen.camera,
        recording.fps,
    )


def segmented_crop(view: View, frame: int, side: int) -> tuple[Tensor, tuple[int, int, int]]:
    """A square around the person, without the background, and the garment's mask.

    Args:
        view: with images and masks.
        frame: its number.
        side: S [px].

    Returns:
        Crop (4, S, S), uint8, and its box: left, top, side [px] in the camera's image.

    Raises:
        InputError: files are missing, or the mask is empty.
    """
    for name, paths in (
        ("images", view.frame_paths),
        ("masks of the person", view.mask_paths),
        ("masks of the garment", view.garment_mask_paths),
    ):
        if len(paths) <= frame:
            raise InputError(
                f"Recording lacks {name}",
                where=f"camera {view.name}",
                expected=f"{name} of every frame: the networks see them",
                got=f"{len(paths)} of {view.n_frames}",
            )
    person = view.mask(frame)
    found = (person > 0.5).nonzero()
    if not len(found):
        raise InputError(
            "There is no person in a frame",
            where=str(view.mask_paths[frame]),
            expected="a mask of the person",
            got="an empty mask",
        )
    (top, left), (bottom, right) = found.amin(0).tolist(), (found.amax(0) + 1).tolist()
    size = round((1 + 2 * _MARGIN) * max(bottom - top, right - left))
    left, top = (left + right - size) // 2, (top + bottom - size) // 2
    layers = torch.cat((view.frame(frame) * person[..., None], view.garment_mask(frame)[..., None]), -1)
    height, width = person.shape
    # Beyond the image there is nothing.
    before, after = (max(-left, 0), max(-top, 0)), (max(left + size - width, 0), max(top + size - height, 0))
    padded = pad(layers.permute(2, 0, 1), (before[0], after[0], before[1], after[1]))
    column, row = left + before[0], top + before[1]
    square = padded[None, :, row : row + size, column : column + size]
    crop = interpolate(square, (side, side), mode="bilinear", antialias=True, align_corners=False)[0]
    return (255 * crop.clamp(0, 1)).round().byte(), (left, top, size)


@dataclass(frozen=True)
class Augmentation:
    """By how much crops are changed at random in training; ours.

    Attributes:
        shift: of the crop, at most, of its side.
        scale: of the crop, at most.
        gain: of each colour, at most.
    """

    shift: Fraction = 0.04
    scale: Fraction = 0.06
    gain: NonNegative = 0.2

    def __call__(self, images: Tensor, rng: np.random.Generator, *, alike: bool = False) -> Tensor:
        """Change crops (B, 4, S, S).

        Args:
            images: the crops.
            rng: random numbers.
            alike: whether all are changed in the same way.
        """
        n = 1 if alike else len(images)
        scale = 1 + self.scale * rng.uniform(-1, 1, n)
        # Grids reach from -1 to 1.
        shift = 2 * self.shift * rng.uniform(-1, 1, (n, 2))
        gain = 1 + self.gain * rng.uniform(-1, 1, (n, 3))
        maps = np.zeros((n, 2, 3), np.float32)
        maps[:, 0, 0] = maps[:, 1, 1] = scale
        maps[:, :, 2] = shift
        theta = torch.from_numpy(maps).to(images).expand(len(images), -1, -1)
        grid = affine_grid(theta, list(images.shape), align_corners=False)
        moved = grid_sample(images, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        factor = torch.cat((torch.from_numpy(gain), torch.ones(n, 1)), 1).to(images)
        return (moved * factor[..., None, None]).clamp(0, 1)


@dataclass(frozen=True)
class Sample:
    """One frame as one camera sees it.

    Attributes:
        clip: number of the clip.
        camera: number of the camera whose image goes into the networks.
        frame: number of the frame in the clip.
    """

    clip: int
    camera: int
    frame: int


@dataclass(frozen=True)
class Batch:
    """B frames, each seen by one camera and watched by C.

    Attributes:
        samples: B of them.
        images: of the cameras that see (B, 4, S, S), float32.
        detections: 2D landmarks in all cameras' images (B, C, L, 2) [px].
        confidences: of these (B, C, L).
    """

    samples: tuple[Sample, ...]
    images: Tensor
    detections: Tensor
    confidences: Tensor


class Clip:
    """A clip of a data set; what is made of its images is made once and kept beside it.

    Args:
        folder: of the clip.
        landmark_names: of the subject.
        side: of the crops [px].
        cache: where to keep them.

    Attributes:
        recording: its images, masks and cameras.
        landmarks: (C, F, L, 3): x, y [px], confidence.
    """

    def __init__(self, folder: Path, landmark_names: Sequence[str], side: int, cache: Path) -> None:
        self.recording = load_multi_view(folder)
        self.landmarks = self.recording.landmarks(landmark_names)
        self.name = folder.name
        self._side = side
        self._cache = cache

    @property
    def n_frames(self) -> int:
        """F."""
        return self.recording.n_frames

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """C of them."""
        return self.recording.cameras

    @cached_property
    def crops(self) -> npt.NDArray[np.uint8]:
        """(C, F, 4, S, S)."""
        path = self._file(f"crops-{self._side}")
        if not path.is_file():
            made = [
                torch.stack([segmented_crop(view, f, self._side)[0] for f in range(self.n_frames)]).numpy()
                for view in self.recording.views
            ]
            _write(path, np.stack(made))
        return _opened(path)

    @cached_property
    def fields(self) -> npt.NDArray[np.int16]:
        """Signed distances (C, F, H, W) in units of 1/32 px."""
        path = self._file("distances")
        if not path.is_file():
            made = []
            for view in self.recording.views:
                masks = [view.mask(f) > 0.5 for f in range(self.n_frames)]
                distances = torch.stack([distance_field(mask) for mask in masks]) / _FIELD_UNIT
                made.append(distances.round().clamp(-32767, 32767).numpy().astype(np.int16))
            _write(path, np.stack(made))
        return _opened(path)

    def distances(self, frame: int) -> Tensor:
        """D of all cameras (C, H, W), float32 [px]."""
        return _FIELD_UNIT * torch.from_numpy(np.stack([field[frame] for field in self.fields])).float()

    def rays(self, frame: int) -> list[SilhouetteRays]:
        """Silhouettes of all cameras for Eq. 1."""
        return [
            SilhouetteRays.of_mask(
                view.camera, (view.garment_mask(frame) > 0.5).numpy(), (view.mask(frame) > 0.5).numpy()
            )
            for view in self.recording.views
        ]

    def _file(self, what: str) -> Path:
        # Other images give another file.
        digest = hashlib.sha256()
        for view in self.recording.views:
            for path in (*view.frame_paths, *view.mask_paths, *view.garment_mask_paths):
                state = path.stat()
                digest.update(f"{path.name} {state.st_size} {state.st_mtime_ns}\n".encode())
        return self._cache / f"{self.name}-{what}-{digest.hexdigest()[:12]}.npy"


class TrainingSet:
    """Clips of one subject in one garment, filmed by the same cameras.

    Args:
        subject: who moves.
        garment: worn.
        clips: one or more.
        source: short name of what they are, for descriptions.

    Attributes:
        cameras: C of them.
        side: of their images [px], for losses that do not depend on it.

    Raises:
        InputError: no clips, or cameras that differ.
    """

    def __init__(self, subject: Subject, garment: Garment, clips: Sequence[Clip], source: str = "") -> None:
        if not clips:
            raise InputError(
                "Data set has no clips", where="folder", expected="one finished clip or more", got="none"
            )
        self.subject, self.garment, self.clips = subject, garment, tuple(clips)
        self.source = source
        self.cameras = clips[0].cameras
        self.side = self.cameras[0].width
        for clip in clips:
            if clip.cameras != self.cameras or clip.recording.fps != self.fps:
                raise InputError(
                    "Clips of a data set differ in their cameras",
                    where=clip.name,
                    expected=f"the cameras and frame rate of {clips[0].name}",
                    got=f"{len(clip.cameras)} cameras, {clip.recording.fps:g} frames per second",
                )

    @staticmethod
    def load(folder: Path, side: int, cache: Path | None = None) -> TrainingSet:
        """A data set as ``toile capture data`` writes it.

        Args:
            folder: of the set, or of one of its clips.
            side: of the crops [px].
            cache: where to keep crops and distances; in the set if None.

        Raises:
            InputError: it is none, or one of its files is unusable.
        """
        clips = clips_of(folder)
        home = folder if (folder / "subject.npz").is_file() else folder.parent
        subject = Subject.load(home / "subject.npz")
        garment = Garment.load(home / "garment.npz")
        place = home / _CACHE if cache is None else cache
        return TrainingSet(
            subject,
            garment,
            [Clip(c, subject.landmark_names, side, place) for c in clips],
            _source(home, clips),
        )

    def only(self, camera: int) -> TrainingSet:
        """The same frames watched by one camera only."""
        return _OneCamera(self, camera)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.clips[0].recording.fps

    @property
    def n_images(self) -> int:
        """Images of all cameras and clips."""
        return len(self.seeing) * sum(clip.n_frames for clip in self.clips)

    @property
    def seeing(self) -> tuple[int, ...]:
        """Numbers of the cameras whose images the networks get."""
        return tuple(range(len(self.clips[0].cameras)))

    def prepare(self, report: Report = silent) -> None:
        """Make crops and distances of all clips."""
        for clip in counted(self.clips, report, "clips read", len(self.clips)):
            _ = clip.crops, clip.fields

    def draw(self, count: Count, length: Count, rng: np.random.Generator) -> list[list[Sample]]:
        """Windows of consecutive frames, each seen by one camera, at random.

        Args:
            count: of the windows.
            length: F, frames of each.
            rng: random numbers.

        Raises:
            InputError: no clip is as long.
        """
        starts = np.array([max(clip.n_frames - length + 1, 0) for clip in self.clips])
        if not starts.sum():
            raise InputError(
                "Clips are shorter than a window",
                where="frames",
                expected=f"{length} frames or more",
                got=f"{max(clip.n_frames for clip in self.clips)} at most",
            )
        ends = np.cumsum(starts)
        windows = []
        for chosen in rng.integers(ends[-1], size=count):
            clip = int(np.searchsorted(ends, chosen, side="right"))
            begin = int(chosen - (ends[clip] - starts[clip]))
            camera = int(rng.choice(self.seeing))
            windows.append([Sample(clip, camera, begin + k) for k in range(length)])
        return windows

    def batch(self, samples: Sequence[Sample]) -> Batch:
        """What is known of frames."""
        crops = np.stack([self.clips[s.clip].crops[s.camera, s.frame] for s in samples])
        marks = torch.stack([self.clips[s.clip].landmarks[self._watching, s.frame] for s in samples])
        return Batch(tuple(samples), torch.from_numpy(crops).float() / 255, marks[..., :2], marks[..., 2])

    def distances(self, samples: Sequence[Sample]) -> Tensor:
        """D of frames in all cameras (B, C, H, W), float32 [px]."""
        return torch.stack([self.clips[s.clip].distances(s.frame)[self._watching] for s in samples])

    def rays(self, sample: Sample) -> list[SilhouetteRays]:
        """Silhouettes of a frame in all cameras, for Eq. 1."""
        rays = self.clips[sample.clip].rays(sample.frame)
        return [rays[camera] for camera in self._watching]

    @property
    def _watching(self) -> list[int]:
        return list(range(len(self.clips[0].cameras)))


class _OneCamera(TrainingSet):
    """A data set of which one camera alone is known."""

    def __init__(self, whole: TrainingSet, camera: int) -> None:
        super().__init__(whole.subject, whole.garment, whole.clips, whole.source)
        if not 0 <= camera < len(self.cameras):
            raise InputError(
                "No such camera", where="camera", expected=f"0 to {len(self.cameras) - 1}", got=str(camera)
            )
        self._camera = camera
        self.cameras = (self.cameras[camera],)

    @property
    def seeing(self) -> tuple[int, ...]:
        """See TrainingSet."""
        return (self._camera,)

    @property
    def _watching(self) -> list[int]:
        return [self._camera]


def _source(home: Path, clips: Sequence[Path]) -> str:
    """A data set follows from its description; where it lies is no matter."""
    description = (home / DATA_FILE).read_bytes() if (home / DATA_FILE).is_file() else b""
    names = ", ".join(clip.name for clip in clips)
    return f"{hashlib.sha256(description).hexdigest()[:12]}: {names}"


def _write(path: Path, array: npt.NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        np.save(file, array, allow_pickle=False)


def _opened(path: Path) -> npt.NDArray[Any]:
    """Mapped into memory: a data set may be larger than that."""
    try:
        array: npt.NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise InputError(
            "Prepared frames cannot be read",
            where=str(path),
            expected="a file of ours; delete it, and it is made again",
            got=f"{type(error).__name__}: {error}",
        ) from error
    return array
