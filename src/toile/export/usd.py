"""OpenUSD: one mesh with time-sampled points and a preview material."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from toile.atomic_file import written_atomically
from toile.errors import InputError
from toile.export.animation import ClothAnimation, write_texture

SUFFIXES = (".usd", ".usda", ".usdc")


def export_usd(animation: ClothAnimation, path: Path, *, keep_camera_frame: bool = False) -> Path:
    """Write a USD stage with the motion as time samples, frame f at time code f; the texture goes beside it.

    Frames that are unevenly spaced are at the time codes times · fps, which are no whole numbers then.

    The mesh has quads, vertex order i * W + j, no subdivision, both sides visible; metersPerUnit is 1,
    timeCodesPerSecond the frame rate, and the texture coordinates are ``primvars:st`` (v up).

    Args:
        animation: what to export.
        path: file to write, .usd or .usdc (binary) or .usda (text).
        keep_camera_frame: keep the OpenCV camera frame (y down, which viewers will show upside down).

    Raises:
        InputError: another suffix.
    """
    if path.suffix not in SUFFIXES:
        raise InputError(
            "Not a USD file name", where=str(path), expected=" or ".join(SUFFIXES), got=path.suffix
        )
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(animation.fps)
    stage.SetFramesPerSecond(animation.fps)
    stage.SetStartTimeCode(0)
    codes: list[float] = list(range(animation.n_frames))
    if animation.times is not None:
        codes = (animation.times * animation.fps).tolist()
    stage.SetEndTimeCode(codes[-1])

    name = Tf.MakeValidIdentifier(animation.name)
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, f"/{name}/mesh")
    quads = animation.quads()
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([4] * len(quads)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(quads.reshape(-1).astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
    for f, vertices in enumerate(animation.vertices(keep_camera_frame).astype(np.float32)):
        points.Set(Vt.Vec3fArray.FromNumpy(vertices), codes[f])
        bounds = np.stack((vertices.min(axis=0), vertices.max(axis=0)))
        extent.Set(Vt.Vec3fArray.FromNumpy(bounds), codes[f])

    uv = animation.uv(v_up=True)
    if uv is not None:
        primvars = UsdGeom.PrimvarsAPI(mesh)
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        st.Set(Vt.Vec2fArray.FromNumpy(uv.astype(np.float32)))
    texture = path.with_name(f"{path.stem}_texture.png")
    textured = write_texture(animation, texture)
    _bind_material(stage, mesh, f"/{name}/material", f"./{texture.name}" if textured else None)

    with written_atomically(path) as temporary:
        stage.GetRootLayer().Export(str(temporary))
    return path


def _bind_material(stage: Usd.Stage, mesh: UsdGeom.Mesh, path: str, texture: str | None) -> None:
    """Bind a UsdPreviewSurface, textured through primvars:st where there is a texture."""
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.9)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    colour = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    if texture is None:
        colour.Set(Gf.Vec3f(0.6, 0.6, 0.6))
    else:
        reader = UsdShade.Shader.Define(stage, f"{path}/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        image = UsdShade.Shader.Define(stage, f"{path}/texture")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(texture)
        image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        for wrap in ("wrapS", "wrapT"):
            image.CreateInput(wrap, Sdf.ValueTypeNames.Token).Set("clamp")
        st = reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(st)
        colour.ConnectToSource(image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
