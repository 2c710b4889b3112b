"""A scene from Blender in the native layout, with its label and its twin without the effect."""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toile.errors import InputError
from toile.generation.blender import process, world
from toile.generation.blender.balance import balanced
from toile.generation.blender.effects import WITHIN, effect_named
from toile.generation.blender.exposure import expose
from toile.generation.blender.settings import BlenderSettings
from toile.generation.textures import procedural_texture
from toile.geometry.camera import Camera
from toile.physics.simulator import SimulationError
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.images import write_image
from toile.scenes.native import write_native
from toile.scenes.scene import GroundTruth, Scene
from toile.scenes.texture_coordinates import project_coordinates

Array = NDArray[np.float64]

TWIN_FILE = "ground_truth/null_twin_vertices.npy"
"""(F, H, W, 3) [m]: the same motion without the effect."""
LABEL_FORMAT = 2
"""In the first one ``vertices`` were those that an effect moves."""
_PIXEL_OF_EFFECT = 0.005
_LEAST_SLOPE = 0.1
"""Of an effect's size over its strength, both in logarithms: a patch that is rigid does no more."""


def blender_scene(
    settings: BlenderSettings, folder: Path | str, *, overwrite: bool = False
) -> dict[str, Any]:
    """Simulate, film and write one scene; the folder appears only when it is complete.

    The folder is in the native layout, with ``ground_truth/vertices.npy`` and TWIN_FILE and without the
    label. Camera, gravity and frame rate in it are the declared ones, and the texture is frame 0 with the
    template projected by the declared camera, as with generated scenes.

    Args:
        settings: see BlenderSettings; the label has the steps that the cloth's balance needs.
        folder: target; must not exist unless ``overwrite``.
        overwrite: replace an existing folder.

    Returns:
        The label, JSON values: see label.

    Raises:
        InputError: the folder exists, bpy is missing, or the cloth leaves the image.
        SimulationError: no finite motion, or Blender stopped.
    """
    folder = Path(folder)
    with (
        folder_written_atomically(folder, overwrite=overwrite) as new,
        tempfile.TemporaryDirectory(prefix="toile-blender-") as scratch,
    ):
        work = Path(scratch)
        settings = balanced(settings, work, with_effect=False)
        if settings.effect in WITHIN:
            settings = balanced(settings, work, with_effect=True)
        truth, twin = motions(settings, work)
        scene = _filmed(settings, truth, work)
        write_native(scene, new)
        fit_twin = _at_fit_grid(settings, twin, with_effect=False)
        np.save(new / TWIN_FILE, fit_twin)
        assert scene.ground_truth is not None
        assert scene.ground_truth.vertices is not None
        result = label(settings, scene.ground_truth.vertices.numpy(), fit_twin)
    return result


def matched(
    settings: BlenderSettings,
    gap: float,
    *,
    tolerance: float = 0.15,
    max_simulations: int = 6,
) -> BlenderSettings:
    """The settings with the strength at which the motion differs from its twin by a wanted gap, and with as
    many steps as the cloth's balance needs there.

    The gap is the mean distance over the last third, as a fraction of the cloth's width. Searched by secants
    in the logarithms, without rendering. Effects without a size in the motion are returned as they are.

    Args:
        settings: with the effect; its parameters are the first guess.
        gap: wanted, e.g. 0.03.
        tolerance: relative, of the gap.
        max_simulations: before the best so far is returned.

    Raises:
        InputError: bpy is missing.
        SimulationError: no finite motion, or Blender stopped.
    """
    scaled = effect_named(settings.effect).scaled
    if scaled is None:
        return settings
    with tempfile.TemporaryDirectory(prefix="toile-blender-") as scratch:
        settings = balanced(settings, Path(scratch), with_effect=False)
        twin = _simulated(settings, Path(scratch), with_effect=False)
        tried: list[tuple[float, float]] = []
        value = settings.values[scaled]
        for _ in range(max_simulations):
            changed = replace(settings, parameters={**settings.parameters, scaled: value})
            try:
                if settings.effect in WITHIN:
                    changed = balanced(changed, Path(scratch), with_effect=True)
                if changed.steps > settings.steps:
                    # Shorter steps damp less, so the twin has them as well.
                    settings = replace(settings, steps=changed.steps)
                    twin = _simulated(settings, Path(scratch), with_effect=False)
                truth = _simulated(changed, Path(scratch), with_effect=True, twin=twin)
                reached = _gap(settings, truth, twin)
            except process.BlenderError:
                raise
            except SimulationError:
                if not tried:
                    raise
                reached = math.inf
            if math.isfinite(reached):
                tried.append((value, max(reached, 1e-9)))
            if abs(math.log(max(reached, 1e-9) / gap)) <= math.log1p(tolerance) or _levels_off(tried, gap):
                break
            value = _next_value(tried, gap, value)
        best = min(tried, key=lambda pair: abs(math.log(pair[1] / gap)))[0]
    return replace(settings, parameters={**settings.parameters, scaled: best})


def motions(settings: BlenderSettings, work: Path) -> tuple[Array, Array]:
    """Motions (F, H', W', 3) [m] on the simulated grids: with the effect, and its twin without.

    Args:
        settings: of the scene.
        work: folder for intermediate files.
    """
    twin = _simulated(settings, work, with_effect=False)
    if effect_named(settings.effect).stage not in ("mechanics", "actuation"):
        return twin, twin
    return _simulated(settings, work, with_effect=True, twin=twin), twin


def label(settings: BlenderSettings, vertices: Array, twin: Array) -> dict[str, Any]:
    """The truth about a scene as JSON values.

    Keys:

    - ``effect``, ``stage``, ``stage_accept``, ``in_catalogue``
    - ``parameters``: of the effect; ``declared`` and ``true``: focal length, frame rate, gravity
    - ``magnitude``: distance to the twin as fractions of the cloth's width: ``mean_last_third``,
      ``max_last_third``, ``mean_all``, ``max_all``, ``per_frame_mean``
    - ``localisation``: ``frames`` that differ from the twin by over half a percent of the width, of an effect
      in the picture all; ``vertices`` (i * W + j) that the effect acts on, None where that is everywhere or
      not known (contact)
    - ``nuisance``: what else the base model lacks; ``settings``: all settings

    Args:
        settings: of the scene.
        vertices: (F, H, W, 3) [m], at the fit's grid.
        twin: the same without the effect.
    """
    effect = effect_named(settings.effect)
    distance = np.linalg.norm(vertices - twin, axis=-1) / settings.cloth_size[0]
    last = distance[_last_third(len(distance))]
    frames = np.flatnonzero(distance.mean((1, 2)) > _PIXEL_OF_EFFECT).tolist()
    if effect.stage not in ("none", "mechanics", "actuation"):
        frames = list(range(len(distance)))
    values = settings.values
    true = {
        "focal_length": settings.focal_length
        * (1 + (values["error"] if effect.name == "focal_error" else 0)),
        "fps": settings.fps * (1 + (values["error"] if effect.name == "frame_rate" else 0)),
        "gravity": world.true_gravity(settings).tolist(),
    }
    result = {
        "format": LABEL_FORMAT,
        "engine": "blender",
        "effect": effect.name,
        "stage": effect.stage,
        "stage_accept": [effect.stage, *effect.accepted_stages],
        "in_catalogue": effect.in_catalogue,
        "parameters": values,
        "declared": {
            "focal_length": settings.focal_length,
            "fps": settings.fps,
            "gravity": settings.gravity,
        },
        "true": true,
        "magnitude": {
            "mean_last_third": float(last.mean()),
            "max_last_third": float(last.max()),
            "mean_all": float(distance.mean()),
            "max_all": float(distance.max()),
            "per_frame_mean": distance.mean((1, 2)).round(5).tolist(),
        },
        "localisation": {"frames": frames, "vertices": _acted_on(settings, vertices.shape[1:3])},
        "nuisance": {"wind": settings.wind},
        "settings": {
            name: dict(value) if name == "parameters" else value
            for name, value in vars(settings).items()
            if name not in ("python", "threads")
        },
    }
    values_only: dict[str, Any] = json.loads(json.dumps(result))
    return values_only


def _acted_on(settings: BlenderSettings, grid: tuple[int, ...]) -> list[int] | None:
    """Vertices that the effect acts on; None where that is everywhere, nowhere or not known."""
    height, width = grid
    match settings.effect:
        case "nonuniform_stiffness":
            return np.flatnonzero(world.patch(settings, grid).ravel() > 0.5).tolist()
        case "anchor_slip":
            return [(height - 1) * width]
        case _:
            return None


def _simulated(
    settings: BlenderSettings, work: Path, *, with_effect: bool, twin: Array | None = None
) -> Array:
    name = "truth" if with_effect else "twin"
    simulation = world.simulation(settings, name, with_effect=with_effect, twin=twin)
    process.run({"threads": settings.threads, "simulations": [simulation]}, work, settings.python)
    motion: Array = np.load(work / f"{name}.npy").astype(np.float64)
    sides = np.linalg.norm(np.diff(motion, axis=1), axis=-1).max() * (motion.shape[1] - 1)
    if not np.isfinite(motion).all() or sides > 3 * max(settings.cloth_size):
        raise SimulationError(
            f"{settings.effect}: the cloth tears apart or is not finite; choose a weaker effect or more steps"
        )
    return motion


def _at_fit_grid(settings: BlenderSettings, motion: Array, *, with_effect: bool) -> Array:
    """Vertices (F, H, W, 3) of the fit's grid."""
    first, second = world.refinement(settings, with_effect=with_effect)
    return np.ascontiguousarray(motion[:, ::first, ::second])


def _gap(settings: BlenderSettings, truth: Array, twin: Array) -> float:
    a, b = _at_fit_grid(settings, truth, with_effect=True), _at_fit_grid(settings, twin, with_effect=False)
    distance = np.linalg.norm(a - b, axis=-1)[_last_third(len(a))]
    return float(distance.mean()) / settings.cloth_size[0]


def _last_third(n_frames: int) -> slice:
    return slice(n_frames - math.ceil(n_frames / 3), None)


def _levels_off(tried: list[tuple[float, float]], gap: float) -> bool:
    """Whether the last strength was greater than the one before and did hardly more, though not enough."""
    if len(tried) < 2 or tried[-1][1] >= gap:
        return False
    (value, reached), (greater, more) = tried[-2:]
    return greater > value and math.log(more / reached) < _LEAST_SLOPE * math.log(greater / value)


def _next_value(tried: list[tuple[float, float]], gap: float, value: float) -> float:
    """The next strength to try, at most 4 times more or less than the best one so far."""
    if tried and tried[-1][0] != value:  # the last one failed
        return math.sqrt(value * tried[-1][0])
    ranked = sorted(tried, key=lambda pair: abs(math.log(pair[1] / gap)))
    best_value, best = ranked[0]
    slope = 1.0
    if len(ranked) > 1 and ranked[1][0] != best_value and ranked[1][1] != best:
        slope = math.log(ranked[1][1] / best) / math.log(ranked[1][0] / best_value)
    slope = min(max(slope, 0.3), 3.0)
    return best_value * min(max((gap / best) ** (1 / slope), 0.25), 4.0)


def _filmed(settings: BlenderSettings, truth: Array, work: Path) -> Scene:
    height, width = settings.image_size
    camera = Camera(
        settings.focal_length, settings.focal_length, width / 2, height / 2, height, width
    )  # as declared
    with_effect = effect_named(settings.effect).stage in ("mechanics", "actuation")
    vertices = torch.from_numpy(_at_fit_grid(settings, truth, with_effect=with_effect))
    texture = work / "texture.png"
    write_image(texture, procedural_texture(settings.texture_size, settings.texture_size, settings.seed))
    np.save(work / "filmed.npy", truth.astype(np.float32))
    request = world.film(settings, work / "filmed.npy", texture)
    _check_visible(settings, truth, request["camera"]["fx"])
    process.run({"threads": settings.threads, "film": request}, work, settings.python)
    rng = settings.stream(9)
    exposed = [
        expose(settings, np.load(work / f"image_{frame:03d}.npy").astype(np.float64), rng)
        for frame in range(settings.n_frames)
    ]
    frames, masks = (torch.from_numpy(np.stack(images)) for images in zip(*exposed, strict=True))
    return Scene(
        name=settings.name,
        frames=frames,
        masks=masks,
        camera=camera,
        texture=frames[0],
        texture_coordinates=project_coordinates(vertices[0], camera),
        template=vertices[0],
        cloth_size=settings.cloth_size,
        gravity=torch.tensor(settings.gravity, dtype=torch.float64),
        fps=settings.fps,
        pinned_vertices=(0, (settings.grid[0] - 1) * settings.grid[1]),
        original_size=settings.image_size,
        ground_truth=GroundTruth(vertices=vertices),
    )


def _check_visible(settings: BlenderSettings, truth: Array, focal_length: float) -> None:
    """Refuse a cloth that leaves the image."""
    half = 0.5 * np.array(settings.image_size[::-1]) - 2
    if truth[..., 2].min() > 0.1:
        reach = np.abs(truth[..., :2] / truth[..., 2:] * focal_length).max((0, 1, 2))
        if settings.effect == "lens_distortion":
            reach = reach * (1 + max(settings.values["k1"], 0) * (reach**2).sum() / focal_length**2)
        if (reach <= half).all():
            return
        got = f"up to {reach[0]:.0f} px beside and {reach[1]:.0f} px above or below the middle"
    else:
        got = "a cloth that comes closer to the camera than 0.1 m"
    raise InputError(
        "The cloth leaves the image",
        where="distance, focal_length, image_size, effect",
        expected=f"at most {half[0]:.0f} px beside and {half[1]:.0f} px above or below the middle",
        got=got,
    )
