"""Body and garment in one file, opened again by other libraries."""

from __future__ import annotations

import json
import os
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

from toile.errors import InputError
from toile.export.animation import MeshAnimation
from toile.export.formats import export_meshes
from toile.generation.blender.process import ENVIRONMENT, available, interpreter

FPS = 25.0


@pytest.fixture
def meshes() -> tuple[MeshAnimation, MeshAnimation]:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.3)
    sheet = trimesh.creation.box((1.0, 0.1, 1.0))
    steps = np.array([[0.0, 0, 0], [0, 0.1, 0], [0, 0.3, 0.05]])
    return (
        MeshAnimation(ball.vertices[None] + steps[:, None], np.asarray(ball.faces), FPS, "body"),
        MeshAnimation(sheet.vertices[None] - 2 * steps[:, None], np.asarray(sheet.faces), FPS, "garment"),
    )


def document(path: Path) -> dict:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def test_gltf_holds_both_meshes_and_one_animation_of_both(
    meshes: tuple[MeshAnimation, MeshAnimation], tmp_path: Path
) -> None:
    path = export_meshes(meshes, tmp_path, "glb")
    opened = trimesh.load_scene(path, process=False)
    for mesh in meshes:
        assert opened.geometry[mesh.name].vertices == pytest.approx(mesh.positions[0], abs=1e-6)
        assert len(opened.geometry[mesh.name].faces) == len(mesh.faces)
    content = document(path)
    (motion,) = content["animations"]
    assert [channel["target"]["node"] for channel in motion["channels"]] == [0, 1]
    for number, mesh in enumerate(meshes):
        (primitive,) = content["meshes"][number]["primitives"]
        accessor = content["accessors"][primitive["targets"][1]["POSITION"]]
        # glTF 2.0, 3.6.2.5: bounds of the displacements.
        assert accessor["max"] == pytest.approx((mesh.positions[2] - mesh.positions[0]).max(0), abs=1e-6)
        assert accessor["count"] == mesh.positions.shape[1]


def test_usd_holds_both_meshes_with_every_frame(
    meshes: tuple[MeshAnimation, MeshAnimation], tmp_path: Path
) -> None:
    stage = Usd.Stage.Open(str(export_meshes(meshes, tmp_path, "usd")))
    assert stage.GetTimeCodesPerSecond() == FPS
    for mesh in meshes:
        found = UsdGeom.Mesh(stage.GetPrimAtPath(f"/scene/{mesh.name}/{mesh.name}"))
        assert len(found.GetFaceVertexCountsAttr().Get()) == len(mesh.faces)
        for f in range(3):
            assert np.array(found.GetPointsAttr().Get(f)) == pytest.approx(mesh.positions[f], abs=1e-6)


@pytest.mark.skipif(not available(), reason=f"no bpy here nor in {ENVIRONMENT}")
@pytest.mark.parametrize("format", ["glb", "usd"])
def test_blender_opens_it_with_the_motion(
    meshes: tuple[MeshAnimation, MeshAnimation], tmp_path: Path, format: str
) -> None:
    path = export_meshes(meshes, tmp_path, format)
    command = [interpreter(), "-c", _LOOK, str(path), str(FPS)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=dict(os.environ))
    lines = [line for line in result.stdout.splitlines() if line.startswith("heights ")]
    assert lines, result.stderr
    heights = json.loads(lines[0].removeprefix("heights "))
    # Blender turns y up into z up.
    assert heights["body"] == pytest.approx([0, 0.1, 0.3], abs=1e-3)
    assert heights["garment"] == pytest.approx([0, -0.2, -0.6], abs=1e-3)


_LOOK = """
import json, sys
import bpy, numpy as np
path, fps = sys.argv[1], float(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = int(fps)
(bpy.ops.import_scene.gltf if path.endswith("glb") else bpy.ops.wm.usd_import)(filepath=path)
heights = {"body": [], "garment": []}
for frame in range(3):
    scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    for thing in scene.objects:
        if thing.type != "MESH":
            continue
        names = [thing.name, thing.data.name, thing.parent.name if thing.parent else ""]
        name = next(n for n in heights if any(m.startswith(n) for m in names))
        done = thing.evaluated_get(graph)
        points = np.array([done.matrix_world @ v.co for v in done.data.vertices])
        heights[name].append(float(points[:, 2].mean()))
print("heights", json.dumps(heights))
"""


def test_meshes_that_do_not_fit_are_named(
    meshes: tuple[MeshAnimation, MeshAnimation], tmp_path: Path
) -> None:
    body, garment = meshes
    short = MeshAnimation(garment.positions[:2], garment.faces, FPS, "garment")
    with pytest.raises(InputError, match="3 frames"):
        export_meshes((body, short), tmp_path, "glb")
    with pytest.raises(InputError, match="several meshes"):
        export_meshes(meshes, tmp_path, "obj")
    with pytest.raises(InputError, match="name of its own"):
        export_meshes((body, body), tmp_path, "usd")
    with pytest.raises(InputError, match="indices below"):
        MeshAnimation(body.positions, body.faces + 40, FPS)
