"""What the networks state about the frames of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from toile.capture.arrays import read_arrays, write_arrays
from toile.capture.deformation.deform import Deformation
from toile.capture.deformation.translation import along_world, global_translation
from toile.capture.networks.pose_net import PoseNet
from toile.capture.networks.sim_net import SimNet
from toile.errors import InputError
from toile.geometry.camera import Camera

_BATCH = 16  # frames at a time; bounds memory, not the result
_ARRAYS = ("angles", "root", "translation", "K", "R", "t", "image_size", "fps")


class SeenFrames(Protocol):
    """What one camera has seen: all that a prediction is made of.

    Attributes:
        images: segmented crops (F, 4, S, S), float32, see ``networks.backbone.CHANNELS``.
        detections: 2D landmarks (F, L, 2) [px] in the camera's image.
        confidences: of these (F, L), 0 where there is none.
        camera: with its pose.
        fps: frames per second.
    """

    @property
    def images(self) -> Tensor:
        """See above."""

    @property
    def detections(self) -> Tensor:
        """See above."""

    @property
    def confidences(self) -> Tensor:
        """See above."""

    @property
    def camera(self) -> Camera:
        """See above."""

    @property
    def fps(self) -> float:
        """See above."""


@dataclass(frozen=True)
class Prediction:
    """Pose, deformation and place of F frames; everything float64.

    Attributes:
        angles: θ (F, D, 3) [rad].
        root: α (F, 3) [rad], relative to the camera.
        A: Euler angles of the garment's nodes (F, K, 3) [rad], None where the garment is posed only.
        T: translations of the garment's nodes (F, K, 3) [m], None where A is.
        translation: where the root joint is in the world (F, 3) [m].
        camera: the one that α is relative to, with its pose.
        fps: frames per second.

    Raises:
        InputError: arrays that do not fit together.
    """

    angles: Tensor
    root: Tensor
    A: Tensor | None
    T: Tensor | None
    translation: Tensor
    camera: Camera
    fps: float

    def __post_init__(self) -> None:
        frames = len(self.root)
        fits = self.angles.ndim == 3 and len(self.angles) == frames and self.angles.shape[2] == 3
        fits = fits and self.root.shape == (frames, 3) == self.translation.shape
        fits = fits and (self.A is None) == (self.T is None)
        if self.A is not None and self.T is not None:
            fits = fits and self.A.shape == self.T.shape == (frames, self.A.shape[1], 3)
        if not fits:
            shapes = [
                "none" if x is None else str(tuple(x.shape))
                for x in (self.angles, self.root, self.A, self.T, self.translation)
            ]
            raise InputError(
                "Prediction has arrays that do not fit",
                where="angles, root, A, T, translation",
                expected="(F, D, 3), (F, 3), (F, K, 3), (F, K, 3), (F, 3), A and T both or none",
                got=", ".join(shapes),
            )

    def __len__(self) -> int:
        return len(self.root)

    def placed(self, translation: Tensor) -> Prediction:
        """The same person elsewhere, e.g. where it truly is: (F, 3) [m]."""
        return replace(self, translation=translation.to(self.translation))

    def save(self, path: Path | str) -> Path:
        """Write an .npz; returns the path."""
        arrays = {
            "angles": self.angles.numpy(),
            "root": self.root.numpy(),
            "translation": self.translation.numpy(),
            "K": self.camera.K.numpy(),
            "R": self.camera.R.numpy(),
            "t": self.camera.t.numpy(),
            "image_size": np.array((self.camera.height, self.camera.width)),
            "fps": np.array(self.fps),
        }
        if self.A is not None and self.T is not None:
            arrays |= {"A": self.A.numpy(), "T": self.T.numpy()}
        return write_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path | str) -> Prediction:
        """Read what ``save`` wrote.

        Raises:
            InputError: missing, no prediction, or arrays that do not fit.
        """
        arrays = read_arrays(path, "Prediction", _ARRAYS)
        try:
            K, size = arrays["K"].astype(float), arrays["image_size"].astype(int)
            plain = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], int(size[0]), int(size[1]))
            R, t = (torch.from_numpy(arrays[name].astype(np.float64)) for name in ("R", "t"))
            camera = plain.with_pose(R, t)
            fps = float(arrays["fps"])
        except (IndexError, ValueError, TypeError) as error:
            raise InputError(
                "Prediction has no camera",
                where=str(path),
                expected="K (3, 3), R (3, 3), t (3,), image_size (2,), fps",
                got=f"{type(error).__name__}: {error}",
            ) from error

        def tensor(name: str) -> Tensor | None:
            return torch.from_numpy(arrays[name].astype(np.float64)) if name in arrays else None

        angles, root, translation = (torch.from_numpy(arrays[n].astype(np.float64)) for n in _ARRAYS[:3])
        try:
            return cls(angles, root, tensor("A"), tensor("T"), translation, camera, fps)
        except InputError as error:
            raise InputError(
                error.what, where=f"{path}: {error.where}", expected=error.expected, got=error.got
            ) from error

    def positions(self, deformation: Deformation, with_body: bool = True) -> tuple[Tensor, Tensor | None]:
        """Garment (F, N, 3) and body (F, V, 3) in the world, float64 [m]; no body if not asked for.

        Args:
            deformation: f of the same subject, garment and graph.
            with_body: whether to pose the body too.

        Raises:
            InputError: a skeleton or graph of another size.
        """
        with torch.no_grad():
            local = deformation(self.angles, self.root, self.A, self.T, with_body=with_body)
            world = local.map(lambda x: along_world(self.camera, x) + self.translation[:, None])
        return world.garment, world.body

    def landmarks(self, deformation: Deformation) -> Tensor:
        """Landmarks in the world (F, L, 3), float64 [m]."""
        with torch.no_grad():
            local = deformation(self.angles, self.root)
            return along_world(self.camera, local.landmarks) + self.translation[:, None]


@torch.no_grad()
def predict(
    pose_net: PoseNet, sim_net: SimNet | None, frames: SeenFrames, deformation: Deformation
) -> Prediction:
    """What the networks state about a camera's frames, each on its own.

    The person is placed by what the camera itself has detected: depth follows from its size.

    Args:
        pose_net: PoseNet.
        sim_net: SimNet, or None: the garment is posed with the body only.
        frames: of one camera.
        deformation: f of the subject and garment.

    Raises:
        InputError: images that do not fit the network, or a frame with too few landmarks to place a person.
    """
    device = next(pose_net.parameters()).device
    poses, bends = [], []
    training = pose_net.training, sim_net is not None and sim_net.training
    pose_net.eval()
    if sim_net is not None:
        sim_net.eval()
    for begin in range(0, len(frames.images), _BATCH):
        images = frames.images[begin : begin + _BATCH].to(device)
        poses.append([x.double().cpu() for x in pose_net(images)])
        if sim_net is not None:
            bends.append([x.double().cpu() for x in sim_net(images)])
    pose_net.train(training[0])
    if sim_net is not None:
        sim_net.train(training[1])
    angles, root = (torch.cat(parts) for parts in zip(*poses, strict=True))
    A, T = (torch.cat(parts) for parts in zip(*bends, strict=True)) if bends else (None, None)
    local = along_world(frames.camera, deformation(angles, root).landmarks)
    translation = global_translation(
        local, [frames.camera], frames.detections[:, None], frames.confidences[:, None]
    )
    return Prediction(angles, root, A, T, translation, frames.camera, frames.fps)
