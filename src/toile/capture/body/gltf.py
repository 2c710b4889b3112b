"""A subject from any skinned glTF file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from toile.capture.body.bake import body_parts, most_influential
from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.limits import human_limits
from toile.capture.body.subject import Subject
from toile.capture.gltf_file import Floats, GltfFile, read_gltf, world_transforms
from toile.errors import InputError

LANDMARKS = {
    "left_shoulder": "left_upper_arm",
    "right_shoulder": "right_upper_arm",
    "left_elbow": "left_lower_arm",
    "right_elbow": "right_lower_arm",
    "left_wrist": "left_hand",
    "right_wrist": "right_hand",
    "left_hip": "left_upper_leg",
    "right_hip": "right_upper_leg",
    "left_knee": "left_lower_leg",
    "right_knee": "right_lower_leg",
    "left_ankle": "left_foot",
    "right_ankle": "right_foot",
}
"""COCO's key points that are joints, and the roles of these."""


@dataclass(frozen=True)
class GltfBody:
    """A person in a skinned glTF file.

    Attributes:
        file: .glb or .gltf, y up, metres, facing +z.
    """

    file: str

    def make(self) -> Subject:
        """Read it; see ``subject_from_gltf``."""
        return subject_from_gltf(self.file)


# Vertices a landmark is made of at most, and how close a joint has to be to their hull.
_LANDMARK_VERTICES = 64


def subject_from_gltf(file: Path | str) -> Subject:
    """Read the skinned meshes of a glTF file, posed as its nodes are, feet moved to the floor.

    Args:
        file: .glb or .gltf with one skeleton; y up, metres, facing +z, as glTF prescribes.

    Raises:
        InputError: no skin, several skeletons, no weights, or a mesh that is none.
    """
    gltf = read_gltf(file)
    where = str(file)
    skinned = [node for node in gltf.items("nodes") if "skin" in node and "mesh" in node]
    if not skinned:
        raise InputError(
            "glTF file has no skinned mesh",
            where=where,
            expected="a mesh with a skin: joints and weights",
            got=f"{len(gltf.items('meshes'))} meshes, {len(gltf.items('skins'))} skins",
        )
    skins = {node["skin"] for node in skinned}
    if len(skins) > 1:
        raise InputError(
            "glTF file has several skeletons", where=where, expected="one skin", got=f"{len(skins)} skins"
        )
    skin = gltf.items("skins")[skins.pop()]
    world = world_transforms(gltf.node_transforms(), gltf.parents())
    nodes, parents = _tree(gltf, list(skin["joints"]), where)
    joints = world[nodes]
    inverse = np.tile(np.eye(4), (len(nodes), 1, 1))
    if "inverseBindMatrices" in skin:
        stored = gltf.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        inverse = stored[[skin["joints"].index(node) for node in nodes]].astype(np.float64)
    position = {node: k for k, node in enumerate(nodes)}
    order = np.array([position[node] for node in skin["joints"]])
    vertices, faces, indices, weights = _welded(*_meshes(gltf, skinned, order, where))
    dense = np.zeros((len(vertices), len(nodes)))
    np.add.at(dense, (np.arange(len(vertices))[:, None], indices), weights)
    if (dense.sum(1) <= 0).any():
        bad = np.flatnonzero(dense.sum(1) <= 0)
        raise InputError(
            "Subject has vertices that no joint moves",
            where=where,
            expected="weights at every vertex",
            got=f"{len(bad)} of {len(vertices)} without, the first is vertex {int(bad[0])}",
        )
    dense /= dense.sum(1, keepdims=True)
    blended = np.einsum("vj,jab->vab", dense, joints @ inverse)
    vertices = np.einsum("vab,vb->va", blended[:, :3, :3], vertices) + blended[:, :3, 3]
    rest = _rigid(joints)
    origin = np.array([rest[0, 0, 3], vertices[:, 1].min(), rest[0, 2, 3]])
    vertices, rest[:, :3, 3] = vertices - origin, rest[:, :3, 3] - origin
    names = tuple(gltf.items("nodes")[node].get("name", f"joint_{node}") for node in nodes)
    tree = torch.tensor(parents, dtype=torch.int64)
    kept, values = most_influential(
        torch.arange(len(nodes)).expand(len(vertices), -1), torch.from_numpy(dense)
    )
    points = torch.from_numpy(vertices)
    landmarks = _landmarks(points, torch.from_numpy(rest[:, :3, 3]), names)
    return Subject(
        rest_vertices=points,
        faces=torch.from_numpy(faces),
        joint_names=names,
        parents=tree,
        rest_joints=torch.from_numpy(rest),
        skinning_indices=kept,
        skinning_weights=values,
        landmark_names=landmarks[0],
        landmark_indices=landmarks[1],
        landmark_weights=landmarks[2],
        parts=body_parts(names, tree, kept, values),
        joint_limits=human_limits(names),
    )


def _tree(gltf: GltfFile, joints: list[int], where: str) -> tuple[list[int], list[int]]:
    """Joints with parents before children, and the parents' places among them."""
    above = gltf.parents()

    def parent(node: int) -> int:
        node = above[node]
        while node >= 0 and node not in joints:
            node = above[node]
        return node

    of = {node: parent(node) for node in joints}
    roots = [node for node in joints if of[node] < 0]
    if len(roots) != 1:
        raise InputError(
            "Skeleton has no single root",
            where=where,
            expected="one joint above all others",
            got=f"{len(roots)}: "
            + ", ".join(str(gltf.items("nodes")[node].get("name", node)) for node in roots[:5]),
        )
    order = list(roots)
    for node in order:
        order += [child for child in joints if of[child] == node]
    return order, [-1, *(order.index(of[node]) for node in order[1:])]


def _meshes(
    gltf: GltfFile, skinned: list[dict[str, object]], order: np.ndarray, where: str
) -> tuple[Floats, np.ndarray, np.ndarray, Floats]:
    """Vertices, faces, joints of each vertex, weights of these, of all skinned meshes together."""
    parts: list[tuple[Floats, np.ndarray, np.ndarray, Floats]] = []
    first = 0
    for node in skinned:
        for primitive in gltf.items("meshes")[int(str(node["mesh"]))]["primitives"]:
            attributes = primitive["attributes"]
            if primitive.get("mode", 4) != 4:
                continue
            sets = [k for k in range(8) if f"JOINTS_{k}" in attributes and f"WEIGHTS_{k}" in attributes]
            if not sets:
                raise InputError(
                    "Subject has no skinning weights",
                    where=where,
                    expected="JOINTS_0 and WEIGHTS_0 at every mesh of the skin",
                    got=", ".join(sorted(attributes)),
                )
            points = gltf.array(attributes["POSITION"]).astype(np.float64)
            if "indices" in primitive:
                faces = gltf.array(primitive["indices"]).astype(np.int64).reshape(-1, 3)
            else:
                faces = np.arange(len(points)).reshape(-1, 3)
            indices = np.concatenate([gltf.array(attributes[f"JOINTS_{k}"]) for k in sets], 1)
            weights = np.concatenate([gltf.array(attributes[f"WEIGHTS_{k}"]) for k in sets], 1)
            parts.append((points, faces + first, order[indices.astype(np.int64)], weights.astype(np.float64)))
            first += len(points)
    width = max((part[2].shape[1] for part in parts), default=0)
    if not width:
        raise InputError("Subject has no triangles", where=where, expected="triangle meshes", got="none")
    padded = [
        (p, f, np.pad(i, ((0, 0), (0, width - i.shape[1]))), np.pad(w, ((0, 0), (0, width - w.shape[1]))))
        for p, f, i, w in parts
    ]
    vertices, faces, indices, weights = (np.concatenate(each) for each in zip(*padded, strict=True))
    return vertices, faces, indices, weights


def _welded(
    vertices: Floats, faces: np.ndarray, indices: np.ndarray, weights: Floats
) -> tuple[Floats, np.ndarray, np.ndarray, Floats]:
    """One vertex where texture seams store several, in the order of the file; faces without area dropped."""
    tolerance = 1e-6 * float(np.ptp(vertices, axis=0).max())
    _, first, inverse = np.unique(
        np.round(vertices / max(tolerance, 1e-300)), axis=0, return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    faces = rank[inverse.ravel()][faces]
    kept = first[order]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[kept], faces[distinct], indices[kept], weights[kept]


def _rigid(transforms: Floats) -> Floats:
    """Transforms without the scale that their nodes may have."""
    rigid = transforms.copy()
    u, _, v = np.linalg.svd(transforms[:, :3, :3])
    turn = u @ v
    turn[np.linalg.det(turn) < 0] *= -1
    rigid[:, :3, :3] = turn
    return rigid


def _landmarks(
    vertices: Tensor, joints: Tensor, names: tuple[str, ...]
) -> tuple[tuple[str, ...], Tensor, Tensor]:
    """Joints as means of vertices around them: non-negative weights of the closest that put them there."""
    roles = humanoid_joints(names)
    found, indices, values = [], [], []
    count = min(_LANDMARK_VERTICES, len(vertices))
    for name, role in LANDMARKS.items():
        if role not in roles:
            continue
        joint = joints[roles[role]]
        near = (vertices - joint).norm(dim=1).topk(count, largest=False).indices
        # The sum of the weights counts as much as ten metres: it is met, whatever the position does.
        rows = torch.cat((vertices[near].T, torch.full((1, count), 10.0, dtype=vertices.dtype)))
        solution, _ = nnls(rows.numpy(), torch.cat((joint, torch.tensor([10.0]).to(joint))).numpy())
        found.append(name)
        indices.append(near)
        values.append(torch.from_numpy(solution / solution.sum()))
    if not found:
        empty = torch.empty(0, 1)
        return (), empty.long(), empty.double()
    return tuple(found), torch.stack(indices), torch.stack(values)
