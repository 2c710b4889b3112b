"""A garment from a triangle mesh of the user's own."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from scipy.spatial import cKDTree

from toile.capture.body.subject import Subject
from toile.capture.garments.checks import check_garment
from toile.capture.garments.embedding import embed
from toile.capture.garments.garment import Garment, Material
from toile.errors import InputError
from toile.geometry.io import read_mesh
from toile.geometry.surface import TriangleMesh, nearest_points, triangle_mesh
from toile.limits import CountOrZero, NonNegative, Positive, Unit
from toile.scenes.findings import require


@dataclass(frozen=True)
class OwnMesh:
    """A mesh file with a garment as the subject wears it at rest.

    Attributes:
        file: OBJ, PLY, STL, OFF or GLB; polygons are cut into triangles.
        scale: metres for each unit of the file, e.g. 0.01 for centimetres.
        attached: vertices of the file that are fixed to the body; None for those of the band.
        band: height below the uppermost vertex within which vertices are fixed to the body; 0 fixes none.
        material: what it is made of.
    """

    file: str
    scale: Positive = 1.0
    attached: tuple[CountOrZero, ...] | None = None
    band: Annotated[NonNegative, Unit("m")] = 0.02
    material: Material = field(default_factory=Material)

    def make(self, subject: Subject) -> Garment:
        """Read, check and fix it to a subject.

        Raises:
            InputError: no mesh, or an error of ``check_garment``.
        """
        garment = own_garment(subject, self.file, self.scale, self.attached, self.band, self.material)
        require(check_garment(garment, subject, self.file))
        return garment


def own_garment(
    subject: Subject,
    file: Path | str,
    scale: float = 1.0,
    attached: tuple[int, ...] | None = None,
    band: float = 0.02,
    material: Material | None = None,
) -> Garment:
    """Read a garment; normals are turned away from the body, nothing is checked.

    Args:
        subject: who wears it.
        file: mesh in the subject's frame at rest.
        scale: metres for each unit of the file.
        attached: vertices of the file fixed to the body; None for those within ``band`` of the top.
        band: see ``attached`` [m].
        material: what it is made of; None for light woven cotton.

    Raises:
        InputError: no mesh, or an attached vertex that it does not have.
    """
    polygons = read_mesh(file)
    if attached is not None and not all(0 <= vertex < len(polygons.vertices) for vertex in attached):
        raise InputError(
            "Garment has no such vertex",
            where=f"{file}: attached",
            expected=f"0 to {len(polygons.vertices) - 1}",
            got=f"{min(attached)} to {max(attached)}",
        )
    mesh = _in_order_of_file(polygons.vertices.numpy(), triangle_mesh(polygons, str(file)))
    vertices, faces = scale * mesh.vertices, _outward(subject, scale * mesh.vertices, mesh.faces)
    if attached is None:
        held = np.flatnonzero(vertices[:, 1] >= vertices[:, 1].max() - band) if band > 0 else np.empty(0, int)
    else:
        # Coincident vertices are joined: those of the file are found again by where they are.
        wanted = scale * polygons.vertices.numpy()[list(attached)]
        distance = np.linalg.norm(wanted[:, None] - vertices[None], axis=2)
        held = np.unique(distance.argmin(1)) if len(attached) else np.empty(0, int)
    at, points = torch.from_numpy(held.astype(np.int64)), torch.from_numpy(vertices)
    usable = ~subject.parts["arms"][subject.faces].any(1)
    fixed = embed(points[at], subject.rest_vertices, subject.faces, usable)
    return Garment(
        rest_vertices=points,
        faces=torch.from_numpy(faces),
        attached=at,
        attached_faces=fixed.faces,
        attached_barycentric=fixed.barycentric,
        attached_offsets=fixed.offsets,
        material=material or Material(),
        name=Path(file).stem,
    )


def _in_order_of_file(stored: np.ndarray, mesh: TriangleMesh) -> TriangleMesh:
    """The same mesh with its vertices in the order in which the file has them first."""
    _, first = cKDTree(stored).query(mesh.vertices)
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return TriangleMesh(mesh.vertices[order], rank[mesh.faces])


def _outward(subject: Subject, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces with their normals away from the body, on the whole."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centre = corners.mean(1)
    nearest, _ = nearest_points(centre, subject.rest_vertices.numpy(), subject.faces.numpy())
    away = ((centre - nearest.of(subject.rest_vertices.numpy())) * normal).sum()
    return np.ascontiguousarray(faces[:, ::-1]) if away < 0 else faces
