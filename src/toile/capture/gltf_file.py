"""Reading glTF 2.0: nodes, arrays, buffers inside and beside the file."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from toile.errors import InputError

Floats = npt.NDArray[np.float64]

_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(frozen=True)
class GltfFile:
    """A glTF file.

    Attributes:
        path: where it was read.
        content: its JSON part.
        buffers: its binary parts.
    """

    path: Path
    content: Mapping[str, Any]
    buffers: tuple[bytes, ...]

    def items(self, kind: str) -> list[dict[str, Any]]:
        """All "nodes", "skins", "meshes", "animations" or the like."""
        return list(self.content.get(kind, []))

    def array(self, accessor: int) -> npt.NDArray[Any]:
        """Values of an accessor (n,) or (n, components), normalised integers as numbers from −1 or 0 to 1.

        Raises:
            InputError: the accessor is compressed or sparse, or points beyond the file.
        """
        entry = self.items("accessors")[accessor]
        where = f"{self.path}: accessor {accessor}"
        if "sparse" in entry or "bufferView" not in entry:
            raise InputError(
                "glTF array cannot be read",
                where=where,
                expected="plain values in a buffer",
                got="a sparse or compressed accessor",
            )
        view = self.items("bufferViews")[entry["bufferView"]]
        kind, width = np.dtype(_TYPES[entry["componentType"]]), _COMPONENTS[entry["type"]]
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        stride = view.get("byteStride") or kind.itemsize * width
        buffer, count = self.buffers[view["buffer"]], entry["count"]
        if count and start + stride * (count - 1) + kind.itemsize * width > len(buffer):
            raise InputError(
                "glTF array goes beyond its file",
                where=where,
                expected=f"at most {len(buffer)} bytes",
                got=f"{count} values from byte {start} on",
            )
        values = np.ndarray((count, width), kind, buffer, start, (stride, kind.itemsize))
        array: npt.NDArray[Any] = values.copy()
        if entry.get("normalized"):
            array = np.maximum(array.astype(np.float64) / np.iinfo(kind).max, -1.0)
        return array[:, 0] if width == 1 else array

    def node_transforms(self) -> Floats:
        """Local transform of every node at rest, (n, 4, 4)."""
        return np.stack([_local(node) for node in self.items("nodes")])

    def parents(self) -> list[int]:
        """Parent of every node, −1 for those at the top."""
        parents = [-1] * len(self.items("nodes"))
        for index, node in enumerate(self.items("nodes")):
            for child in node.get("children", []):
                parents[child] = index
        return parents


def read_gltf(path: Path | str) -> GltfFile:
    """Read a .glb, or a .gltf with its buffers.

    Raises:
        InputError: missing, not glTF 2.0, or a buffer that is missing.
    """
    path = Path(path)
    expected = "a glTF 2.0 file, .glb or .gltf"
    if not path.is_file():
        raise InputError("glTF file is missing", where=str(path), expected=expected, got="no such file")
    raw, binary = path.read_bytes(), b""
    try:
        if raw[:4] == struct.pack("<I", _MAGIC):
            at, text = 12, b"{}"
            while at + 8 <= len(raw):
                length, kind = struct.unpack_from("<II", raw, at)
                chunk = raw[at + 8 : at + 8 + length]
                text, binary = (chunk, binary) if kind == _JSON else (text, chunk)
                at += 8 + length
            content = json.loads(text)
        else:
            content = json.loads(raw)
        if not str(content["asset"]["version"]).startswith("2"):
            raise ValueError(f"version {content['asset']['version']}")
        buffers = tuple(_buffer(path, entry, binary) for entry in content.get("buffers", []))
    except (ValueError, KeyError, TypeError, struct.error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            "glTF file cannot be read",
            where=str(path),
            expected=expected,
            got=f"{type(error).__name__}: {error}"[:200],
        ) from error
    return GltfFile(path, content, buffers)


def world_transforms(local: Floats, parents: list[int]) -> Floats:
    """Transforms of nodes to the world, from those to their parents; (..., n, 4, 4), any order of nodes."""
    world = np.full_like(local, np.nan)
    done = [False] * len(parents)

    def place(node: int) -> None:
        chain = [node]
        while parents[chain[-1]] >= 0 and not done[parents[chain[-1]]]:
            chain.append(parents[chain[-1]])
        for each in reversed(chain):
            above = parents[each]
            world[..., each, :, :] = (
                local[..., each, :, :] if above < 0 else world[..., above, :, :] @ local[..., each, :, :]
            )
            done[each] = True

    for node in range(len(parents)):
        if not done[node]:
            place(node)
    return world


def quaternion_matrix(quaternion: Floats) -> Floats:
    """Rotations of quaternions (x, y, z, w), which need not be of unit length; (..., 4) -> (..., 3, 3)."""
    q = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def composed(translation: Floats, rotation: Floats, scale: Floats) -> Floats:
    """Transforms T R S; (..., 3), (..., 4), (..., 3) -> (..., 4, 4)."""
    matrix = np.zeros((*translation.shape[:-1], 4, 4))
    matrix[..., :3, :3] = quaternion_matrix(rotation) * scale[..., None, :]
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def _local(node: Mapping[str, Any]) -> Floats:
    if "matrix" in node:
        # Column by column.
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    return composed(
        np.array(node.get("translation", (0, 0, 0)), dtype=np.float64),
        np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64),
        np.array(node.get("scale", (1, 1, 1)), dtype=np.float64),
    )


def _buffer(path: Path, entry: Mapping[str, Any], binary: bytes) -> bytes:
    uri = entry.get("uri")
    if uri is None:
        return binary
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    file = path.parent / unquote(uri)
    # A file may come from somebody else: nothing outside its folder is read.
    if not file.resolve().is_relative_to(path.parent.resolve()) or not file.is_file():
        raise InputError(
            "Buffer of the glTF file is missing",
            where=str(path),
            expected="a file beside it",
            got=str(uri)[:100],
        )
    return file.read_bytes()
