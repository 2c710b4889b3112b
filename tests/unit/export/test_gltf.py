from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from toile.export.animation import ClothAnimation
from toile.export.gltf import export_gltf

WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
DTYPE = {5126: "<f4", 5125: "<u4"}


def parse(path: Path) -> tuple[dict[str, Any], bytes]:
    """Read a GLB container strictly, as the specification (glTF 2.0, chapter 4) describes it."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    n_json, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert n_json % 4 == 0
    document = json.loads(data[20 : 20 + n_json])
    n_binary, kind = struct.unpack_from("<I4s", data, 20 + n_json)
    assert kind == b"BIN\0"
    assert n_binary % 4 == 0
    binary = data[28 + n_json :]
    assert len(binary) == n_binary
    assert 0 <= n_binary - document["buffers"][0]["byteLength"] < 4
    return document, binary


def array(document: dict[str, Any], binary: bytes, index: int) -> np.ndarray:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    assert view["byteOffset"] + view["byteLength"] <= len(binary)
    width = WIDTH[accessor["type"]]
    assert view["byteLength"] == accessor["count"] * width * 4
    content = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    values = np.frombuffer(content, DTYPE[accessor["componentType"]]).reshape(-1, width)
    if "min" in accessor:
        assert accessor["min"] == values.min(0).tolist()
        assert accessor["max"] == values.max(0).tolist()
    return values


@pytest.mark.parametrize("keep", [False, True])
def test_morph_targets_give_every_frame_back(animation: ClothAnimation, tmp_path: Path, keep: bool) -> None:
    document, binary = parse(export_gltf(animation, tmp_path / "cloth.glb", keep_camera_frame=keep))
    primitive = document["meshes"][0]["primitives"][0]
    base = array(document, binary, primitive["attributes"]["POSITION"])
    deltas = [array(document, binary, t["POSITION"]) for t in primitive["targets"]]
    assert len(deltas) == animation.n_frames - 1
    sampler = document["animations"][0]["samplers"][0]
    times = array(document, binary, sampler["input"])[:, 0]
    weights = array(document, binary, sampler["output"]).reshape(len(times), len(deltas))
    np.testing.assert_allclose(times, [0, 1 / 25, 2 / 25], rtol=1e-6)
    for f, w in enumerate(weights):
        posed = base + sum(wk * d for wk, d in zip(w, deltas, strict=True))
        np.testing.assert_allclose(posed, animation.vertices(keep)[f], atol=1e-6)


def test_required_parts_of_the_specification(animation: ClothAnimation, tmp_path: Path) -> None:
    document, binary = parse(export_gltf(animation, tmp_path / "cloth.glb"))
    assert document["asset"]["version"] == "2.0"
    mesh = document["meshes"][0]
    primitive = mesh["primitives"][0]
    assert len(mesh["weights"]) == len(primitive["targets"])
    for target in [primitive["attributes"], *primitive["targets"]]:
        assert "min" in document["accessors"][target["POSITION"]]
    assert "min" in document["accessors"][document["animations"][0]["samplers"][0]["input"]]
    assert document["animations"][0]["channels"] == [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]
    indices = array(document, binary, primitive["indices"]).reshape(-1, 3)
    assert np.array_equal(indices, animation.triangles())
    normals = array(document, binary, primitive["attributes"]["NORMAL"])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    uv = array(document, binary, primitive["attributes"]["TEXCOORD_0"])
    np.testing.assert_allclose(uv, animation.uv(v_up=False), atol=1e-7)
    image = document["bufferViews"][document["images"][0]["bufferView"]]
    png = binary[image["byteOffset"] : image["byteOffset"] + image["byteLength"]]
    assert png == animation.png()
    assert document["materials"][0]["doubleSided"] is True


def test_opens_elsewhere(animation: ClothAnimation, tmp_path: Path) -> None:
    scene = trimesh.load_scene(export_gltf(animation, tmp_path / "cloth.glb"), process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.vertices, animation.vertices()[0], atol=1e-6)
    assert mesh.visual.material.baseColorTexture.size == (6, 5)


def test_single_frame_has_no_animation(tmp_path: Path) -> None:
    still = ClothAnimation(positions=np.random.default_rng(0).normal(size=(1, 2, 2, 3)), fps=30.0)
    document, _ = parse(export_gltf(still, tmp_path / "cloth.glb"))
    assert "animations" not in document
    assert "targets" not in document["meshes"][0]["primitives"][0]
    assert "images" not in document


def test_unevenly_spaced_frames_are_at_their_times(animation: ClothAnimation, tmp_path: Path) -> None:
    uneven = replace(animation, fps=20.0, times=np.array([0.0, 0.02, 0.1]))
    document, binary = parse(export_gltf(uneven, tmp_path / "cloth.glb"))
    times = array(document, binary, document["animations"][0]["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, uneven.times, atol=1e-7)
