"""OpenUSD: meshes with time-sampled points and preview materials."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from toile.atomic_file import written_atomically
from toile.errors import InputError
from toile.export.animation import Animation, of_equal_length, write_texture

SUFFIXES = (".usd", ".usda", ".usdc")


def export_usd(
    animation: Animation | Sequence[Animation], path: Path, *, keep_camera_frame: bool = False
) -> Path:
    """Write a USD stage with the motion as time samples, frame f at time code f; textures go beside it.

    Frames that are unevenly spaced are at the time codes times · fps, which are no whole numbers then.

    The mesh has its own polygons (quads of a grid, vertex order i * W + j), no subdivision, both sides
    visible; metersPerUnit is 1, timeCodesPerSecond the frame rate, and the texture coordinates are
    ``primvars:st`` (v up). Several meshes stand side by side below /scene.

    Args:
        animation: what to export; several, e.g. body and garment, of the same frames.
        path: file to write, .usd or .usdc (binary) or .usda (text).
        keep_camera_frame: keep the OpenCV camera frame (y down, which viewers will show upside down).

    Raises:
        InputError: another suffix, or animations that do not fit together.
    """
    if path.suffix not in SUFFIXES:
        raise InputError(
            "Not a USD file name", where=str(path), expected=" or ".join(SUFFIXES), got=path.suffix
        )
    animations = of_equal_length(animation)
    first = animations[0]
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(first.fps)
    stage.SetFramesPerSecond(first.fps)
    stage.SetStartTimeCode(0)
    codes: list[float] = list(range(first.n_frames))
    if first.times is not None:
        codes = (first.times * first.fps).tolist()
    stage.SetEndTimeCode(codes[-1])

    if len(animations) == 1:
        place = f"/{Tf.MakeValidIdentifier(first.name)}"
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, place).GetPrim())
        texture = path.with_name(f"{path.stem}_texture.png")
        _add_mesh(stage, place, "mesh", first, codes, texture, keep_camera_frame)
    else:
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
        for one in animations:
            name = Tf.MakeValidIdentifier(one.name)
            UsdGeom.Xform.Define(stage, f"/scene/{name}")
            texture = path.with_name(f"{path.stem}_{name}_texture.png")
            # Importers call an object after its mesh.
            _add_mesh(stage, f"/scene/{name}", name, one, codes, texture, keep_camera_frame)
    with written_atomically(path) as temporary:
        stage.GetRootLayer().Export(str(temporary))
    return path


def _add_mesh(
    stage: Usd.Stage,
    place: str,
    name: str,
    animation: Animation,
    codes: Sequence[float],
    texture: Path,
    keep_camera_frame: bool,
) -> None:
    """Define mesh and material below a prim that exists; write the texture, if there is one."""
    mesh = UsdGeom.Mesh.Define(stage, f"{place}/{name}")
    polygons = animation.polygons()
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([polygons.shape[1]] * len(polygons)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(polygons.reshape(-1).astype(np.int32)))
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
    textured = write_texture(animation, texture)
    _bind_material(stage, mesh, f"{place}/material", f"./{texture.name}" if textured else None)


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
