"""Reading and writing meshes and point clouds, with the vertex order of the file preserved.

OBJ files are read and written here rather than by trimesh. Measured with trimesh 5.2 on the φ-SfT quad
templates with ``v``, ``vt`` and ``vn`` (``process=False, maintain_order=True``): the vertex order survives,
but quads are split into triangles, the texture coordinates are dropped (eight of nine templates) and numpy
warns about all-NaN slices. A cloth template needs all of it, so a small reader for the polygon subset of
OBJ lives below. Every other format goes through trimesh, always with ``process=False,
maintain_order=True``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toile.errors import InputError


@dataclass(frozen=True)
class PolygonMesh:
    """A polygon mesh in the order of its file.

    Attributes:
        vertices: positions (V, 3), float64, in the units and axes of the file.
        polygons: vertex indices (zero-based) of each face, any number of corners >= 3.
        texture_coordinates: (V, 2), float64, as stored in the file (no flip), NaN for a vertex that no face
            gives one; None if the file has none at all.
        seam_vertices: vertices to which different faces give different texture coordinates (the first one
            met is the one stored).
    """

    vertices: Tensor
    polygons: tuple[tuple[int, ...], ...]
    texture_coordinates: Tensor | None = None
    seam_vertices: tuple[int, ...] = ()


def read_mesh(path: Path | str) -> PolygonMesh:
    """Read a mesh; OBJ with polygons and texture coordinates, other formats (PLY, STL, OFF, GLB) by trimesh.

    Raises:
        InputError: the file is missing, is no mesh or holds an index out of range.
    """
    path = Path(path)
    _require_file(path, "a mesh file")
    if path.suffix.lower() == ".obj":
        return _read_obj(path)
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False, maintain_order=True)
    except Exception as error:
        raise InputError(
            "Mesh cannot be read", where=str(path), expected="a mesh file trimesh can read", got=str(error)
        ) from error
    uv = getattr(mesh.visual, "uv", None)
    return PolygonMesh(
        vertices=torch.from_numpy(np.array(mesh.vertices, dtype=np.float64)),
        polygons=tuple(tuple(int(k) for k in face) for face in mesh.faces),
        texture_coordinates=None if uv is None else torch.from_numpy(np.array(uv, dtype=np.float64)),
    )


def write_mesh(
    path: Path | str,
    vertices: Tensor,
    polygons: Iterable[Sequence[int]],
    texture_coordinates: Tensor | None = None,
) -> None:
    """Write a mesh; OBJ losslessly (shortest decimal that reads back the same), other formats by trimesh.

    Args:
        path: target; the suffix chooses the format.
        vertices: (V, 3).
        polygons: zero-based vertex indices per face; formats other than OBJ take triangles only.
        texture_coordinates: (V, 2) or None; written as they are, OBJ only.

    Raises:
        InputError: a face with other than three corners for a format that takes triangles only.
    """
    path = Path(path)
    faces = [tuple(int(k) for k in face) for face in polygons]
    if path.suffix.lower() == ".obj":
        lines = [f"v {_decimal(p)}" for p in vertices.detach().cpu().numpy()]
        if texture_coordinates is not None:
            lines += [f"vt {_decimal(p)}" for p in texture_coordinates.detach().cpu().numpy()]
        for face in faces:
            corners = (f"{k + 1}" if texture_coordinates is None else f"{k + 1}/{k + 1}" for k in face)
            lines.append("f " + " ".join(corners))
        path.write_text("\n".join(lines) + "\n")
        return
    other = next((face for face in faces if len(face) != 3), None)
    if other is not None:
        raise InputError(
            "Only OBJ takes faces with more than three corners",
            where=str(path),
            expected="triangles, or a file name ending in .obj",
            got=f"a face with {len(other)} corners",
        )
    import trimesh

    mesh = trimesh.Trimesh(vertices.detach().cpu().numpy(), np.array(faces), process=False)
    mesh.export(path)


def read_point_cloud(path: Path | str) -> Tensor:
    """Read a point cloud (N, 3), float32, from .pt (a tensor), .npy, .obj (vertices) or a format of trimesh.

    Tensors are read with ``weights_only=True``, arrays without pickle, so no code in the file can run.

    Raises:
        InputError: the file is missing, unreadable or holds something other than (N, 3) numbers.
    """
    path = Path(path)
    _require_file(path, "a point cloud (.pt, .npy, .ply, .xyz)")
    try:
        points = _READERS.get(path.suffix.lower(), _read_points_by_trimesh)(path)
    except Exception as error:
        raise InputError(
            "Point cloud cannot be read",
            where=str(path),
            expected="a tensor (.pt), an array (.npy) or a file trimesh can read",
            got=f"{type(error).__name__}: {error}",
        ) from error
    if not isinstance(points, Tensor) or points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        got = f"shape {tuple(points.shape)}" if isinstance(points, Tensor) else type(points).__name__
        raise InputError(
            "Point cloud has the wrong shape", where=str(path), expected="(N, 3) with N > 0", got=got
        )
    return points.to(torch.float32)


def write_point_cloud(path: Path | str, points: Tensor) -> None:
    """Write a point cloud (N, 3) to .pt, .npy, or a format of trimesh (.ply, .xyz), in the given order."""
    path = Path(path)
    points = points.detach().cpu()
    if path.suffix.lower() == ".pt":
        torch.save(points.clone(), path)
    elif path.suffix.lower() == ".npy":
        np.save(path, points.numpy())
    else:
        import trimesh

        trimesh.PointCloud(points.numpy()).export(path)


def _require_file(path: Path, expected: str) -> None:
    if not path.is_file():
        there = sorted(p.name for p in path.parent.iterdir())[:12] if path.parent.is_dir() else None
        got = (
            "no such folder"
            if there is None
            else f"no such file; the folder holds {', '.join(there) or 'nothing'}"
        )
        raise InputError(f"File {path.name} is missing", where=str(path), expected=expected, got=got)


def _read_points_by_tensor(path: Path) -> Tensor:
    return torch.load(path, map_location="cpu", weights_only=True)


def _read_points_by_array(path: Path) -> Tensor:
    return torch.from_numpy(np.load(path, allow_pickle=False))


def _read_points_by_trimesh(path: Path) -> Tensor:
    import trimesh

    vertices = getattr(trimesh.load(path, process=False, maintain_order=True), "vertices")  # noqa: B009
    return torch.from_numpy(np.array(vertices, dtype=np.float32))


def _read_points_by_mesh(path: Path) -> Tensor:
    return read_mesh(path).vertices


_READERS = {".pt": _read_points_by_tensor, ".npy": _read_points_by_array, ".obj": _read_points_by_mesh}


def _decimal(values: np.ndarray) -> str:
    return " ".join(str(v) for v in values)


def _read_obj(path: Path) -> PolygonMesh:
    """Read ``v``, ``vt`` and ``f`` lines of an OBJ file; everything else is ignored.

    Corners may be ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``, indices one-based or negative (counted back from
    the last one read), a backslash continues a line. Colours behind the three coordinates are ignored.
    """
    vertices: list[tuple[float, ...]] = []
    coordinates: list[tuple[float, ...]] = []
    polygons: list[tuple[int, ...]] = []
    texture_of: dict[int, int] = {}
    seams: set[int] = set()
    text = path.read_text(errors="replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), start=1):
        keyword, *values = line.split("#", 1)[0].split() or [""]
        try:
            if keyword == "v":
                vertices.append(_floats(values, 3))
            elif keyword == "vt":
                coordinates.append(_floats(values, 2))
            elif keyword == "f":
                corners = [value.split("/") for value in values]
                face = tuple(_index(corner[0], len(vertices)) for corner in corners)
                if len(face) < 3:
                    raise ValueError(f"a face with {len(face)} corners")
                polygons.append(face)
                for vertex, corner in zip(face, corners, strict=True):
                    if len(corner) > 1 and corner[1]:
                        coordinate = _index(corner[1], len(coordinates))
                        first = texture_of.setdefault(vertex, coordinate)
                        if coordinates[first] != coordinates[coordinate]:
                            seams.add(vertex)
        except ValueError as error:
            raise InputError(
                "OBJ line cannot be read",
                where=f"{path}, line {number}",
                expected="'v x y z', 'vt u v' or 'f a/ta b/tb c/tc ...' with indices of lines above",
                got=f"{line.strip()[:80]!r} ({error})",
            ) from error
    if not vertices:
        raise InputError(
            "Mesh is empty", where=str(path), expected="an OBJ file with 'v' lines", got="no vertex"
        )
    uv = None
    if texture_of:
        uv = torch.full((len(vertices), 2), torch.nan, dtype=torch.float64)
        index = torch.tensor(sorted(texture_of.items()))
        uv[index[:, 0]] = torch.tensor(coordinates, dtype=torch.float64)[index[:, 1]]
    return PolygonMesh(torch.tensor(vertices, dtype=torch.float64), tuple(polygons), uv, tuple(sorted(seams)))


def _floats(values: Sequence[str], n: int) -> tuple[float, ...]:
    if len(values) < n:
        raise ValueError(f"{len(values)} numbers where {n} are needed")
    return tuple(float(value) for value in values[:n])


def _index(text: str, n: int) -> int:
    """Zero-based index from OBJ's one-based or negative one, checked against the ``n`` items read so far."""
    k = int(text)
    index = k - 1 if k > 0 else n + k
    if k == 0 or not 0 <= index < n:
        raise ValueError(f"index {k} with {n} items above")
    return index
