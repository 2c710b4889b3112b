"""The layout in which φ-SfT's real scenes come with the published PgSfT code (Stotko et al., CVPR 2024).

::

    <root>/scenes/R1.json
    <root>/R1/0_R1_quad.obj, texture.png, rgbs/rgb_000.png ..., masks/mask_000.png ...
    <root>/ground_truth/R1/point_cloud_000.pt ...

The paths inside the JSON are those of the published repository (``../data/R1/...``,
``../evaluation/R1/...``) and are tried as well. The frames are counted on disk, since ``n_images`` is stale
(49 for the 50 frames of R1), and the crop of the JSON is not used.

Conventions of the files, measured on R1, and what is done about them, here and nowhere else:

- template: x and y are negated against camera and point clouds; (-x, -y, z) is the OpenCV camera frame;
- texture.png: frame 0 upside down; it is flipped vertically;
- OBJ (u, v): with the upright texture, pixel x = u * width, y = v * height, so v is measured down already
  and is kept. It disagrees with the projected template by 1.2 to 9.7 px on average (R1: 4.8 px, 273 px with
  1 - v);
- point clouds, focal length and optical center: OpenCV already;
- gravity, frame rate and pinned vertices are not in the files and are arguments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.geometry.io import read_mesh
from toile.geometry.mesh import grid_faces
from toile.json_file import read_json_object
from toile.scenes.findings import Finding, Severity, attempt, has_errors, require
from toile.scenes.frame_times import check_number_of_frames
from toile.scenes.images import numbered_files, read_rgb
from toile.scenes.native import find_point_clouds, grid_texture_coordinates
from toile.scenes.recording import ImageCheck, Recording, check_image_files, limited, to_scene
from toile.scenes.scene import Scene
from toile.scenes.template import Template
from toile.scenes.texture_coordinates import Texturing, from_file
from toile.scenes.validation import (
    check_camera,
    check_faces,
    check_pinned_vertices,
    check_template,
    check_timing,
)

GRID = (32, 32)
PINNED_VERTICES = (0, 992)
GRAVITY = (0.0, 9.81, 0.0)
FPS = 50.0  # assumed by the published fit; the data does not state the true rate
TO_OPENCV = (-1.0, -1.0, 1.0)

_KEYS = {
    "mesh_file": "path of the template OBJ",
    "mesh_size": "side of the cloth [m]",
    "texture_file": "path of the texture",
    "image_files": "prefix of the frames' paths",
    "mask_files": "prefix of the masks' paths",
    "optical_center": "[cx, cy] in px",
    "focal_length": "[fx, fy] in px",
    "image_size": "[height, width] in px",
}


def load_phi_sft(
    name: str,
    root: Path | str,
    *,
    n_frames: int | None = None,
    crop_margin: int | None = 24,
    minimum_component: float = 0.1,
    texture_coordinates: Texturing = from_file,
    fps: float = FPS,
    gravity: Sequence[float] = GRAVITY,
    pinned_vertices: Sequence[int] = PINNED_VERTICES,
) -> Scene:
    """Load a φ-SfT scene with its video.

    Args:
        name: scene name, "R1" to "R9".
        root: folder that holds ``scenes/<name>.json``.
        n_frames: load only the first ones; None for all.
        crop_margin: crop to the bounding box of all masks plus this margin [px]; None keeps whole images.
        minimum_component: drop mask components smaller than this fraction of the largest; 0 keeps all.
        texture_coordinates: from_file, projected, or another function of that signature.
        fps: frames per second; not stated by the data.
        gravity: (3,) [m/s²], OpenCV camera frame; not stated by the data.
        pinned_vertices: flattened indices in the 32×32 grid; not stated by the data.

    Raises:
        InputError: the first thing that is wrong; scenes.doctor lists them all.
    """
    recording, findings = survey_phi_sft(
        name, root, n_frames=n_frames, fps=fps, gravity=gravity, pinned_vertices=pinned_vertices
    )
    notes = tuple(str(f) for f in require(findings) if f.severity is Severity.WARNING)
    assert recording is not None
    return to_scene(
        replace(recording, notes=recording.notes + notes),
        crop_margin=crop_margin,
        minimum_component=minimum_component,
        texture_coordinates=texture_coordinates,
    )


def load_phi_sft_template(name: str, root: Path | str) -> Template:
    """Load template, texture and camera of a φ-SfT scene, for which no video is needed.

    Raises:
        InputError: the first thing that is wrong.
    """
    still, findings = _survey_still(name, Path(root))
    notes = tuple(str(f) for f in require(findings) if f.severity is Severity.WARNING)
    assert still is not None
    return Template(
        name=name,
        positions=still.template,
        faces=grid_faces(*GRID),
        texture=still.texture,
        texture_coordinates=still.texture_coordinates,
        cloth_size=still.cloth_size,
        camera=still.camera,
        pinned_vertices=PINNED_VERTICES,
        notes=notes,
    )


def survey_phi_sft(
    name: str,
    root: Path | str,
    *,
    n_frames: int | None = None,
    fps: float = FPS,
    gravity: Sequence[float] = GRAVITY,
    pinned_vertices: Sequence[int] = PINNED_VERTICES,
    check_images: ImageCheck = check_image_files,
) -> tuple[Recording | None, list[Finding]]:
    """Read everything but the images' contents and collect what is wrong; arguments as load_phi_sft."""
    root = Path(root)
    still, findings = _survey_still(name, root)
    pinned = tuple(int(k) for k in pinned_vertices)
    findings += check_timing(fps, name) + check_pinned_vertices(pinned, GRID, name)
    if still is None:
        return None, findings
    sequences = attempt(findings, lambda: _find_sequences(still))
    clouds = attempt(findings, lambda: _find_ground_truth(still, root))
    if sequences is None or clouds is None:
        return None, findings
    n = attempt(findings, lambda: limited(len(sequences[0]), n_frames, str(still.folder)))
    frames, masks = (paths[:n] for paths in sequences)
    findings += check_number_of_frames(len(sequences[0]), str(still.folder))
    findings += check_images(frames, masks, (still.camera.height, still.camera.width))
    if n is None or has_errors(findings):
        return None, findings
    notes = []
    declared = still.description.get("n_images")
    if declared != len(sequences[0]):
        notes.append(f"n_images says {declared}, but {len(sequences[0])} frames are there")
    if not clouds:
        notes.append("no ground-truth point clouds found")
    recording = Recording(
        name=name,
        source=still.folder,
        frame_paths=frames,
        mask_paths=masks,
        camera=still.camera,
        template=still.template,
        texture=still.texture,
        texture_coordinates=still.texture_coordinates,
        cloth_size=still.cloth_size,
        gravity=torch.tensor(list(gravity), dtype=torch.float64),
        fps=float(fps),
        pinned_vertices=pinned,
        true_point_clouds=clouds,
        original_size=(still.camera.height, still.camera.width),
        notes=tuple(notes),
    )
    return recording, findings


@dataclass(frozen=True)
class _Still:
    """What a scene has without its video, converted."""

    name: str
    description: dict[str, Any]
    json_path: Path
    folder: Path
    camera: Camera
    template: Tensor
    texture: Tensor
    texture_coordinates: Tensor
    cloth_size: tuple[float, float]


def _survey_still(name: str, root: Path) -> tuple[_Still | None, list[Finding]]:
    findings: list[Finding] = []
    path = root / "scenes" / f"{name}.json"
    description = attempt(findings, lambda: _read_description(name, path))
    if description is None:
        return None, findings
    for key, expected in _KEYS.items():
        if key not in description:
            got = f"keys {', '.join(description) or 'none'}"
            findings.append(Finding(Severity.ERROR, f"Key '{key}' is missing", str(path), expected, got))
    if findings:
        return None, findings
    camera = attempt(findings, lambda: _read_camera(description, path))
    side = attempt(findings, lambda: _numbers(description, "mesh_size", 1, path)[0])
    if camera is not None:
        findings += check_camera(camera, f"{path}: optical_center, focal_length")

    texture_path = _resolve(path, name, description["texture_file"])
    texture = attempt(findings, lambda: read_rgb(texture_path))
    mesh_path = _resolve(path, name, description["mesh_file"])
    mesh = attempt(findings, lambda: read_mesh(mesh_path))
    template = coordinates = None
    if mesh is not None and side is not None:
        positions = mesh.vertices * torch.tensor(TO_OPENCV, dtype=torch.float64)
        found = check_faces(mesh, GRID, str(mesh_path))
        if not has_errors(found):
            found += [
                finding
                for finding in check_template(positions, GRID, (side, side), str(mesh_path))
                if finding.severity is not Severity.INFO
            ]
        findings += found
        if not has_errors(found):
            template = positions.reshape(*GRID, 3)
            coordinates = attempt(findings, lambda: grid_texture_coordinates(mesh, GRID, str(mesh_path)))
    if has_errors(findings):
        return None, findings
    assert camera is not None
    assert side is not None
    assert texture is not None
    assert template is not None
    assert coordinates is not None
    still = _Still(
        name=name,
        description=description,
        json_path=path,
        folder=mesh_path.parent,
        camera=camera,
        template=template,
        texture=texture.flip(0).to(torch.float32) / 255,
        texture_coordinates=coordinates,
        cloth_size=(side, side),
    )
    return still, findings


def _read_description(name: str, path: Path) -> dict[str, Any]:
    if not path.is_file():
        there = sorted(p.stem for p in path.parent.glob("*.json"))
        got = f"scenes {', '.join(there)}" if there else f"no scene description in {path.parent}"
        raise InputError(f"Scene {name} is missing", where=str(path), expected="a scene description", got=got)
    try:
        return read_json_object(path)
    except (OSError, ValueError) as error:
        raise InputError(
            "Scene description is no valid JSON",
            where=str(path),
            expected="a JSON object {...}",
            got=str(error),
        ) from error


def _numbers(description: dict[str, Any], key: str, n: int, path: Path) -> list[float]:
    value = description[key]
    values = value if isinstance(value, list) else [value]
    if len(values) != n or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise InputError(
            f"Key '{key}' cannot be understood", where=str(path), expected=_KEYS[key], got=str(value)
        )
    return [float(v) for v in values]


def _read_camera(description: dict[str, Any], path: Path) -> Camera:
    fx, fy = _numbers(description, "focal_length", 2, path)
    cx, cy = _numbers(description, "optical_center", 2, path)
    height, width = _numbers(description, "image_size", 2, path)
    return Camera(fx, fy, cx, cy, int(height), int(width))


def _resolve(json_path: Path, name: str, published: str) -> Path:
    """Where a path of the description is: ``<root>/<name>/...``, or relative to the description as published.

    Returns the first of the two if neither exists, for the error message.
    """
    parts = Path(published).parts
    inside = parts[parts.index(name) :] if name in parts else (name, parts[-1])
    here = json_path.parent.parent.joinpath(*inside)
    as_published = json_path.parent / published
    return as_published if as_published.exists() and not here.exists() else here


def _find_sequences(still: _Still) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Paths of frames and masks, without a gap and of the same number."""
    found: dict[str, dict[int, Path]] = {}
    prefixes = {}
    for key in ("image_files", "mask_files"):
        prefix = str(still.description[key])
        folder = _resolve(still.json_path, still.name, str(Path(prefix).parent))
        prefixes[key] = folder / Path(prefix).name
        found[key] = numbered_files(folder, Path(prefix).name)
        if not found[key]:
            kind = "frames" if key == "image_files" else "masks"
            raise InputError(
                f"Scene {still.name} has no {kind}",
                where=str(folder),
                expected=f"{Path(prefix).name}000.png, {Path(prefix).name}001.png, ...",
                got=("no such folder" if not folder.is_dir() else "no such file in it")
                + f"; without its video only the template and texture of {still.name} can be used",
            )
    last = max(max(numbers) for numbers in found.values())
    for key, numbers in found.items():
        gap = next((k for k in range(last + 1) if k not in numbers), None)
        if gap is not None:
            raise InputError(
                f"Image {prefixes[key].name}{gap:03d}.png is missing",
                where=f"{prefixes[key]}{gap:03d}.png",
                expected=f"a frame and a mask for every number from 0 to {last}",
                got=f"{len(found['image_files'])} frames and {len(found['mask_files'])} masks",
            )
    return tuple(found["image_files"].values()), tuple(found["mask_files"].values())


def _find_ground_truth(still: _Still, root: Path) -> tuple[Path, ...]:
    folders = [root / "ground_truth" / still.name, still.folder / "ground_truth"]
    if "ground_truth_dir" in still.description:
        folders.append(still.json_path.parent / str(still.description["ground_truth_dir"]))
    return next((clouds for folder in folders if (clouds := find_point_clouds(folder))), ())
