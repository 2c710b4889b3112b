"""A user's own recording by several cameras, in the layout of EasyMocap.

::

    intri.yml (or .json)       OpenCV file storage: names, K_<camera>, dist_<camera>
    extri.yml (or .json)       Rot_<camera> (3 x 3) or R_<camera> (3, Rodrigues vector), T_<camera> [m]
    images/<camera>/*          one per frame, in the order of their names
    mask/<camera>/*            of the person, 0 outside; also masks/
    garment/<camera>/*         of the garment alone, optional
    openpose/<camera>/*.json   one per frame, BODY_25, optional

Images or masks may be missing, but not both. EasyMocap's world has z up; here y is up.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.scenes.findings import Finding, Severity, attempt, has_errors
from toile.scenes.images import image_size
from toile.scenes.openpose import read_openpose
from toile.scenes.view_checks import check_views
from toile.scenes.views import BODY_25, MultiView, View, opencv_matrix

_PICTURES = (".png", ".jpg", ".jpeg")
UP = {
    "y": torch.eye(3, dtype=torch.float64),
    "z": torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64),
}
"""World with y up to the file's world, by which of its axes points up; columns are our axes."""


def is_easymocap(folder: Path) -> bool:
    """Whether a folder holds calibrations in this layout."""
    return _calibration(folder, "intri") is not None


def survey_easymocap(
    folder: Path | str, *, fps: float, n_frames: int | None = None, up: str = "z"
) -> tuple[MultiView | None, list[Finding]]:
    """Read calibrations and landmarks, find the images, and collect what is wrong.

    Args:
        folder: see the module.
        fps: frames per second; the layout does not say.
        n_frames: consider only the first frames; None for all.
        up: axis of the calibration's world that points up, "z" or "y".

    Returns:
        The recording with y up, or None if anything needed for it failed, and all findings.
    """
    folder = Path(folder)
    findings: list[Finding] = []
    if up not in UP:
        findings.append(Finding(Severity.ERROR, "No such axis", "up", ", ".join(UP), str(up)))
        return None, findings
    files = attempt(findings, lambda: (_Storage(folder, "intri"), _Storage(folder, "extri")))
    if files is None:
        return None, findings
    intrinsics, extrinsics = files
    names = attempt(findings, lambda: intrinsics.names("names"))
    views = []
    crowded = 0
    for name in names or ():
        found = attempt(findings, partial(_view, folder, name, intrinsics, extrinsics, n_frames, UP[up]))
        if found is not None:
            views.append(found[0])
            crowded += found[1]
    if has_errors(findings):
        return None, findings
    if crowded:
        expected, got = "one person", f"several in {crowded} images"
        where = str(folder / "openpose")
        findings.append(Finding(Severity.WARNING, "Landmarks of several people", where, expected, got))
    some = any(view.landmarks is not None for view in views)
    recording = MultiView(
        name=folder.resolve().name,
        views=tuple(views),
        fps=fps,
        landmark_names=BODY_25 if some else (),
        source=folder,
    )
    findings += check_views(recording)
    return (None if has_errors(findings) else recording), findings


def _view(
    folder: Path, name: str, intrinsics: _Storage, extrinsics: _Storage, n: int | None, up: torch.Tensor
) -> tuple[View, int]:
    K = intrinsics.matrix(f"K_{name}", 9).reshape(3, 3)
    if abs(K[0, 1]) > 1e-6 or K[1, 0] or K[2].tolist() != [0, 0, 1]:
        raise InputError(
            "Intrinsic matrix cannot be used",
            where=f"{intrinsics.path}: K_{name}",
            expected="[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], no skew",
            got=str(K.tolist()),
        )
    frames = _pictures(folder / "images" / name)[:n]
    masks = (_pictures(folder / "mask" / name) or _pictures(folder / "masks" / name))[:n]
    garments = _pictures(folder / "garment" / name)[:n]
    if not frames and not masks:
        raise InputError(
            f"Camera {name} recorded nothing",
            where=str(folder),
            expected=f"images/{name}/ or mask/{name}/ with .png or .jpg",
            got="neither",
        )
    size = image_size((frames or masks)[0])
    # OpenCV counts from the centre of the top-left pixel, toile from its corner.
    camera = Camera(K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *size)
    if extrinsics.has(f"Rot_{name}"):
        R = extrinsics.matrix(f"Rot_{name}", 9).reshape(3, 3)
    else:
        import cv2

        R = np.asarray(cv2.Rodrigues(extrinsics.matrix(f"R_{name}", 3))[0], np.float64)
    t = extrinsics.matrix(f"T_{name}", 3)
    camera = camera.with_pose(torch.from_numpy(R) @ up, torch.from_numpy(t))
    distortion: tuple[float, ...] = ()
    for key in (f"dist_{name}", f"D_{name}"):
        if intrinsics.has(key):
            distortion = tuple(intrinsics.matrix(key, None).tolist())
    landmarks, crowded = None, 0
    files = sorted((folder / "openpose" / name).glob("*.json"))[:n]
    if files:
        landmarks, crowded = read_openpose(files)
        landmarks = _straight(landmarks, camera, distortion)
    return View(name, camera, frames, masks, garments, landmarks, distortion), crowded


def _straight(landmarks: torch.Tensor, camera: Camera, distortion: tuple[float, ...]) -> torch.Tensor:
    """Landmarks without the lens's distortion."""
    if not any(distortion):
        return landmarks
    import cv2

    K = opencv_matrix(camera)
    points = landmarks[..., :2].reshape(-1, 1, 2).double().numpy() - 0.5
    moved = cv2.undistortPoints(points, K, np.array(distortion), P=K).reshape(*landmarks.shape[:2], 2) + 0.5
    seen = landmarks[..., 2:] > 0
    return torch.cat((torch.where(seen, torch.from_numpy(moved).float(), 0.0), landmarks[..., 2:]), -1)


def _pictures(folder: Path) -> tuple[Path, ...]:
    if not folder.is_dir():
        return ()
    return tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in _PICTURES))


def _calibration(folder: Path, name: str) -> Path | None:
    found = (folder / f"{name}{suffix}" for suffix in (".yml", ".yaml", ".json"))
    return next((path for path in found if path.is_file()), None)


class _Storage:
    """OpenCV's file storage, YAML or JSON, whose mistakes name the file and the key."""

    def __init__(self, folder: Path, name: str) -> None:
        import cv2

        path = _calibration(folder, name)
        if path is None:
            raise InputError(
                "Calibration is missing",
                where=str(folder),
                expected=f"{name}.yml or {name}.json, as EasyMocap writes it",
                got="no such file",
            )
        self.path = path
        try:
            self._file: Any = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            opened = self._file.isOpened()
        except (cv2.error, SystemError):
            opened = False
        if not opened:
            raise InputError(
                "Calibration cannot be read",
                where=str(path),
                expected="OpenCV's file storage: YAML that begins with %YAML:1.0, or JSON",
                got="something else",
            )

    def has(self, key: str) -> bool:
        """Whether there is such a key."""
        return not self._file.getNode(key).empty()

    def names(self, key: str) -> list[str]:
        """A list of texts.

        Raises:
            InputError: there is none.
        """
        node = self._file.getNode(key)
        texts = [node.at(i).string() for i in range(node.size())] if node.isSeq() else []
        if not texts or not all(texts):
            raise InputError(
                "Calibration names no cameras",
                where=f"{self.path}: {key}",
                expected='a list of texts, e.g. ["01", "02"]',
                got="none",
            )
        return texts

    def matrix(self, key: str, size: int | None) -> npt.NDArray[np.float64]:
        """The numbers of a matrix, flattened.

        Raises:
            InputError: it is missing, or of another size.
        """
        node = self._file.getNode(key)
        found = None if node.empty() else _numbers(node)
        if found is None or (size is not None and found.size != size) or not np.isfinite(found).all():
            raise InputError(
                "Calibration lacks a matrix",
                where=f"{self.path}: {key}",
                expected="a matrix of finite numbers" if size is None else f"{size} finite numbers",
                got="none" if found is None else f"{found.size} numbers",
            )
        return found


def _numbers(node: Any) -> npt.NDArray[np.float64] | None:
    """Of an opencv-matrix, or of a plain list."""
    if node.isSeq():
        parts = [_numbers(node.at(i)) for i in range(node.size())]
        return None if any(p is None for p in parts) else np.concatenate([p for p in parts if p is not None])
    if node.isReal() or node.isInt():
        return np.array([node.real()])
    matrix = node.mat()
    return None if matrix is None else np.asarray(matrix, np.float64).ravel()
