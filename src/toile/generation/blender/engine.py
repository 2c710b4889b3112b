"""The part that runs inside Blender: ``python -m toile.generation.blender.engine request.json folder``.

Imports only bpy, NumPy and the standard library. Blender's world is taken to be the OpenCV camera frame
(x right, y down, z forward, metres), so nothing is converted; only Blender's camera, which looks along its
own -z with y up, is turned.

A request is a JSON object with ``threads`` and any of:

- ``simulations``: list of objects, each written to ``<name>.npy``, (F, H', W', 3) float32 [m]; see simulate
- ``film``: an object, written to ``image_000.npy`` ..., (h, w, 4) float16, linear light, multiplied by
  coverage, row 0 on top; see film

Time: Blender's solver counts in units in which 9.81 m/s² is 9.81e-3, whatever the frame rate, so a unit is
1/sqrt(1000) s, and a frame of 1/fps lasts with ``time_scale`` = sqrt(1000)/fps as long as it should.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_UNITS_PER_SECOND = 1000**0.5
DONE = "done"
"""Empty file that is written last: Blender may still crash on its way out."""


def main(request_file: str, folder: str) -> None:
    """Carry out a request; see the module."""
    request = json.loads(Path(request_file).read_text())
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    for simulation in request.get("simulations", ()):
        np.save(target / f"{simulation['name']}.npy", simulate(simulation, request["threads"]))
    if request.get("film"):
        film(request["film"], target, request["threads"])
    (target / DONE).touch()


def simulate(spec: dict[str, Any], threads: int) -> NDArray[np.float32]:
    """Motion of one cloth that is at rest in frame 0, its state before the first step.

    Args:
        spec: with keys

            - ``pose``: (H', W', 3) [m]; ``rest``: the same for the rest shape
            - ``pinned``: [[i, j], ...], ``displacement``: (F, n_pinned, 3) [m]; linear within a frame
            - ``fps``, ``steps`` per frame, ``gravity`` [m/s²]
            - ``cloth``: attributes of Blender's cloth settings
            - ``weights``: {attribute that takes a vertex group: (H', W') weights in [0, 1]}
            - ``fields``: list of {``type``, ``location``, ``direction`` (the field's own z),
              ``strength``: (F,), ``attributes``}
            - ``shrinkage``: (F,) fractions, or none
            - ``sphere``: {``centre``, ``radius``, ``friction``, ``thickness``} or none

        threads: of Blender.

    Returns:
        Positions (F, H', W', 3) [m].
    """
    pose = np.asarray(spec["pose"], float)
    displacement = np.asarray(spec["displacement"], float)
    n_frames = len(displacement)
    scene = empty_scene(threads, n_frames)
    scene.gravity = spec["gravity"]
    cloth_object = _sheet(scene, pose)
    cloth_object.shape_key_add(name="Basis", from_mix=False)
    rest = cloth_object.shape_key_add(name="rest", from_mix=False)
    rest.data.foreach_set("co", np.asarray(spec["rest"], np.float32).ravel())
    rest.value = 0.0
    pinned = [i * pose.shape[1] + j for i, j in spec["pinned"]]
    for number, vertex in enumerate(pinned):
        for axis in range(3):
            key = cloth_object.shape_key_add(name=f"pinned {number} {axis}", from_mix=False)
            key.slider_min, key.slider_max = -10, 10
            key.data[vertex].co[axis] += 1
            _animate(key, "value", displacement[:, number, axis])

    # Blender 4.2 hands the rest shape to a cloth modifier only if one that does more than deform comes first.
    first = cloth_object.modifiers.new("identity", "EDGE_SPLIT")
    first.use_edge_angle = first.use_edge_sharp = False
    modifier = cloth_object.modifiers.new("cloth", "CLOTH")
    cloth = modifier.settings
    cloth.quality = spec["steps"]
    cloth.time_scale = time_scale(spec["fps"], spec["steps"])
    cloth.bending_model = "ANGULAR"
    cloth.rest_shape_key = rest
    pins = np.zeros(pose.shape[:2])
    for i, j in spec["pinned"]:
        pins[i, j] = 1
    cloth.pin_stiffness = 1
    for name, weights in {"vertex_group_mass": pins, **spec.get("weights", {})}.items():
        setattr(cloth, name, _vertex_group(cloth_object, name, np.asarray(weights, float)))
    for name, value in spec["cloth"].items():
        setattr(cloth, name, value)
    modifier.collision_settings.use_collision = False
    modifier.collision_settings.use_self_collision = False
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 0, n_frames - 1

    for field in spec.get("fields", ()):
        _force_field(field)
    if spec.get("sphere"):
        _obstacle(scene, spec["sphere"])
        modifier.collision_settings.use_collision = True
        modifier.collision_settings.collision_quality = 4
        modifier.collision_settings.distance_min = spec["sphere"]["thickness"]
        modifier.collision_settings.friction = spec["sphere"]["friction"]
    shrinkage = spec.get("shrinkage")
    if shrinkage is not None:
        _animate(cloth, "shrink_min", np.asarray(shrinkage, float))

    return simulated(scene, cloth_object, pose.shape, n_frames)


def simulated(scene: Any, thing: Any, shape: tuple[int, ...], n_frames: int) -> NDArray[np.float32]:
    """Positions (n_frames, *shape) [m] of a thing's vertices, in its own frame.

    Args:
        scene: of Blender, with the thing and its solver.
        thing: an object with as many vertices as the shape has.
        shape: of a frame, (..., 3).
        n_frames: from frame 0 on.
    """
    import bpy

    motion = np.empty((n_frames, *shape), np.float32)
    # Every frame in turn: the solver only steps from one frame to the next.
    for frame in range(n_frames):
        scene.frame_set(frame)
        mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        mesh.vertices.foreach_get("co", motion[frame].reshape(-1))
    return motion


def film(spec: dict[str, Any], folder: Path, threads: int) -> None:
    """Render every frame.

    Args:
        spec: with keys

            - ``vertices``: file, (F, H', W', 3) [m]; ``texture``: file, axis 0 of the grid along its rows
            - ``camera``: {``fx``, ``cx``, ``cy``, ``height``, ``width``} [px], (0, 0) at the top-left corner
            - ``samples`` per pixel, ``filter_width`` [px], ``seed``
            - ``shutter``: open time as a fraction of a frame, centred on the frame; ``exposures`` in it
            - ``light``: {``ambient``, ``lambert``, ``direction`` (F, 3) in which it travels} or none: the
              cloth glows with its own colour
            - ``occluder``: {``location``, ``size``, ``direction``, ``colour``, ``shift`` (F, 3)} or none: a
              bar that hides the cloth but not its coverage

        folder: for the images.
        threads: of Blender.
    """
    import bpy

    motion = np.load(spec["vertices"]).astype(float)
    scene = empty_scene(threads, len(motion))
    cloth = _sheet(scene, motion[0])
    cloth.data.polygons.foreach_set("use_smooth", [True] * len(cloth.data.polygons))
    light = spec.get("light")
    cloth.data.materials.append(_printed(cloth, motion.shape[1:3], spec["texture"], light))
    sun = _sun(scene, light) if light else None
    directions = np.array(light["direction"]) if light else np.zeros((0, 3))
    occluder = _bar(scene, spec["occluder"]) if spec.get("occluder") else None
    camera_of(scene, spec["camera"])
    cycles_of(scene, spec)
    path = folder / "render.exr"

    def photograph() -> Array:
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        return pixels_of(path)

    exposures = spec["exposures"] if spec["shutter"] > 0 else 1
    offsets = ((np.arange(exposures) + 0.5) / exposures - 0.5) * spec["shutter"]
    for frame in range(len(motion)):
        total = np.zeros((spec["camera"]["height"], spec["camera"]["width"], 4))
        for number, offset in enumerate(offsets):
            scene.cycles.seed = (spec["seed"] + frame * exposures + number) % 2**31
            cloth.data.vertices.foreach_set("co", between(motion, frame + offset).astype(np.float32).ravel())
            cloth.data.update()
            if sun:
                _point(sun, -directions[frame])
            if occluder:
                occluder.location = np.add(spec["occluder"]["location"], spec["occluder"]["shift"][frame])
                occluder.hide_render = False
            image = photograph()
            if occluder:
                occluder.hide_render = True
                image[..., 3] = photograph()[..., 3]
            total += image / exposures
        np.save(folder / f"image_{frame:03d}.npy", total.astype(np.float16))
    path.unlink()


def time_scale(fps: float, steps: int) -> float:
    """Blender's time scale for frames that last as long as they should, in exactly so many steps.

    Blender adds up its steps in single precision until they reach the frame's length, and for some numbers
    rounding makes it take one more, 13 % too fast with 8 steps. A change in the last digits prevents that.
    """
    scale = np.float32(_UNITS_PER_SECOND / fps)
    for _ in range(1000):
        step = np.float32(np.float32(1) / np.float32(steps)) * scale
        taken, time = 0, np.float32(0)
        while time < scale:
            time += step
            taken += 1
        if taken == steps:
            break
        scale = np.nextafter(scale, np.float32(0))
    return float(scale)


def between(motion: Array, time: float) -> Array:
    """Positions (H', W', 3) at a time in frames: cubic between frames, linear beyond the first and last."""
    last = len(motion) - 1
    if last == 0:
        return motion[0]
    if time <= 0:
        return motion[0]
    k = min(int(time), last - 1)
    s = time - k
    velocities = [motion[min(m + 1, last)] - motion[max(m - 1, 0)] for m in (k, k + 1)]
    v0, v1 = (v / (min(m + 1, last) - max(m - 1, 0)) for v, m in zip(velocities, (k, k + 1), strict=True))
    if s > 1:
        return motion[last] + (s - 1) * v1
    h = s * s * (3 - 2 * s)
    result: Array = (1 - h) * motion[k] + h * motion[k + 1] + s * (1 - s) ** 2 * v0 - s * s * (1 - s) * v1
    return result


def empty_scene(threads: int, n_frames: int) -> Any:
    """A scene without anything, of frames 0 to n_frames - 1."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.threads_mode = "FIXED"
    scene.render.threads = threads
    scene.frame_start, scene.frame_end = 0, n_frames - 1
    scene.use_gravity = True
    return scene


def _sheet(scene: Any, pose: Array) -> Any:
    """A mesh object of quads with the vertices (H', W', 3) in row-major order."""
    import bpy

    k = np.arange(pose.shape[0] * pose.shape[1]).reshape(pose.shape[:2])
    quads = np.stack((k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]), -1).reshape(-1, 4)
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata(pose.reshape(-1, 3).tolist(), [], quads.tolist())
    mesh.update()
    sheet = bpy.data.objects.new("cloth", mesh)
    scene.collection.objects.link(sheet)
    return sheet


def _animate(owner: Any, attribute: str, values: Array) -> None:
    """Key a number for every frame, linear in between."""
    for frame, value in enumerate(values):
        setattr(owner, attribute, float(value))
        owner.keyframe_insert(attribute, frame=frame)
    for curve in owner.id_data.animation_data.action.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def _vertex_group(sheet: Any, name: str, weights: Array) -> str:
    group = sheet.vertex_groups.new(name=name)
    for vertex, weight in enumerate(weights.ravel()):
        group.add([vertex], float(weight), "REPLACE")
    return str(group.name)


def _point(thing: Any, z_axis: Array) -> None:
    """Turn an object so that its own z axis points along a vector (3,)."""
    from mathutils import Vector

    thing.rotation_mode = "QUATERNION"
    thing.rotation_quaternion = Vector(z_axis).to_track_quat("Z", "Y")


def _force_field(spec: dict[str, Any]) -> None:
    import bpy

    bpy.ops.object.effector_add(type=spec["type"], location=spec["location"])
    thing = bpy.context.object
    _point(thing, np.asarray(spec["direction"], float))
    field = thing.field
    field.flow = 0  # a force, whatever the cloth's velocity
    for name, value in spec.get("attributes", {}).items():
        setattr(field, name, value)
    strength = np.asarray(spec["strength"], float)
    field.strength = float(strength[0])
    if np.ptp(strength) > 0:
        for frame, value in enumerate(strength):
            field.strength = float(value)
            thing.keyframe_insert("field.strength", frame=frame)


def _obstacle(scene: Any, spec: dict[str, Any]) -> None:
    import bpy

    bpy.ops.mesh.primitive_uv_sphere_add(
        segments=64, ring_count=32, radius=spec["radius"], location=spec["centre"]
    )
    sphere = bpy.context.object
    sphere.modifiers.new("collision", "COLLISION")
    sphere.collision.thickness_outer = spec["thickness"]
    sphere.collision.cloth_friction = spec["friction"]


def _printed(sheet: Any, grid: tuple[int, ...], texture: str, light: dict[str, Any] | None) -> Any:
    """Material that glows with the texture, or reflects it diffusely."""
    import bpy

    u, v = np.meshgrid(np.linspace(0, 1, grid[0]), 1 - np.linspace(0, 1, grid[1]), indexing="ij")
    corners = np.empty(len(sheet.data.loops), np.int32)
    sheet.data.loops.foreach_get("vertex_index", corners)
    layer = sheet.data.uv_layers.new(name="uv")
    layer.data.foreach_set("uv", np.stack((u.ravel(), v.ravel()), -1)[corners].astype(np.float32).ravel())
    material = bpy.data.materials.new("print")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    image = nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.load(texture)
    image.extension = "EXTEND"
    glow, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    links.new(image.outputs["Color"], glow.inputs["Color"])
    if light is None:
        links.new(glow.outputs[0], output.inputs["Surface"])
    else:
        glow.inputs["Strength"].default_value = light["ambient"]
        diffuse, both = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeAddShader")
        links.new(image.outputs["Color"], diffuse.inputs["Color"])
        links.new(glow.outputs[0], both.inputs[0])
        links.new(diffuse.outputs[0], both.inputs[1])
        links.new(both.outputs[0], output.inputs["Surface"])
    return material


def _sun(scene: Any, light: dict[str, Any]) -> Any:
    import bpy

    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy = np.pi * light["lambert"]  # so that a surface that faces it has its own colour times lambert
    lamp.angle = 0.01
    sun = bpy.data.objects.new("sun", lamp)
    scene.collection.objects.link(sun)
    return sun


def _bar(scene: Any, spec: dict[str, Any]) -> Any:
    import bpy

    bpy.ops.mesh.primitive_cube_add(size=1, location=spec["location"])
    bar = bpy.context.object
    bar.scale = spec["size"]
    _point(bar, np.asarray(spec["direction"], float))
    material = bpy.data.materials.new("bar")
    material.use_nodes = True
    material.node_tree.nodes.clear()
    glow = material.node_tree.nodes.new("ShaderNodeEmission")
    glow.inputs["Color"].default_value = (*spec["colour"], 1)
    output = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(glow.outputs[0], output.inputs["Surface"])
    bar.data.materials.append(material)
    return bar


def camera_of(scene: Any, spec: dict[str, Any]) -> None:
    """Give a scene the camera of ``film``, at the origin."""
    import bpy
    from mathutils import Matrix

    camera = bpy.data.cameras.new("camera")
    height, width = spec["height"], spec["width"]
    side = max(height, width)
    camera.sensor_fit = "HORIZONTAL" if width >= height else "VERTICAL"
    camera.sensor_width = camera.sensor_height = 36.0
    camera.lens = spec["fx"] * 36.0 / side
    camera.shift_x = (width / 2 - spec["cx"]) / side
    camera.shift_y = (spec["cy"] - height / 2) / side
    camera.clip_start = 0.01
    thing = bpy.data.objects.new("camera", camera)
    thing.matrix_world = Matrix.Diagonal((1, -1, -1, 1))
    scene.collection.objects.link(thing)
    scene.camera = thing
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.render.resolution_percentage = 100


def cycles_of(scene: Any, spec: dict[str, Any]) -> None:
    """Let Cycles render coverage and linear light, with the samples and the filter of ``film``."""
    scene.render.engine = "CYCLES"
    scene.render.film_transparent = True
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGBA"
    scene.render.image_settings.color_depth = "32"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples = spec["samples"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.max_bounces = 0
    cycles.filter_width = spec["filter_width"]


def pixels_of(path: Path) -> Array:
    """Image (h, w, 4) of an EXR file, linear, row 0 on top."""
    import bpy

    image = bpy.data.images.load(str(path))
    width, height = image.size
    flat = np.empty(height * width * 4, np.float32)
    image.pixels.foreach_get(flat)
    bpy.data.images.remove(image)
    return flat.reshape(height, width, 4)[::-1].astype(float)


if __name__ == "__main__":
    main(*sys.argv[1:])
