"""Wavefront OBJ, one file per frame, quads, with a shared material and texture."""

from __future__ import annotations

from pathlib import Path

from toile.atomic_file import write_text
from toile.export.animation import ClothAnimation, remove_later_frames, write_texture


def export_obj(animation: ClothAnimation, folder: Path, *, keep_camera_frame: bool = False) -> list[Path]:
    """Write ``frame_0000.obj``, ... and, with a texture, ``cloth.mtl`` and ``texture.png`` into ``folder``.

    Vertices keep the order i * W + j and nine significant digits; faces are quads; v points up.

    Args:
        animation: what to export.
        folder: where to; made if need be.
        keep_camera_frame: keep the OpenCV camera frame (y down) instead of y up.

    Returns:
        The OBJ files in the order of the frames.
    """
    textured = write_texture(animation, folder / "texture.png")
    if textured:
        write_text(folder / "cloth.mtl", "newmtl cloth\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd texture.png\n")
    uv = animation.uv(v_up=True)
    head = [f"o {animation.name}"]
    tail = []
    if uv is not None:
        tail += [f"vt {u:.9g} {v:.9g}" for u, v in uv]
    if textured:
        head.insert(0, "mtllib cloth.mtl")
        tail.append("usemtl cloth")
    for quad in animation.quads() + 1:
        tail.append("f " + " ".join(f"{k}/{k}" if uv is not None else f"{k}" for k in quad))

    paths = []
    for f, vertices in enumerate(animation.vertices(keep_camera_frame)):
        lines = [*head, *(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices), *tail]
        paths.append(write_text(folder / f"frame_{f:04d}.obj", "\n".join(lines) + "\n"))
    remove_later_frames(folder, ".obj", len(paths))
    return paths
