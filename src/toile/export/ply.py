"""Stanford PLY, one binary file per frame, quads, texture coordinates per vertex."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toile.atomic_file import written_atomically
from toile.export.animation import ClothAnimation, remove_later_frames, write_texture


def export_ply(animation: ClothAnimation, folder: Path, *, keep_camera_frame: bool = False) -> list[Path]:
    """Write ``frame_0000.ply``, ... (binary, little endian, float64) and ``texture.png`` into ``folder``.

    Vertices keep the order i * W + j; faces are quads; texture coordinates are the properties s and t, t up.

    Args:
        animation: what to export.
        folder: where to; made if need be.
        keep_camera_frame: keep the OpenCV camera frame (y down) instead of y up.

    Returns:
        The PLY files in the order of the frames.
    """
    comments = ["comment metres, " + ("x right, y down, z forward" if keep_camera_frame else "y up")]
    if write_texture(animation, folder / "texture.png"):
        comments.append("comment TextureFile texture.png")
    uv, quads = animation.uv(v_up=True), animation.quads()
    names = ["x", "y", "z"] if uv is None else ["x", "y", "z", "s", "t"]
    n_vertices = animation.grid[0] * animation.grid[1]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *comments,
        f"element vertex {n_vertices}",
        *(f"property double {name}" for name in names),
        f"element face {len(quads)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    faces = np.zeros(len(quads), dtype=[("count", "u1"), ("index", "<i4", (4,))])
    faces["count"], faces["index"] = 4, quads

    paths = []
    for f, vertices in enumerate(animation.vertices(keep_camera_frame)):
        table = vertices if uv is None else np.concatenate((vertices, uv), axis=1)
        path = folder / f"frame_{f:04d}.ply"
        with written_atomically(path) as temporary:
            body = table.astype("<f8").tobytes() + faces.tobytes()
            temporary.write_bytes(("\n".join(header) + "\n").encode("ascii") + body)
        paths.append(path)
    remove_later_frames(folder, ".ply", len(paths))
    return paths
