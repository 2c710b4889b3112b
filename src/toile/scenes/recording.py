"""A scene as it lies on disk: what every layout is read into before the common steps make a Scene of it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.geometry.io import read_point_cloud
from toile.scenes.findings import Finding, Severity, attempt, require
from toile.scenes.images import image_size, read_mask, read_rgb
from toile.scenes.masks import Box, bounding_box, drop_small_components
from toile.scenes.picture_checks import PictureChecks
from toile.scenes.scene import GroundTruth, Scene
from toile.scenes.texture_coordinates import Texturing
from toile.scenes.validation import check_scene
from toile.scenes.views import View

ImageCheck = Callable[[tuple[Path, ...], tuple[Path, ...], tuple[int, int]], list[Finding]]
"""Check of frame paths and mask paths against a declared (height, width)."""


@dataclass(frozen=True)
class Recording:
    """Paths and small data of a recorded or generated video, converted to the conventions of Scene.

    Attributes:
        name: scene name.
        source: folder it lies in.
        frame_paths: one RGB image per frame.
        mask_paths: one mask per frame.
        camera: camera of the images on disk.
        template: (H, W, 3) [m], float64, OpenCV camera frame.
        texture: (h_t, w_t, 3), float32 in [0, 1], upright.
        texture_coordinates: (H, W, 2), float32, v down.
        cloth_size: rest length of the two sides [m].
        gravity: (3,), float64 [m/s²].
        fps: frames per second, the mean where they are unevenly spaced.
        pinned_vertices: flattened grid indices.
        true_vertices: .npy file with (F, H, W, 3) [m], or None.
        true_point_clouds: one file per frame, or empty.
        crop: (top, left) of the images on disk in the original image [px].
        original_size: (height, width) of the original image [px].
        notes: what reading changed or found remarkable.
        times: see Scene; of all frames or None.
        views: see Scene.
    """

    name: str
    source: Path
    frame_paths: tuple[Path, ...]
    mask_paths: tuple[Path, ...]
    camera: Camera
    template: Tensor
    texture: Tensor
    texture_coordinates: Tensor
    cloth_size: tuple[float, float]
    gravity: Tensor
    fps: float
    pinned_vertices: tuple[int, ...]
    true_vertices: Path | None = None
    true_point_clouds: tuple[Path, ...] = ()
    crop: tuple[int, int] = (0, 0)
    original_size: tuple[int, int] = (0, 0)
    notes: tuple[str, ...] = ()
    times: tuple[float, ...] | None = None
    views: tuple[View, ...] = ()


def limited(n_available: int, n_frames: int | None, where: str) -> int:
    """Number of frames to load: ``n_frames``, or all of them if None.

    Raises:
        InputError: fewer than one, or more than there are.
    """
    if n_frames is None:
        return n_available
    if not 1 <= n_frames <= n_available:
        raise InputError(
            "Number of frames to load is out of range",
            where=where,
            expected=f"n_frames between 1 and {n_available}, or none for all",
            got=str(n_frames),
        )
    return n_frames


def check_image_files(
    frame_paths: tuple[Path, ...], mask_paths: tuple[Path, ...], size: tuple[int, int]
) -> list[Finding]:
    """Every frame and mask exists and has the declared (height, width); reads headers only."""
    findings: list[Finding] = []
    for path in itertools.chain(frame_paths, mask_paths):
        found = attempt(findings, lambda path=path: image_size(path))  # type: ignore[misc]
        if found is not None and found != size:
            swapped = " (height and width are exchanged)" if found == size[::-1] else ""
            findings.append(
                Finding(
                    Severity.ERROR,
                    f"Image {path.name} has another size than declared{swapped}",
                    str(path),
                    f"{size[0]} x {size[1]} px (height x width)",
                    f"{found[0]} x {found[1]}",
                )
            )
    return findings


def check_image_contents(
    frame_paths: tuple[Path, ...], mask_paths: tuple[Path, ...], size: tuple[int, int]
) -> list[Finding]:
    """As check_image_files, and decode every image: none truncated, no mask empty."""
    findings = check_image_files(frame_paths, mask_paths, size)
    known = {finding.where for finding in findings}
    for path in frame_paths:
        if str(path) not in known:
            attempt(findings, lambda path=path: read_rgb(path))  # type: ignore[misc]
    for path in mask_paths:
        if str(path) not in known:
            mask = attempt(findings, lambda path=path: read_mask(path))  # type: ignore[misc]
            if mask is not None and not mask.numpy().any():
                findings.append(_empty_mask(path))
    return findings


def _empty_mask(path: Path) -> Finding:
    return Finding(
        Severity.ERROR,
        f"Mask {path.name} is empty",
        str(path),
        "the cloth's pixels above 0",
        "zeros everywhere",
    )


def read_ground_truth(recording: Recording, n_frames: int) -> GroundTruth | None:
    """Ground truth of the first ``n_frames`` frames, or None if there is none.

    Raises:
        InputError: a file is unreadable, has another grid or too few frames.
    """
    vertices = None if recording.true_vertices is None else _read_vertices(recording, n_frames)
    clouds = tuple(read_point_cloud(path) for path in recording.true_point_clouds[:n_frames])
    if vertices is None and not clouds:
        return None
    return GroundTruth(vertices=vertices, point_clouds=clouds or None)


def _read_vertices(recording: Recording, n_frames: int) -> Tensor:
    import numpy as np

    path = recording.true_vertices
    assert path is not None
    expected = f"(F >= {n_frames}, {', '.join(map(str, recording.template.shape))}) [m]"
    try:
        array = np.load(path, allow_pickle=False)
    except Exception as error:
        raise InputError(
            "Ground-truth vertices cannot be read",
            where=str(path),
            expected=f"a .npy array {expected}",
            got=f"{type(error).__name__}: {error}",
        ) from error
    if array.ndim != 4 or array.shape[1:] != tuple(recording.template.shape) or len(array) < n_frames:
        raise InputError(
            "Ground-truth vertices have the wrong shape",
            where=str(path),
            expected=expected,
            got=str(array.shape),
        )
    return torch.from_numpy(array[:n_frames].astype(np.float64))


def to_scene(
    recording: Recording,
    *,
    crop_margin: int | None,
    minimum_component: float,
    texture_coordinates: Texturing,
) -> Scene:
    """Assemble a scene, check it and put the warnings into its notes; arguments as for assemble.

    Raises:
        InputError: an unreadable image, an empty mask, or any error that validation.check_scene finds.
    """
    checks = PictureChecks(len(recording.frame_paths))
    scene = assemble(
        recording,
        crop_margin=crop_margin,
        minimum_component=minimum_component,
        texture_coordinates=texture_coordinates,
        checks=checks,
    )
    remarks = require([*check_scene(scene), *checks.findings(str(recording.source))])
    warnings = tuple(str(finding) for finding in remarks if finding.severity is Severity.WARNING)
    return replace(scene, notes=scene.notes + warnings)


def assemble(
    recording: Recording,
    *,
    crop_margin: int | None,
    minimum_component: float,
    texture_coordinates: Texturing,
    checks: PictureChecks | None = None,
) -> Scene:
    """Read the images of a recording, clean the masks and crop.

    Frames are kept as they are, also outside the masks.

    Args:
        recording: a recording whose files have been checked; all its frames are loaded.
        crop_margin: crop to the bounding box of all masks plus this margin [px]; None keeps the whole image.
        minimum_component: drop mask components smaller than this fraction of the largest; 0 keeps all.
        texture_coordinates: chooses texture and coordinates; from_file or projected.
        checks: looks at every whole frame and its mask.

    Raises:
        InputError: an unreadable image or ground truth, or an empty mask.
    """
    notes = list(recording.notes)
    masks: list[Tensor] = []
    dropped: list[tuple[int, ...]] = []
    for path in recording.mask_paths:
        mask = read_mask(path)
        if not mask.numpy().any():
            raise _empty_mask(path).to_error()
        mask, sizes = drop_small_components(mask, minimum_component)
        masks.append(mask)
        dropped.append(sizes)
    removed = [size for sizes in dropped for size in sizes]
    if removed:
        frames_with = sum(bool(sizes) for sizes in dropped)
        notes.append(
            f"masks: dropped {len(removed)} components smaller than {100 * minimum_component:g} % of the "
            f"cloth in {frames_with} of {len(masks)} frames, the largest of {max(removed)} px"
        )
    h, w = recording.camera.height, recording.camera.width
    box = Box(0, 0, h, w)
    if crop_margin is not None:
        union = masks[0].clone()
        for mask in masks[1:]:
            torch.maximum(union, mask, out=union)
        box = bounding_box(union, crop_margin)
    first = read_rgb(recording.frame_paths[0])
    images = []
    for k, path in enumerate(recording.frame_paths):
        frame = first if k == 0 else read_rgb(path)
        if checks is not None:
            checks.add(frame.numpy(), masks[k].numpy() > 0)
        images.append(box.cut(frame) if k == 0 else box.cut(frame).clone())
    texture, coordinates = texture_coordinates(
        template=recording.template,
        camera=recording.camera,
        first_frame=first.to(torch.float32) / 255,
        texture=recording.texture,
        texture_coordinates=recording.texture_coordinates,
    )
    top, left = recording.crop
    return Scene(
        name=recording.name,
        frames=torch.stack(images).to(torch.float32) / 255,
        masks=torch.stack([box.cut(mask) for mask in masks]).to(torch.float32) / 255,
        camera=recording.camera.crop(box.top, box.left, box.height, box.width),
        texture=texture,
        texture_coordinates=coordinates,
        template=recording.template,
        cloth_size=recording.cloth_size,
        gravity=recording.gravity,
        fps=recording.fps,
        pinned_vertices=recording.pinned_vertices,
        crop=(top + box.top, left + box.left),
        original_size=recording.original_size,
        ground_truth=read_ground_truth(recording, len(images)),
        source=recording.source,
        notes=tuple(notes),
        times=None if recording.times is None else torch.tensor(recording.times, dtype=torch.float64),
        views=recording.views,
    )
