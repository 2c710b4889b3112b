"""A garment on a moving body in Blender: ``python -m toile.generation.blender.person request.json folder``.

Imports only bpy, NumPy and the standard library. Blender's world is taken to be ours (y up, metres), so
nothing is converted; gravity is a vector, and only Blender's camera, which looks along its own -z with y up,
is turned. About Blender's units of time see engine.

A request is a JSON object with ``threads`` and any of ``simulation`` (see simulate), whose motion is written
to ``garment.npy``, (F, N, 3) float32 [m], and ``film`` (see film), written to ``image_<view>_<frame>.npy``,
(h, w, 4) float16, linear light, multiplied by coverage, row 0 on top.
"""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toile.generation.blender.engine import (
    DONE,
    camera_of,
    cycles_of,
    empty_scene,
    pixels_of,
    simulated,
    time_scale,
)

Array = NDArray[np.float64]


def main(request_file: str, folder: str) -> None:
    """Carry out a request; see the module."""
    request = json.loads(Path(request_file).read_text())
    target = Path(folder)
    if request.get("simulation"):
        np.save(target / "garment.npy", simulate(request["simulation"], target, request["threads"]))
    if request.get("film"):
        film(request["film"], target, request["threads"])
    (target / DONE).touch()


def simulate(spec: dict[str, Any], folder: Path, threads: int) -> NDArray[np.float32]:
    """Motion of a garment on a body by Blender's cloth solver with collision.

    Args:
        spec: with keys

            - ``arrays``: .npz with ``body`` (F, V, 3) [m] and ``body_faces``, ``garment`` (N, 3) [m], its
              rest shape and state in frame 0, ``garment_faces``, ``pinned`` (A,), ``targets`` (F, A, 3) [m]
            - ``fps``, ``steps`` per frame, ``gravity`` [m/s²]
            - ``cloth``: attributes of Blender's cloth settings
            - ``thickness`` [m], ``friction`` in Blender's units

        folder: for the caches that carry the motion of the body.
        threads: of Blender.
    """
    with np.load(spec["arrays"]) as arrays:
        given = {name: arrays[name] for name in arrays.files}
    n_frames = len(given["body"])
    scene = empty_scene(threads, n_frames)
    scene.gravity = spec["gravity"]
    body = _mesh(scene, "body", given["body"][0], given["body_faces"])
    _follow(body, given["body"], folder / "body.pc2")
    body.modifiers.new("collision", "COLLISION")
    body.collision.thickness_outer = spec["thickness"]
    body.collision.cloth_friction = spec["friction"]

    garment = _mesh(scene, "garment", given["garment"], given["garment_faces"])
    held = np.repeat(given["garment"][None], n_frames, 0)
    held[:, given["pinned"]] = given["targets"]
    _follow(garment, held, folder / "garment.pc2")
    group = garment.vertex_groups.new(name="pinned")
    group.add(given["pinned"].tolist(), 1.0, "REPLACE")
    modifier = garment.modifiers.new("cloth", "CLOTH")
    cloth = modifier.settings
    cloth.quality = spec["steps"]
    cloth.time_scale = time_scale(spec["fps"], spec["steps"])
    cloth.vertex_group_mass = group.name
    cloth.pin_stiffness = 1
    for name, value in spec["cloth"].items():
        setattr(cloth, name, value)
    collision = modifier.collision_settings
    collision.use_collision, collision.use_self_collision = True, False
    collision.collision_quality = 5
    collision.distance_min = spec["thickness"]
    collision.friction = spec["friction"]
    modifier.point_cache.frame_start, modifier.point_cache.frame_end = 0, n_frames - 1

    return simulated(scene, garment, given["garment"].shape, n_frames)


def film(spec: dict[str, Any], folder: Path, threads: int) -> None:
    """Render every frame of every view.

    Args:
        spec: with keys

            - ``meshes``: list of {``arrays``: .npz with ``positions`` (F, V, 3) [m], ``faces``, ``uv``
              (V, 2), v up; ``texture``: file}
            - ``cameras``: list of {``fx``, ``cx``, ``cy``, ``height``, ``width``, ``R``, ``t``}
            - ``samples`` per pixel, ``filter_width`` [px], ``seed``
            - ``sun``: (F, 3) direction towards it; ``strength`` of it, ``ambient`` light

        folder: for the images.
        threads: of Blender.
    """
    import bpy
    from mathutils import Matrix, Vector

    loaded = []
    for mesh in spec["meshes"]:
        with np.load(mesh["arrays"]) as arrays:
            loaded.append({name: arrays[name] for name in arrays.files})
    n_frames = len(loaded[0]["positions"])
    scene = empty_scene(threads, n_frames)
    things = []
    for number, (mesh, given) in enumerate(zip(spec["meshes"], loaded, strict=True)):
        thing = _mesh(scene, f"mesh {number}", given["positions"][0], given["faces"])
        thing.data.polygons.foreach_set("use_smooth", [True] * len(thing.data.polygons))
        thing.data.materials.append(_textured(thing, given["uv"], mesh["texture"]))
        things.append(thing)
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy = np.pi * spec["strength"]
    lamp.angle = 0.1
    sun = bpy.data.objects.new("sun", lamp)
    sun.rotation_mode = "QUATERNION"
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = spec["ambient"]
    cycles_of(scene, spec)
    scene.cycles.max_bounces = 1
    cameras = []
    for camera in spec["cameras"]:
        camera_of(scene, camera)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera["R"], camera["t"]
        scene.camera.matrix_world = Matrix(np.linalg.inv(pose).tolist()) @ Matrix.Diagonal((1, -1, -1, 1))
        cameras.append(scene.camera)
    path = folder / "render.exr"
    for frame in range(n_frames):
        for thing, given in zip(things, loaded, strict=True):
            thing.data.vertices.foreach_set("co", given["positions"][frame].astype(np.float32).ravel())
            thing.data.update()
        sun.rotation_quaternion = Vector(spec["sun"][frame]).to_track_quat("Z", "Y")
        for number, camera in enumerate(cameras):
            scene.camera = camera
            scene.cycles.seed = (spec["seed"] + frame * len(spec["cameras"]) + number) % 2**31
            scene.render.filepath = str(path)
            bpy.ops.render.render(write_still=True)
            np.save(folder / f"image_{number}_{frame:03d}.npy", pixels_of(path).astype(np.float16))
    path.unlink()


def _mesh(scene: Any, name: str, positions: Array, faces: NDArray[np.int64]) -> Any:
    import bpy

    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(positions, float).tolist(), [], np.asarray(faces).tolist())
    mesh.update()
    thing = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(thing)
    return thing


def _follow(thing: Any, positions: Array, path: Path) -> None:
    """Let a mesh take given positions (F, V, 3) in every frame, by a cache in the format PC2."""
    frames, vertices, _ = positions.shape
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, vertices, 0.0, 1.0, frames)
    path.write_bytes(header + np.ascontiguousarray(positions, "<f4").tobytes())
    cache = thing.modifiers.new("motion", "MESH_CACHE")
    cache.cache_format = "PC2"
    cache.filepath = str(path)
    cache.frame_start = 0
    cache.interpolation = "LINEAR"
    cache.deform_mode = "OVERWRITE"


def _textured(thing: Any, uv: Array, texture: str) -> Any:
    """Material that reflects the texture diffusely."""
    import bpy

    corners = np.empty(len(thing.data.loops), np.int32)
    thing.data.loops.foreach_get("vertex_index", corners)
    layer = thing.data.uv_layers.new(name="uv")
    layer.data.foreach_set("uv", np.asarray(uv)[corners].astype(np.float32).ravel())
    material = bpy.data.materials.new("print")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    image = nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.load(texture)
    image.extension = "EXTEND"
    diffuse, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    links.new(image.outputs["Color"], diffuse.inputs["Color"])
    links.new(diffuse.outputs[0], output.inputs["Surface"])
    return material


if __name__ == "__main__":
    main(*sys.argv[1:])
