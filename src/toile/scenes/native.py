"""The native layout: one folder per scene.

::

    scene.json
    template.obj            H*W vertices in row-major order, quads; vt = (u, v) with v DOWN
    texture.png
    rgbs/rgb_000.png ...
    masks/mask_000.png ...  0 outside, 255 inside
    ground_truth/vertices.npy                         (F, H, W, 3) [m], optional
    ground_truth/point_cloud_000.npy (.pt, .ply) ...  (N, 3) [m], optional

Keys of ``scene.json``:

- ``fps``, ``n_frames``
- ``image_size``: [height, width] of the images in the folder [px], in this order
- ``K``: 3x3 intrinsic matrix [px], pixel = K (X / Z), (0, 0) at the top-left image corner
- ``gravity``: [m/s²]; ``cloth_size_m``: [along axis 0, along axis 1]; ``grid``: [H, W]
- ``pinned_vertices``: indices i * W + j, may be empty
- ``units``: a text that says "metres"
- optional: ``cameras`` (all calibrated cameras of a recording by several, see native_views; the first is the
  one that ``K``, ``image_size`` and ``files`` describe) and ``landmarks`` (names of their 2D landmarks);
  ``times`` (of the frames [s], increasing, the first 0; without it they are evenly spaced at
  ``fps``, with it ``fps`` is the mean rate), ``id`` (name of the scene), ``convention`` (text for people),
  ``files`` (other paths for "template", "texture", "rgb", "mask", in this folder also after links have been
  followed), ``crop`` ([top, left]) and ``original_size`` ([height, width]) if the images were cut from larger
  ones; ``K`` always belongs to the images in the folder.

Everything is in the OpenCV camera frame (x right, y down, z forward, metres), so nothing is converted here
but the poses of further cameras, which are made relative to the first. A recording by several cameras may
lack what belongs to a grid of cloth (all but ``fps``, ``n_frames``, ``units``, ``cameras``): a MultiView.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from torch import Tensor

from toile.errors import InputError
from toile.former_names import SCENE_KEYS, renamed
from toile.geometry.camera import Camera
from toile.geometry.io import PolygonMesh, read_mesh, write_mesh, write_point_cloud
from toile.json_file import place, read_json_object
from toile.limits import Count, CountOrZero, Finite, Positive, TwoOrMore
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.findings import Finding, Severity, attempt, has_errors, require
from toile.scenes.folder_files import inside, sequence
from toile.scenes.frame_times import check_number_of_frames, check_spacing, check_times, settled
from toile.scenes.images import numbered_files, read_rgb, write_image
from toile.scenes.native_views import (
    EXPECTED,
    CameraEntry,
    copy_view,
    entry_of,
    read_views,
    view_files,
    without_skew,
)
from toile.scenes.recording import ImageCheck, Recording, check_image_files, limited, to_scene
from toile.scenes.scene import Scene
from toile.scenes.texture_coordinates import Texturing, from_file
from toile.scenes.validation import (
    check_camera,
    check_faces,
    check_pinned_vertices,
    check_template,
    check_timing,
)
from toile.scenes.view_checks import check_views
from toile.scenes.views import MultiView, View

FILES = {
    "template": "template.obj",
    "texture": "texture.png",
    "rgb": "rgbs/rgb_%03d.png",
    "mask": "masks/mask_%03d.png",
}
# A path with one number, of any sensible width.
_NUMBERED = re.compile(r"[^%]*%0?[0-9]{0,2}d[^%]*")
CONVENTION = (
    "OpenCV camera coordinates: x right, y down, z forward, metres; camera at the origin. Pixel = K (X / Z), "
    "(0, 0) at the top-left image corner. Grid vertex index = i * W + j. template.obj vt = (u, v), v "
    "measured down from the top row of texture.png. Sizes and crop are (vertical, horizontal)."
)


def load_native(
    folder: Path | str,
    *,
    n_frames: int | None = None,
    crop_margin: int | None = 24,
    minimum_component: float = 0.1,
    texture_coordinates: Texturing = from_file,
    fps: float | None = None,
    gravity: Sequence[float] | None = None,
    pinned_vertices: Sequence[int] | None = None,
) -> Scene:
    """Load a scene in the native layout.

    Args:
        folder: folder of the scene.
        n_frames: load only the first ones; None for all.
        crop_margin: crop to the bounding box of all masks plus this margin [px]; None keeps whole images.
        minimum_component: drop mask components smaller than this fraction of the largest; 0 keeps all.
        texture_coordinates: from_file, projected, or another function of that signature.
        fps: replaces the file's frame rate, and its times: the frames count as evenly spaced then.
        gravity: replaces the file's gravity [m/s²].
        pinned_vertices: replaces the file's pinned vertices.

    Raises:
        InputError: the first thing that is wrong; scenes.doctor lists them all.
    """
    recording, findings = survey_native(folder, n_frames=n_frames)
    notes = tuple(str(f) for f in require(findings) if f.severity is Severity.WARNING)
    assert recording is not None
    changes: dict[str, Any] = {"notes": (*recording.notes, *notes)}
    if fps is not None:
        changes["fps"] = float(fps)
        if recording.times is not None:
            changes["times"] = None
            replaced = Finding(
                Severity.WARNING,
                "fps replaces the times of the frames",
                f"{recording.source / 'scene.json'}: times",
                "fps=null, with which they are used",
                f"fps {fps:g}, frames taken as evenly spaced",
            )
            changes["notes"] = (*changes["notes"], str(replaced))
    if gravity is not None:
        changes["gravity"] = torch.tensor(list(gravity), dtype=torch.float64)
    if pinned_vertices is not None:
        changes["pinned_vertices"] = tuple(int(k) for k in pinned_vertices)
    return to_scene(
        replace(recording, **changes),
        crop_margin=crop_margin,
        minimum_component=minimum_component,
        texture_coordinates=texture_coordinates,
    )


def write_native(scene: Scene, folder: Path | str, *, overwrite: bool = False) -> Path:
    """Write a scene in the native layout, so that ``load_native(folder, crop_margin=None)`` gives it back.

    Images are rounded to 8 bits; everything else is kept exactly. The folder appears only when it is
    complete: it is written beside the target under another name and renamed.

    Args:
        scene: the scene; ground truth is written if it has any.
        folder: target; must not exist unless ``overwrite``.
        overwrite: replace an existing folder.

    Returns:
        The folder.

    Raises:
        InputError: the folder exists and ``overwrite`` is False.
    """
    folder = Path(folder)
    with folder_written_atomically(folder, overwrite=overwrite) as new:
        new.mkdir()
        _write_files(scene, new)
    return folder


def is_multi_view(folder: Path) -> bool:
    """Whether the native scene in a folder is a recording by several cameras without a cloth."""
    try:
        description = read_json_object(folder / "scene.json")
    except (OSError, ValueError):
        return False
    return "cameras" in description and "grid" not in description


def survey_native(
    folder: Path | str, *, n_frames: int | None = None, check_images: ImageCheck = check_image_files
) -> tuple[Recording | None, list[Finding]]:
    """Read everything but the images' contents and collect what is wrong.

    Args:
        folder: folder of the scene.
        n_frames: consider only the first frames; None for all.
        check_images: check_image_files reads headers only, check_image_contents decodes.

    Returns:
        The recording, or None if anything needed for it failed, and all findings.
    """
    folder = Path(folder)
    findings: list[Finding] = []
    description = attempt(findings, lambda: _read_description(folder))
    if description is None:
        return None, findings
    path = folder / "scene.json"
    if "cameras" in description and "grid" not in description:
        got = "cameras, but no grid: a recording by several cameras"
        expected = "a cloth with a template; load_multi_view reads such a recording"
        findings.append(Finding(Severity.ERROR, "Scene has no cloth", str(path), expected, got))
        return None, findings
    findings += [
        Finding(
            Severity.ERROR,
            f"Key '{key}' is missing",
            str(path),
            f"'{key}': {expected}",
            f"keys {', '.join(description) or 'none'}",
        )
        for key, (_, expected) in _REQUIRED.items()
        if key not in description
    ]
    values: dict[str, Any] = {
        key: attempt(findings, partial(_understood, path, key, description[key]))
        for key in (*_REQUIRED, *_OPTIONAL)
        if key in description
    }
    files = {**FILES, **(values.get("files") or {})}
    grid, size, intrinsics = values.get("grid"), values.get("image_size"), values.get("K")

    camera = None
    if size is not None and intrinsics is not None:
        (fx, _, cx), (_, fy, cy), _ = intrinsics
        camera = Camera(fx, fy, cx, cy, *size)
        findings += check_camera(camera, f"{path}: K")
    if values.get("fps") is not None:
        findings += check_timing(values["fps"], str(path))

    frame_paths: tuple[Path, ...] = ()
    mask_paths: tuple[Path, ...] = ()
    if values.get("n_frames") is not None:
        n = attempt(findings, lambda: limited(values["n_frames"], n_frames, str(folder)))
        if n is not None:
            paths = attempt(
                findings, lambda: tuple(sequence(folder, files[key], n) for key in ("rgb", "mask"))
            )
            frame_paths, mask_paths = paths or ((), ())
        if size is not None:
            findings += check_images(frame_paths, mask_paths, size)
        findings += _surplus(folder, files, values["n_frames"])
        findings += check_number_of_frames(values["n_frames"], str(path))
    times, fps = values.get("times"), values.get("fps")
    if times is not None and fps is not None and values.get("n_frames") is not None:
        found = check_times(times, values["n_frames"], fps, str(path))
        findings += found
        if not has_errors(found):
            times, fps = settled(times[: len(frame_paths) or None], fps)
            findings += check_spacing(times, str(path))

    texture = attempt(findings, lambda: read_rgb(inside(folder, files["texture"])))
    mesh = attempt(findings, lambda: read_mesh(inside(folder, files["template"])))
    template = coordinates = None
    if mesh is not None and grid is not None:
        where = str(folder / files["template"])
        found = check_faces(mesh, grid, where)
        if not has_errors(found) and values.get("cloth_size_m") is not None:
            found += [
                finding
                for finding in check_template(mesh.vertices, grid, values["cloth_size_m"], where)
                if finding.severity is not Severity.INFO
            ]
        findings += found
        if not has_errors(found):
            template = mesh.vertices.reshape(*grid, 3)
            coordinates = attempt(findings, lambda: grid_texture_coordinates(mesh, grid, where))

    if grid is not None and values.get("pinned_vertices") is not None:
        findings += check_pinned_vertices(values["pinned_vertices"], grid, str(path))
    clouds = attempt(findings, lambda: find_point_clouds(folder / "ground_truth"))
    views: tuple[View, ...] = ()
    if values.get("cameras") and camera is not None and frame_paths:
        several = MultiView(
            folder.name, (), fps=1.0, landmark_names=values.get("landmarks") or (), source=folder
        )
        views = _further_views(several, values["cameras"], camera, len(frame_paths), findings)
    if has_errors(findings) or camera is None or template is None or texture is None or coordinates is None:
        return None, findings
    true_vertices = folder / "ground_truth" / "vertices.npy"
    top, left = values.get("crop") or (0, 0)
    cut = top + camera.height, left + camera.width
    original = values.get("original_size") or cut
    if any(original) and any(whole < part for whole, part in zip(original, cut, strict=True)):
        findings.append(
            Finding(
                Severity.ERROR,
                "The images were not cut from such larger ones",
                f"{path}: crop, original_size",
                f"an original of {cut[0]} x {cut[1]} px at least, for images of "
                f"{camera.height} x {camera.width} px at {[top, left]}",
                f"{original[0]} x {original[1]} px",
            )
        )
    recording = Recording(
        name=str(values.get("id") or folder.resolve().name),
        source=folder,
        frame_paths=frame_paths,
        mask_paths=mask_paths,
        camera=camera,
        template=template,
        texture=texture.to(torch.float32) / 255,
        texture_coordinates=coordinates,
        cloth_size=values["cloth_size_m"],
        gravity=torch.tensor(values["gravity"], dtype=torch.float64),
        fps=fps or values["fps"],
        pinned_vertices=values["pinned_vertices"],
        true_vertices=true_vertices if true_vertices.is_file() else None,
        true_point_clouds=clouds or (),
        crop=(top, left),
        original_size=original,
        times=times,
        views=views,
    )
    return recording, findings


def survey_multi_view(
    folder: Path | str, *, n_frames: int | None = None
) -> tuple[MultiView | None, list[Finding]]:
    """Read the cameras of a scene, with or without a cloth, and collect what is wrong; no image is decoded.

    Args:
        folder: with scene.json, which holds ``cameras``.
        n_frames: consider only the first frames; None for all.

    Returns:
        The recording, in the world of its poses, or None if anything needed for it failed, and all findings.
    """
    folder = Path(folder)
    findings: list[Finding] = []
    description = attempt(findings, lambda: _read_description(folder))
    if description is None:
        return None, findings
    path = folder / "scene.json"
    needed = ("fps", "n_frames", "units", "cameras")
    keys = {**_REQUIRED, **_OPTIONAL}
    for key in needed:
        if key not in description:
            got = f"keys {', '.join(description) or 'none'}"
            expected = f"'{key}': {keys[key][1]}"
            findings.append(Finding(Severity.ERROR, f"Key '{key}' is missing", str(path), expected, got))
    values: dict[str, Any] = {
        key: attempt(findings, partial(_understood, path, key, description[key]))
        for key in (*needed, "gravity", "landmarks", "id")
        if key in description
    }
    if has_errors(findings):
        return None, findings
    n = attempt(findings, lambda: limited(values["n_frames"], n_frames, str(folder)))
    if n is None:
        return None, findings
    views, found = read_views(folder, values["cameras"], n)
    findings += found
    recording = MultiView(
        name=str(values.get("id") or folder.resolve().name),
        views=views,
        fps=values["fps"],
        landmark_names=tuple(values.get("landmarks") or ()),
        source=folder,
    )
    if "gravity" in values:
        recording = replace(recording, gravity=torch.tensor(values["gravity"], dtype=torch.float64))
    if not has_errors(findings):
        findings += check_views(recording)
    return (None if has_errors(findings) else recording), findings


def write_multi_view_description(
    recording: MultiView, folder: Path, files: Sequence[Mapping[str, str]]
) -> None:
    """Write ``scene.json`` of a recording without a cloth into a folder that exists.

    Args:
        recording: its images are not written.
        folder: target.
        files: of each view, by the names of ``native_views.CAMERA_FILES``.
    """
    description = {
        "id": recording.name,
        "fps": recording.fps,
        "n_frames": recording.n_frames,
        "gravity": recording.gravity.tolist(),
        "units": "metres, seconds",
        "convention": "World right-handed, y up; OpenCV camera frame x_cam = R x + t; pixel = K (X / Z)",
        "landmarks": list(recording.landmark_names),
        "cameras": [entry_of(view, own) for view, own in zip(recording.views, files, strict=True)],
    }
    (folder / "scene.json").write_text(json.dumps(description, indent=1) + "\n")


def _further_views(
    several: MultiView, entries: Sequence[CameraEntry], camera: Camera, n: int, findings: list[Finding]
) -> tuple[View, ...]:
    """All cameras but the first, in whose frame the scene is."""
    assert several.source is not None
    where = f"{several.source / 'scene.json'}: cameras"
    first = entries[0].camera
    if first.at_origin() != camera:
        expected, got = f"K and image_size of the scene, {camera}", str(first.at_origin())
        findings.append(Finding(Severity.ERROR, "First camera is not the scene's", where, expected, got))
        return ()
    views, found = read_views(several.source, entries, n)
    findings += found
    findings += check_views(replace(several, views=views))
    return tuple(replace(view, camera=view.camera.relative_to(first)) for view in views[1:])


def grid_texture_coordinates(mesh: PolygonMesh, grid: tuple[int, int], where: str) -> Tensor:
    """Texture coordinates of a grid mesh, (H, W, 2), float32, as in the file.

    Raises:
        InputError: no coordinates, a vertex without, or a vertex with two (a seam).
    """
    uv = mesh.texture_coordinates
    expected = "one (u, v) per vertex"
    if uv is None:
        raise InputError(
            "Template has no texture coordinates", where=where, expected=expected, got="no 'vt' used"
        )
    without = (~uv.isfinite()).any(-1).nonzero().flatten()
    if len(without):
        raise InputError(
            "Template vertices lack texture coordinates",
            where=where,
            expected=expected,
            got=f"{len(without)} without or not finite, first vertex {int(without[0])} (zero-based)",
        )
    if mesh.seam_vertices:
        raise InputError(
            "Template has a texture seam",
            where=where,
            expected=expected,
            got=f"{len(mesh.seam_vertices)} vertices with several, first {mesh.seam_vertices[0]}",
        )
    return uv.reshape(*grid, 2).to(torch.float32)


def find_point_clouds(folder: Path) -> tuple[Path, ...]:
    """Files ``point_cloud_%03d`` of a folder, in order and without a gap; empty if there are none.

    Raises:
        InputError: one is missing before the last.
    """
    for suffix in (".pt", ".npy", ".ply"):
        found = numbered_files(folder, "point_cloud_", suffix)
        if found:
            gap = next((k for k in range(max(found)) if k not in found), None)
            if gap is not None:
                raise InputError(
                    f"Point cloud point_cloud_{gap:03d}{suffix} is missing",
                    where=str(folder),
                    expected=f"one for every frame from 0 to {max(found)}",
                    got=f"{len(found)} files",
                )
            return tuple(found.values())
    return ()


def _read_description(folder: Path) -> dict[str, Any]:
    path = folder / "scene.json"
    if not folder.is_dir():
        there = sorted(p.name for p in folder.parent.iterdir()) if folder.parent.is_dir() else []
        got = f"no such folder; {folder.parent} holds {', '.join(there[:20]) or 'nothing'}"
        raise InputError("Scene folder is missing", where=str(folder), expected="a folder", got=got)
    if not path.is_file():
        there = sorted(p.name for p in folder.iterdir())
        raise InputError(
            "scene.json is missing",
            where=str(folder),
            expected="scene.json, template.obj, texture.png, rgbs/, masks/",
            got=", ".join(there[:20]) or "an empty folder",
        )
    try:
        return renamed(read_json_object(path), SCENE_KEYS)
    except (OSError, ValueError) as error:
        raise InputError(
            "scene.json is no valid JSON", where=str(path), expected="a JSON object {...}", got=str(error)
        ) from error


def _understood(path: Path, key: str, value: Any) -> Any:
    try:
        # As text, in which a list may be a tuple although nothing is converted.
        return _adapter(key).validate_json(json.dumps(value))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise InputError(
            f"Key '{key}' cannot be understood",
            where=f"{path}: {place((key, *first['loc']))}",
            expected={**_REQUIRED, **_OPTIONAL}[key][1],
            got=f"{str(value)[:100]} ({first['msg'].removeprefix('Value error, ')})",
        ) from error


@cache
def _adapter(key: str) -> TypeAdapter[Any]:
    return TypeAdapter({**_REQUIRED, **_OPTIONAL}[key][0], config=ConfigDict(strict=True))


def _metres(units: str) -> str:
    if not {"m", "metres", "meters"}.intersection(word.strip(",;.") for word in units.split()):
        raise ValueError(
            "only metres are supported; convert the template, the cloth size and the ground truth"
        )
    return units


def _relative(files: dict[str, str]) -> dict[str, str]:
    for key in ("rgb", "mask"):
        if key in files and not _NUMBERED.fullmatch(files[key]):
            raise ValueError(f"{key} without one %03d")
    if any("\0" in path or not path for path in files.values()):
        raise ValueError("not a path")
    return files


# A whole number may be written as 25.0.
_WHOLE = BeforeValidator(lambda v: int(v) if isinstance(v, float) and v.is_integer() else v)
_Row = tuple[Finite, Finite, Finite]
_Pixels = tuple[Annotated[Count, _WHOLE], Annotated[Count, _WHOLE]]
_Sides = tuple[Annotated[TwoOrMore, _WHOLE], Annotated[TwoOrMore, _WHOLE]]
_Original = tuple[Annotated[CountOrZero, _WHOLE], Annotated[CountOrZero, _WHOLE]]
_REQUIRED: Mapping[str, tuple[Any, str]] = {
    "fps": (Finite, "frames per second, a number > 0"),
    "n_frames": (Annotated[Count, _WHOLE], "number of frames, a whole number > 0"),
    "image_size": (_Pixels, "[height, width] in px"),
    "K": (
        Annotated[tuple[_Row, _Row, _Row], AfterValidator(without_skew)],
        "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px, finite",
    ),
    "gravity": (_Row, "[x, y, z] in m/s², finite"),
    "cloth_size_m": (tuple[Positive, Positive], "[along axis 0, along axis 1] in m, positive"),
    "grid": (_Sides, "[H, W], whole numbers >= 2"),
    "pinned_vertices": (
        tuple[Annotated[int, _WHOLE], ...],
        "list of indices i * W + j, may be empty",
    ),
    "units": (Annotated[str, AfterValidator(_metres)], 'a text with the word "metres"'),
}
_OPTIONAL: Mapping[str, tuple[Any, str]] = {
    "files": (
        Annotated[dict[str, str], AfterValidator(_relative)],
        'paths for "template", "texture", "rgb", "mask", the last two with %03d',
    ),
    "crop": (_Original, "[top, left] in px"),
    "original_size": (_Original, "[height, width] in px"),
    "id": (Annotated[str, BeforeValidator(str)], "name of the scene"),
    "cameras": (Annotated[tuple[CameraEntry, ...], Field(min_length=1)], EXPECTED),
    "landmarks": (tuple[str, ...], "names of the 2D landmarks of every camera"),
    "times": (tuple[Finite, ...], "list of the frames' times in s, increasing, the first 0"),
}


def _surplus(folder: Path, files: dict[str, str], n: int) -> list[Finding]:
    """A warning for images beyond the declared number, which are not loaded."""
    findings = []
    for key in ("rgb", "mask"):
        path = folder / (files[key] % n)
        if path.is_file():
            where, expected = str(path.parent), f"{n} images, as n_frames says"
            got = f"also {path.name}, which is not loaded"
            findings.append(Finding(Severity.WARNING, "More images than n_frames", where, expected, got))
    return findings


def write_without_images(
    scene: Scene, folder: Path, n_frames: int, times: Sequence[float] | None = None
) -> None:
    """Write ``scene.json``, the template and the texture into a folder that exists.

    Args:
        scene: the scene; its frames, masks and ground truth are not written.
        folder: target.
        n_frames: number of frames that are, or will be, in the folder.
        times: of those frames [s]; None where they are evenly spaced.
    """
    H, W = scene.grid
    camera = scene.camera
    description = {
        "id": scene.name,
        "fps": scene.fps,
        "n_frames": n_frames,
        **({} if times is None else {"times": list(times)}),
        "image_size": [camera.height, camera.width],
        "K": [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
        "gravity": scene.gravity.tolist(),
        "cloth_size_m": list(scene.cloth_size),
        "grid": [H, W],
        "pinned_vertices": list(scene.pinned_vertices),
        "units": "metres, seconds",
        "crop": list(scene.crop),
        "original_size": list(scene.original_size),
        "convention": CONVENTION,
        "files": FILES,
        **_cameras(scene),
    }
    (folder / "scene.json").write_text(json.dumps(description, indent=1) + "\n")
    k = torch.arange(H * W).reshape(H, W)
    quads = torch.stack((k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]), -1).reshape(-1, 4).tolist()
    write_mesh(
        folder / FILES["template"],
        scene.template.reshape(-1, 3),
        quads,
        scene.texture_coordinates.reshape(-1, 2),
    )
    write_image(folder / FILES["texture"], scene.texture)


def _cameras(scene: Scene) -> dict[str, Any]:
    """The key ``cameras`` of a scene with several."""
    if not scene.views:
        return {}
    own = entry_of(View("0", scene.camera), {key: FILES[key] for key in ("rgb", "mask")})
    return {
        "cameras": [own, *(entry_of(view, view_files(view, f"views/{view.name}")) for view in scene.views)]
    }


def _write_files(scene: Scene, folder: Path) -> None:
    for view in scene.views:
        copy_view(view, folder, f"views/{view.name}")
    times = None if scene.times is None else scene.times.tolist()
    write_without_images(scene, folder, scene.n_frames, times)
    for key, images in (("rgb", scene.frames), ("mask", scene.masks)):
        paths = [folder / (FILES[key] % k) for k in range(scene.n_frames)]
        paths[0].parent.mkdir()
        for path, image in zip(paths, images, strict=True):
            write_image(path, image)
    truth = scene.ground_truth
    if truth is not None and (truth.vertices is not None or truth.point_clouds is not None):
        target = folder / "ground_truth"
        target.mkdir()
        if truth.vertices is not None:
            np.save(target / "vertices.npy", truth.vertices.detach().cpu().numpy())
        for number, cloud in enumerate(truth.point_clouds or ()):
            write_point_cloud(target / f"point_cloud_{number:03d}.npy", cloud)
