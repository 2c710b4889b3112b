"""Checks of what several cameras recorded, each returning findings."""

from __future__ import annotations

import math

import torch

from toile.geometry.camera import Camera
from toile.scenes.findings import Finding, Severity, has_errors
from toile.scenes.images import read_mask
from toile.scenes.recording import check_image_files
from toile.scenes.validation import check_camera, check_timing
from toile.scenes.views import MultiView, View

_LOOKED_AT = 20  # masks of a camera that are read before it counts as seeing nothing
_ORTHOGONAL = 1e-3


def check_views(recording: MultiView) -> list[Finding]:
    """All checks that files and numbers of a recording allow; reads headers of images, and a few masks."""
    where = str(recording.source or recording.name)
    findings = check_timing(recording.fps, where)
    if not recording.views:
        return [*findings, Finding(Severity.ERROR, "No cameras", where, "at least one", "none")]
    names = [view.name for view in recording.views]
    for name in {n for n in names if names.count(n) > 1}:
        findings.append(Finding(Severity.ERROR, "Cameras share a name", where, "distinct names", name))
    for view in recording.views:
        findings += check_view(view, len(recording.landmark_names), f"{where}: camera {view.name}")
    counts = {view.name: view.n_frames for view in recording.views}
    if len(set(counts.values())) > 1:
        got = ", ".join(f"{name} {count}" for name, count in counts.items())
        expected = "as many frames from every camera"
        findings.append(Finding(Severity.ERROR, "Cameras differ in their frames", where, expected, got))
    if not has_errors(findings):
        findings += check_gaze(recording.views, where)
    return findings


def check_view(view: View, n_landmarks: int, where: str) -> list[Finding]:
    """One camera: intrinsics, pose, images, and whether it sees anything."""
    findings = check_camera(view.camera, where) + check_pose(view.camera, where)
    frames, masks, garments = len(view.frame_paths), len(view.mask_paths), len(view.garment_mask_paths)
    if not frames and not masks:
        expected = "images or masks of the camera"
        return [*findings, Finding(Severity.ERROR, "Camera recorded nothing", where, expected, "no files")]
    if len({n for n in (frames, masks, garments) if n}) > 1:
        got = f"{frames} images, {masks} masks, {garments} masks of the garment"
        expected = "one mask per image"
        findings.append(Finding(Severity.ERROR, "Images and masks differ in number", where, expected, got))
    size = (view.camera.height, view.camera.width)
    findings += check_image_files(view.frame_paths, view.mask_paths + view.garment_mask_paths, size)
    if view.landmarks is not None:
        expected = f"({view.n_frames}, {n_landmarks}, 3)"
        if tuple(view.landmarks.shape) != (view.n_frames, n_landmarks, 3):
            got = str(tuple(view.landmarks.shape))
            findings.append(Finding(Severity.ERROR, "Landmarks do not fit", where, expected, got))
        elif not bool(view.landmarks[..., 2].any()):
            expected = "landmarks that are seen"
            findings.append(
                Finding(Severity.WARNING, "Camera has no landmark in any frame", where, expected, "none")
            )
    if not has_errors(findings) and view.mask_paths:
        every = max(1, math.ceil(masks / _LOOKED_AT))
        looked = view.mask_paths[::every]
        if not any(bool(read_mask(path).any()) for path in looked):
            expected, got = "a mask with pixels above 0", f"{len(looked)} of {masks} masks, all of zeros"
            findings.append(Finding(Severity.ERROR, "Camera sees nothing", where, expected, got))
    return findings


def check_pose(camera: Camera, where: str) -> list[Finding]:
    """A finite pose whose rotation is one."""
    R, t = camera.R, camera.t
    if not bool(R.isfinite().all() and t.isfinite().all()):
        return [Finding(Severity.ERROR, "Camera pose is not finite", where, "finite R and t", "nan or inf")]
    error = float((R @ R.T - torch.eye(3, dtype=R.dtype)).abs().max())
    determinant = float(torch.linalg.det(R))
    if error > _ORTHOGONAL or determinant < 0:
        expected, got = "R Rᵀ = 1 and det R = 1", f"off by {error:.2g}, det R = {determinant:.3g}"
        return [Finding(Severity.ERROR, "Camera rotation is none", where, expected, got)]
    return []


def check_gaze(views: tuple[View, ...], where: str) -> list[Finding]:
    """Cameras that have behind them what the others look at: their pose is probably inverted."""
    if len(views) < 3:
        return []
    centres = torch.stack([view.camera.centre for view in views])
    axes = torch.stack([view.camera.R[2] for view in views])
    across = torch.eye(3, dtype=axes.dtype) - axes[:, :, None] * axes[:, None, :]
    # Nearest to all axes as lines, not rays: which way a camera looks does not move it.
    A, b = across.sum(0), (across @ centres[..., None]).sum(0)[:, 0]
    middle = torch.linalg.lstsq(A, b[:, None]).solution[:, 0]
    away = [v.name for v in views if float(v.camera.from_world(middle)[2]) <= 0]
    if not away or 2 * len(away) > len(views):
        return []
    expected = "in front of every camera the point that the axes of all pass closest by"
    return [Finding(Severity.WARNING, "Camera looks away", where, expected, f"behind {', '.join(away)}")]
