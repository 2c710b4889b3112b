"""The list of export formats, for the command line; each exporter is imported only when it is used."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toile.errors import InputError
from toile.export.animation import Animation, ClothAnimation

FORMATS = ("obj", "ply", "glb", "usd")
SCENE_FORMATS = ("glb", "usd")
"""Formats that hold several animated meshes in one file."""


def export_animation(
    animation: ClothAnimation, folder: Path, format: str, *, keep_camera_frame: bool = False
) -> list[Path]:
    """Export into ``folder``: sequences ``obj/`` and ``ply/``, or single files ``cloth.glb``, ``cloth.usdc``.

    Raises:
        InputError: an unknown format.
    """
    match format:
        case "obj":
            from toile.export.obj import export_obj

            return export_obj(animation, folder / "obj", keep_camera_frame=keep_camera_frame)
        case "ply":
            from toile.export.ply import export_ply

            return export_ply(animation, folder / "ply", keep_camera_frame=keep_camera_frame)
        case "glb":
            from toile.export.gltf import export_gltf

            return [export_gltf(animation, folder / "cloth.glb", keep_camera_frame=keep_camera_frame)]
        case "usd":
            from toile.export.usd import export_usd

            return [export_usd(animation, folder / "cloth.usdc", keep_camera_frame=keep_camera_frame)]
    raise InputError("Unknown export format", where="format", expected=", ".join(FORMATS), got=format)


def export_meshes(animations: Sequence[Animation], folder: Path, format: str) -> Path:
    """Export several meshes of the same frames into one file, ``motion.glb`` or ``motion.usdc``.

    Raises:
        InputError: a format that holds one mesh alone, or meshes that do not fit together.
    """
    match format:
        case "glb":
            from toile.export.gltf import export_gltf

            return export_gltf(animations, folder / "motion.glb")
        case "usd":
            from toile.export.usd import export_usd

            return export_usd(animations, folder / "motion.usdc")
    expected = ", ".join(SCENE_FORMATS)
    raise InputError("Not a format of several meshes", where="format", expected=expected, got=format)
