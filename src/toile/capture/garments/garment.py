"""A garment: mesh at rest, where it is fixed to the body, what it is made of."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from toile.capture.arrays import read_arrays, write_arrays
from toile.errors import InputError
from toile.limits import NonNegative, Positive, Unit


@dataclass(frozen=True)
class Material:
    """What a garment is made of; the defaults are a light woven cotton.

    Attributes:
        young: Young's modulus of the membrane, that of the material times its thickness [N/m].
        poisson: Poisson's ratio.
        bending: bending rigidity [J].
        density: mass of an area [kg/m²].
        friction: Coulomb's coefficient between cloth and body.
    """

    young: Annotated[Positive, Unit("N/m")] = 500.0
    poisson: NonNegative = 0.3
    bending: Annotated[NonNegative, Unit("J")] = 1e-5
    density: Annotated[Positive, Unit("kg/m²")] = 0.15
    friction: NonNegative = 0.3


@dataclass(frozen=True)
class Garment:
    """A garment on a subject at rest, in the subject's frame.

    Attributes:
        rest_vertices: (N, 3), float64 [m]; shape without stress, worn by the subject at rest.
        faces: (Fg, 3), int64, normals away from the body.
        attached: (A,), int64; vertices that move with the body (waistband, straps).
        attached_faces: (A,), int64; the body's face each is fixed to.
        attached_barycentric: (A, 3), float64; where in that face, rows sum to 1.
        attached_offsets: (A, 3), float64 [m]; from there, in the face's frame (``face_frames``).
        material: what it is made of.
        name: what it is called in tables.
    """

    rest_vertices: Tensor
    faces: Tensor
    attached: Tensor
    attached_faces: Tensor
    attached_barycentric: Tensor
    attached_offsets: Tensor
    material: Material = field(default_factory=Material)
    name: str = "garment"

    def __post_init__(self) -> None:
        _check(self)

    def save(self, path: Path | str) -> Path:
        """Write an .npz, positions in float64; returns the path."""
        arrays = {name: getattr(self, name).numpy() for name in _ARRAYS}
        arrays |= {key: np.array(value) for key, value in asdict(self.material).items()}
        return write_arrays(path, {**arrays, "name": np.array(self.name)})

    @classmethod
    def load(cls, path: Path | str) -> Garment:
        """Read what ``save`` wrote.

        Raises:
            InputError: the file is missing, no garment, or its arrays do not fit together.
        """
        materials = tuple(asdict(Material()))
        arrays = read_arrays(path, "Garment", (*_ARRAYS, *materials, "name"))
        try:
            return cls(
                **{
                    name: torch.from_numpy(
                        arrays[name].astype(np.float64 if arrays[name].dtype.kind == "f" else np.int64)
                    )
                    for name in _ARRAYS
                },
                material=Material(**{key: float(arrays[key]) for key in materials}),
                name=str(arrays["name"]),
            )
        except InputError as error:
            raise InputError(
                error.what, where=f"{path}: {error.where}", expected=error.expected, got=error.got
            ) from error


_ARRAYS = (
    "rest_vertices",
    "faces",
    "attached",
    "attached_faces",
    "attached_barycentric",
    "attached_offsets",
)


def face_frames(vertices: Tensor, faces: Tensor) -> Tensor:
    """Orthonormal frame of each face: first edge, across it in the face, normal, as columns.

    Args:
        vertices: (..., V, 3).
        faces: (T, 3).

    Returns:
        (..., T, 3, 3).
    """
    a, b, c = (vertices[..., faces[:, corner], :] for corner in range(3))
    along = torch.nn.functional.normalize(b - a, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return torch.stack((along, torch.linalg.cross(normal, along), normal), -1)


def attached_targets(garment: Garment, body_vertices: Tensor, body_faces: Tensor) -> Tensor:
    """Where the attached vertices are when the body is posed.

    Args:
        garment: whose attachment.
        body_vertices: (..., V, 3) [m].
        body_faces: (Fb, 3) of the subject.

    Returns:
        (..., A, 3) [m].

    Raises:
        InputError: the garment is attached to faces that the body does not have.
    """
    if len(garment.attached) and int(garment.attached_faces.max()) >= len(body_faces):
        raise InputError(
            "Garment belongs to another subject",
            where=f"garment {garment.name}",
            expected=f"attached faces below {len(body_faces)}",
            got=str(int(garment.attached_faces.max())),
        )
    faces = body_faces[garment.attached_faces]
    points = (body_vertices[..., faces, :] * garment.attached_barycentric[..., None]).sum(-2)
    offsets = face_frames(body_vertices, faces) @ garment.attached_offsets[..., None]
    return points + offsets[..., 0]


def _check(garment: Garment) -> None:
    n, a = len(garment.rest_vertices), len(garment.attached)
    for name, shape in (
        ("rest_vertices", (n, 3)),
        ("faces", (len(garment.faces), 3)),
        ("attached", (a,)),
        ("attached_faces", (a,)),
        ("attached_barycentric", (a, 3)),
        ("attached_offsets", (a, 3)),
    ):
        got = tuple(getattr(garment, name).shape)
        if got != shape:
            raise InputError(
                "Garment has an array of the wrong shape", where=name, expected=str(shape), got=str(got)
            )
    for name, indices in (("faces", garment.faces), ("attached", garment.attached)):
        if indices.numel() and not (int(indices.min()) >= 0 and int(indices.max()) < n):
            raise InputError(
                "Garment has an index out of range",
                where=name,
                expected=f"0 to {n - 1}",
                got=f"{int(indices.min())} to {int(indices.max())}",
            )
    if not bool(torch.isfinite(garment.rest_vertices).all()):
        raise InputError(
            "Garment has positions that are not finite",
            where="rest_vertices",
            expected="finite numbers",
            got="nan or inf",
        )
