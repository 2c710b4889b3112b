"""Animated glTF 2.0 in one binary file (GLB): frame 0 as the mesh, every later frame as a morph target."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from toile.atomic_file import written_atomically
from toile.export.animation import Animation, of_equal_length
from toile.geometry.mesh import vertex_normals

FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
CLAMP_TO_EDGE = 33071
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


class _BinaryBuffer:
    """Collects the one binary buffer of a GLB file with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add_bytes(self, content: bytes, target: int | None = None) -> int:
        """Append a buffer view, aligned to four bytes; returns its index."""
        self.data.extend(b"\0" * (-len(self.data) % 4))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        if target is not None:
            view["target"] = target
        self.data.extend(content)
        self.views.append(view)
        return len(self.views) - 1

    def add_array(
        self, array: npt.NDArray[Any], kind: str, target: int | None = None, bounds: bool = False
    ) -> int:
        """Append an accessor of type ``kind`` (SCALAR, VEC2, VEC3); returns its index."""
        integer = array.dtype.kind in "iu"
        packed = np.ascontiguousarray(array, dtype="<u4" if integer else "<f4")
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(packed.tobytes(), target),
            "componentType": UNSIGNED_INT if integer else FLOAT,
            "count": packed.size if kind == "SCALAR" else len(packed),
            "type": kind,
        }
        if bounds:
            # Of the stored float32 values: validators compare them exactly.
            columns = packed.reshape(accessor["count"], -1)
            accessor["min"] = [v.item() for v in columns.min(axis=0)]
            accessor["max"] = [v.item() for v in columns.max(axis=0)]
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def export_gltf(
    animation: Animation | Sequence[Animation], path: Path, *, keep_camera_frame: bool = False
) -> Path:
    """Write one ``.glb`` file with meshes, normals, textures and the whole motion.

    Frame f is reached by weight 1 of morph target f − 1; the sampler interpolates linearly, so between two
    frames the vertices move on straight lines. Vertices keep their order; faces are triangles, both sides
    visible. glTF is y up and metres by definition. Several meshes share one animation, one node each.

    Args:
        animation: what to export; several, e.g. body and garment, of the same frames.
        path: file to write.
        keep_camera_frame: keep the OpenCV camera frame (y down, which viewers will show upside down).
    """
    animations = of_equal_length(animation)
    buffer = _BinaryBuffer()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "toile"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(animations)))}],
        "nodes": [{"name": one.name, "mesh": k} for k, one in enumerate(animations)],
        "meshes": [],
        "materials": [],
    }
    moving: dict[str, Any] = {"name": "motion", "samplers": [], "channels": []}
    for one in animations:
        _add_mesh(one, document, moving, buffer, keep_camera_frame)
    if moving["samplers"]:
        document["animations"] = [moving]
    document["accessors"], document["bufferViews"] = buffer.accessors, buffer.views
    document["buffers"] = [{"byteLength": len(buffer.data)}]
    with written_atomically(path) as temporary:
        temporary.write_bytes(_container(document, bytes(buffer.data)))
    return path


def _add_mesh(
    animation: Animation,
    document: dict[str, Any],
    moving: dict[str, Any],
    buffer: _BinaryBuffer,
    keep_camera_frame: bool,
) -> None:
    """Add mesh, material, texture and motion of one animation, whose node is there already."""
    number = len(document["meshes"])
    vertices = animation.vertices(keep_camera_frame).astype(np.float32).astype(np.float64)
    faces = torch.from_numpy(animation.triangles())
    normals = vertex_normals(torch.from_numpy(vertices), faces).numpy()
    attributes = {
        "POSITION": buffer.add_array(vertices[0], "VEC3", ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.add_array(normals[0], "VEC3", ARRAY_BUFFER),
    }
    uv, png = animation.uv(v_up=False), animation.png()
    if uv is not None:
        attributes["TEXCOORD_0"] = buffer.add_array(uv, "VEC2", ARRAY_BUFFER)
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": buffer.add_array(animation.triangles().reshape(-1), "SCALAR", ELEMENT_ARRAY_BUFFER),
        "material": number,
        "mode": 4,
    }
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
    document["meshes"].append({"name": animation.name, "primitives": [primitive]})
    document["materials"].append(
        {"name": animation.name, "pbrMetallicRoughness": surface, "doubleSided": True}
    )
    if png is not None:
        images = document.setdefault("images", [])
        images.append({"bufferView": buffer.add_bytes(png), "mimeType": "image/png"})
        document.setdefault("samplers", [{"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}])
        textures = document.setdefault("textures", [])
        textures.append({"source": len(images) - 1, "sampler": 0})
        surface["baseColorTexture"] = {"index": len(textures) - 1}
    n_targets = animation.n_frames - 1
    if n_targets:
        primitive["targets"] = [
            {
                "POSITION": buffer.add_array(vertices[f] - vertices[0], "VEC3", ARRAY_BUFFER, bounds=True),
                "NORMAL": buffer.add_array(normals[f] - normals[0], "VEC3", ARRAY_BUFFER),
            }
            for f in range(1, animation.n_frames)
        ]
        document["meshes"][number]["weights"] = [0.0] * n_targets
        weights = np.eye(animation.n_frames, n_targets, k=-1)
        moving["channels"].append(
            {"sampler": len(moving["samplers"]), "target": {"node": number, "path": "weights"}}
        )
        moving["samplers"].append(
            {
                "input": buffer.add_array(animation.frame_times(), "SCALAR", bounds=True),
                "output": buffer.add_array(weights.reshape(-1), "SCALAR"),
                "interpolation": "LINEAR",
            }
        )


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """GLB container: header, JSON chunk padded with spaces, binary chunk padded with zeros."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        (
            struct.pack("<III", MAGIC, 2, length),
            struct.pack("<II", len(text), JSON_CHUNK),
            text,
            struct.pack("<II", len(binary), BINARY_CHUNK),
            binary,
        )
    )
