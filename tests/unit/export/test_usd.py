from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

from toile.errors import InputError
from toile.export.animation import ClothAnimation
from toile.export.usd import export_usd


@pytest.mark.parametrize("suffix", ["usdc", "usda", "usd"])
@pytest.mark.parametrize("keep", [False, True])
def test_stage_gives_every_frame_back(
    animation: ClothAnimation, tmp_path: Path, suffix: str, keep: bool
) -> None:
    stage = Usd.Stage.Open(str(export_usd(animation, tmp_path / f"cloth.{suffix}", keep_camera_frame=keep)))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == 25.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 2)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("mesh"))
    assert mesh.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0]
    for f, vertices in enumerate(animation.vertices(keep)):
        np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get(f)), vertices, atol=1e-6)
        low, high = np.array(mesh.GetExtentAttr().Get(f))
        np.testing.assert_allclose([low, high], [vertices.min(0), vertices.max(0)], atol=1e-6)
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [4] * 6
    index = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
    assert np.array_equal(index, animation.quads())
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    assert st.GetInterpolation() == "vertex"
    np.testing.assert_allclose(np.array(st.Get()), animation.uv(v_up=True), atol=1e-7)


def test_material_finds_its_texture_beside_the_stage(animation: ClothAnimation, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(export_usd(animation, tmp_path / "R1.usdc")))
    mesh = stage.GetDefaultPrim().GetChild("mesh")
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    image = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
    asset = image.GetInput("file").Get()
    assert asset.path == "./R1_texture.png"
    assert Path(asset.resolvedPath).read_bytes() == animation.png()


def test_other_suffixes_are_refused(animation: ClothAnimation, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.usda"):
        export_usd(animation, tmp_path / "cloth.abc")


def test_unevenly_spaced_frames_are_at_their_times(animation: ClothAnimation, tmp_path: Path) -> None:
    uneven = replace(animation, fps=20.0, times=np.array([0.0, 0.02, 0.1]))
    stage = Usd.Stage.Open(str(export_usd(uneven, tmp_path / "cloth.usda")))
    assert stage.GetTimeCodesPerSecond() == 20.0
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("mesh"))
    codes = mesh.GetPointsAttr().GetTimeSamples()
    np.testing.assert_allclose(np.array(codes) / 20, uneven.times, atol=1e-12)
    assert stage.GetEndTimeCode() == pytest.approx(2)
    np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get(codes[1])), uneven.vertices()[1], atol=1e-6)
