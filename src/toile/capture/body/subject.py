"""A person: mesh at rest, skeleton, skinning weights, landmarks, named parts, limits of the joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from toile.capture.arrays import read_arrays, write_arrays
from toile.errors import InputError

SHIPPED = Path(__file__).parent / "subjects"
"""Subjects that come with the package."""

INFLUENCES = 9
"""Joints that can move one vertex."""


@dataclass(frozen=True)
class Subject:
    """A skinned person at rest. World frame: right-handed, y up, floor at y = 0, facing +z; metres.

    Attributes:
        rest_vertices: (V, 3), float64 [m].
        faces: (Fb, 3), int64, outward normals.
        joint_names: J names.
        parents: (J,), int64; parents before children, −1 for the root, which is joint 0.
        rest_joints: (J, 4, 4), float64; pose of each joint's frame in the world, at rest.
        skinning_indices: (V, 9), int64; joints that move a vertex.
        skinning_weights: (V, 9), float64; non-negative, each row sums to 1.
        landmark_names: L names, those of COCO's 17 key points for the shipped subject.
        landmark_indices: (L, k), int64; vertices a landmark is a mean of.
        landmark_weights: (L, k), float64; each row sums to 1.
        parts: named masks of the vertices, bool (V,), at least "arms".
        joint_limits: (J, 3, 2), float64 [rad]; least and largest angle about the world's x, z and y at rest
            (flexion, abduction, twist; ``toile.capture.body.limits``), infinite where there is none.
    """

    rest_vertices: Tensor
    faces: Tensor
    joint_names: tuple[str, ...]
    parents: Tensor
    rest_joints: Tensor
    skinning_indices: Tensor
    skinning_weights: Tensor
    landmark_names: tuple[str, ...]
    landmark_indices: Tensor
    landmark_weights: Tensor
    parts: Mapping[str, Tensor] = field(default_factory=dict)
    joint_limits: Tensor = field(default_factory=lambda: torch.empty(0))

    def __post_init__(self) -> None:
        if not self.joint_limits.numel():
            unlimited = torch.tensor([-torch.inf, torch.inf], dtype=torch.float64)
            object.__setattr__(self, "joint_limits", unlimited.repeat(len(self.joint_names), 3, 1))
        if "arms" not in self.parts:
            none = torch.zeros(len(self.rest_vertices), dtype=torch.bool)
            object.__setattr__(self, "parts", {**self.parts, "arms": none})
        _check(self)

    def save(self, path: Path | str) -> Path:
        """Write an .npz of at most a few megabytes; returns the path.

        Positions, weights and transforms are stored in float32 (a rest vertex moves by less than 0.1 µm),
        indices in the smallest type that holds them.
        """
        arrays = {
            "rest_vertices": self.rest_vertices.numpy().astype(np.float32),
            "faces": _smallest(self.faces),
            "joint_names": np.array(self.joint_names),
            "parents": self.parents.numpy().astype(np.int16),
            "rest_joints": self.rest_joints.numpy().astype(np.float32),
            "skinning_indices": _smallest(self.skinning_indices),
            "skinning_weights": self.skinning_weights.numpy().astype(np.float32),
            "landmark_names": np.array(self.landmark_names, dtype=np.str_),
            "landmark_indices": _smallest(self.landmark_indices),
            "landmark_weights": self.landmark_weights.numpy().astype(np.float32),
            "part_names": np.array(list(self.parts), dtype=np.str_),
            "part_masks": np.packbits(torch.stack(list(self.parts.values())).numpy(), axis=1),
            "joint_limits": self.joint_limits.numpy(),
        }
        return write_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path | str) -> Subject:
        """Read what ``save`` wrote.

        Raises:
            InputError: the file is missing, no subject, or its arrays do not fit together.
        """
        arrays = read_arrays(path, "Subject", _STORED)
        floats = {
            name: torch.from_numpy(array.astype(np.float64))
            for name, array in arrays.items()
            if array.dtype.kind == "f"
        }
        indices = {
            name: torch.from_numpy(array.astype(np.int64))
            for name, array in arrays.items()
            if array.dtype.kind in "iu" and name != "part_masks"
        }
        count = len(arrays["rest_vertices"])
        masks = np.unpackbits(arrays["part_masks"], axis=1, count=count).astype(bool)
        names = [str(name) for name in arrays["part_names"]]
        try:
            return cls(
                rest_vertices=floats["rest_vertices"],
                faces=indices["faces"],
                joint_names=tuple(map(str, arrays["joint_names"])),
                parents=indices["parents"],
                rest_joints=_rigid(floats["rest_joints"]),
                skinning_indices=indices["skinning_indices"],
                skinning_weights=_normalised(floats["skinning_weights"]),
                landmark_names=tuple(map(str, arrays["landmark_names"])),
                landmark_indices=indices["landmark_indices"],
                landmark_weights=_normalised(floats["landmark_weights"]),
                parts={name: torch.from_numpy(mask) for name, mask in zip(names, masks, strict=True)},
                joint_limits=floats["joint_limits"],
            )
        except InputError as error:
            raise InputError(
                error.what, where=f"{path}: {error.where}", expected=error.expected, got=error.got
            ) from error

    def landmarks(self, vertices: Tensor) -> Tensor:
        """Landmarks of posed vertices: (..., V, 3) -> (..., L, 3)."""
        chosen = vertices[..., self.landmark_indices, :]
        return (chosen * self.landmark_weights[..., None].to(vertices.dtype)).sum(-2)

    def faces_without(self, *parts: str) -> Tensor:
        """Faces none of whose corners lies in the named parts; (F', 3), e.g. ``faces_without("arms")``.

        Raises:
            InputError: no such part.
        """
        dropped = torch.zeros(len(self.rest_vertices), dtype=torch.bool)
        for part in parts:
            if part not in self.parts:
                raise InputError(
                    "No such part of the subject", where="part", expected=", ".join(self.parts), got=part
                )
            dropped |= self.parts[part]
        return self.faces[~dropped[self.faces].any(1)]

    @property
    def height(self) -> float:
        """From the floor to the top of the head at rest [m]."""
        return float(self.rest_vertices[:, 1].max() - self.rest_vertices[:, 1].min())


_STORED = (
    "rest_vertices",
    "faces",
    "joint_names",
    "parents",
    "rest_joints",
    "skinning_indices",
    "skinning_weights",
    "landmark_names",
    "landmark_indices",
    "landmark_weights",
    "part_names",
    "part_masks",
    "joint_limits",
)


def load_subject(name: str | Path = "default") -> Subject:
    """A subject that comes with the package by its name, or one from a file.

    Raises:
        InputError: neither.
    """
    shipped = SHIPPED / f"{name}.npz"
    if shipped.is_file():
        return Subject.load(shipped)
    if Path(name).suffix == ".npz":
        return Subject.load(name)
    raise InputError(
        "No such subject",
        where="subject",
        expected=f"{', '.join(sorted(p.stem for p in SHIPPED.glob('*.npz')))} or a file .npz",
        got=str(name),
    )


def _smallest(indices: Tensor) -> np.ndarray:
    array = indices.numpy()
    return array.astype(np.min_scalar_type(int(array.max(initial=0))))


def _normalised(weights: Tensor) -> Tensor:
    """Rows that sum to one again after storage in float32; a row of zeros stays one."""
    total = weights.sum(-1, keepdim=True)
    return torch.where(total > 0, weights / total, weights)


def _rigid(transforms: Tensor) -> Tensor:
    """Rotations made orthogonal again after storage in float32."""
    result = transforms.clone()
    if transforms.ndim == 3 and transforms.shape[1:] == (4, 4):
        u, _, v = torch.linalg.svd(transforms[:, :3, :3])
        result[:, :3, :3] = u @ v
    return result


def _check(subject: Subject) -> None:
    """Raise InputError unless everything fits together."""
    v, j = len(subject.rest_vertices), len(subject.joint_names)

    def wrong(what: str, where: str, expected: str, got: str) -> InputError:
        return InputError(what, where=where, expected=expected, got=got)

    for name, shape in (
        ("rest_vertices", (v, 3)),
        ("faces", (len(subject.faces), 3)),
        ("parents", (j,)),
        ("rest_joints", (j, 4, 4)),
        ("skinning_indices", (v, INFLUENCES)),
        ("skinning_weights", (v, INFLUENCES)),
        ("joint_limits", (j, 3, 2)),
    ):
        of = tuple(getattr(subject, name).shape)
        if of != shape:
            raise wrong("Subject has an array of the wrong shape", name, str(shape), str(of))
    if not bool(torch.isfinite(subject.rest_vertices).all()):
        raise wrong(
            "Subject has positions that are not finite", "rest_vertices", "finite numbers", "nan or inf"
        )
    for name, indices, upper in (
        ("faces", subject.faces, v),
        ("skinning_indices", subject.skinning_indices, j),
        ("landmark_indices", subject.landmark_indices, v),
    ):
        if indices.numel() and not (int(indices.min()) >= 0 and int(indices.max()) < upper):
            got = f"{int(indices.min())} to {int(indices.max())}"
            raise wrong("Subject has an index out of range", name, f"0 to {upper - 1}", got)
    weights = subject.skinning_weights
    unmoved = (weights.sum(1) == 0).nonzero().ravel()
    if len(unmoved):
        got = f"{len(unmoved)} of {v} without, the first is vertex {int(unmoved[0])}"
        raise wrong(
            "Subject has vertices that no joint moves", "skinning_weights", "weights at every vertex", got
        )
    if float(weights.min()) < 0 or float((weights.sum(1) - 1).abs().max()) > 1e-4:
        low, high = float(weights.sum(1).min()), float(weights.sum(1).max())
        got = f"least weight {float(weights.min()):g}, sums {low:g} to {high:g}"
        raise wrong("Skinning weights are no weights", "skinning_weights", "non-negative, rows sum to 1", got)
    if int(subject.parents[0]) != -1 or any(
        not 0 <= int(parent) < child for child, parent in enumerate(subject.parents[1:], start=1)
    ):
        raise wrong(
            "Joints are not in the order of a tree",
            "parents",
            "-1 for joint 0, and of every other joint one before it",
            str(subject.parents.tolist())[:80],
        )
    for name, mask in subject.parts.items():
        if mask.shape != (v,) or mask.dtype != torch.bool:
            raise wrong(
                "A part is no mask of the vertices", f"parts[{name}]", f"bool ({v},)", str(mask.shape)
            )
