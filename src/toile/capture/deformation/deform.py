"""Deformation model f(θ, α, A, T) of a person in a garment: embedded deformation, then skinning.

Eq. 2 of Li et al., Deep Physics-aware Inference of Cloth Deformation for Monocular Human Performance Capture,
3DV 2021, after Habermann et al., DeepCap, CVPR 2020. What comes out is in camera- and root-relative space:
the axes are those of the camera (x right, y down, z forward), the origin is the root joint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import roma
import torch
from torch import Tensor

from toile.capture.body.limits import AXES, joint_angles, rotation_of_angles
from toile.capture.body.poses import Poses, from_world_axes, in_world_axes, joint_transforms
from toile.capture.body.skinning import dual_quaternion_blend
from toile.capture.body.subject import Subject
from toile.capture.deformation.garment_skinning import SMOOTHING, garment_skinning
from toile.capture.deformation.graph import EmbeddedGraph, embedded_deformation
from toile.capture.garments.garment import Garment, attached_targets
from toile.errors import InputError
from toile.geometry.camera import Camera

FACING = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""From the subject's axes at rest (y up, facing z) to those of a camera that it faces, upright."""


@dataclass(frozen=True)
class DeformableMesh:
    """A mesh at rest with what deforms and poses it.

    Attributes:
        rest_vertices: (N, 3), float64 [m].
        skinning_indices: (N, k) int64.
        skinning_weights: (N, k), float64, rows sum to 1.
        graph: its embedded graph, or None if it is only posed.
    """

    rest_vertices: Tensor
    skinning_indices: Tensor
    skinning_weights: Tensor
    graph: EmbeddedGraph | None = None

    def deform(self, transforms: Tensor, A: Tensor | None = None, T: Tensor | None = None) -> Tensor:
        """Vertices deformed by the graph at rest, then posed by dual quaternions.

        Args:
            transforms: of the joints, from rest to posed (B, J, 4, 4).
            A: Euler angles of the nodes (B, K, 3) [rad]; none where ``T`` is None.
            T: translations of the nodes (B, K, 3) [m].

        Returns:
            (B, N, 3) [m], of the type of ``transforms``.

        Raises:
            InputError: A or T without the other or without a graph, or of another graph.
        """
        vertices = self.rest_vertices.to(transforms)
        if (A is None) != (T is None) or (A is not None and self.graph is None):
            raise InputError(
                "Parameters of an embedded graph do not go together",
                where="A, T",
                expected="both, for a mesh with a graph, or none",
                got=f"{'no ' if A is None else ''}A, {'no ' if T is None else ''}T, "
                f"{'no ' if self.graph is None else ''}graph",
            )
        if A is not None and T is not None and self.graph is not None:
            vertices = embedded_deformation(self.graph, vertices, A, T)
        return dual_quaternion_blend(
            vertices,
            self.skinning_indices.to(transforms.device),
            self.skinning_weights.to(transforms),
            transforms,
        )

    def some(self, vertices: Tensor) -> DeformableMesh:
        """Only the given vertices (M,)."""
        graph = self.graph
        if graph is not None:
            graph = replace(graph, indices=graph.indices[vertices], weights=graph.weights[vertices])
        return DeformableMesh(
            self.rest_vertices[vertices],
            self.skinning_indices[vertices],
            self.skinning_weights[vertices],
            graph,
        )


@dataclass(frozen=True)
class Deformed:
    """What f gives, in camera- and root-relative space [m].

    Attributes:
        garment: V_cloth (B, N, 3).
        landmarks: K (B, L, 3).
        attached: where the body holds the garment's attached vertices (B, A, 3).
        body: V_body (B, V, 3), None if not asked for.
    """

    garment: Tensor
    landmarks: Tensor
    attached: Tensor
    body: Tensor | None = None

    def map(self, move: Callable[[Tensor], Tensor]) -> Deformed:
        """The same with every set of points (B, n, 3) moved, e.g. to the world."""
        body = None if self.body is None else move(self.body)
        return Deformed(move(self.garment), move(self.landmarks), move(self.attached), body)


@dataclass(frozen=True)
class PoseParameters:
    """Poses as PoseNet states them.

    Attributes:
        angles: θ (B, D, 3) [rad], flexion, abduction, twist of the driven joints (``body.limits``).
        root: α (B, 3) [rad], the same three angles of the root against a person who faces the camera upright.
        translation: where the root joint is in the world (B, 3) [m].
    """

    angles: Tensor
    root: Tensor
    translation: Tensor


class Deformation:
    """f(θ, α, A, T) of one subject in one garment; differentiable by all four.

    All numbers a motion needs of the body's surface beside the full mesh are had from a few hundred of its
    vertices, so that training does not pose 13,000 vertices for 23 landmarks.

    Args:
        subject: the person.
        garment: worn by it at rest.
        graph: embedded graph of the garment.
        body_graph: embedded graph of the body; the body is only posed if None.
        smoothing: see ``garment_skinning`` [m].
        driven: (D,) int64, joints that θ turns; see ``driven_joints`` if None.

    Attributes:
        subject: see above.
        garment: see above.
        garment_mesh: the garment, with its skinning weights and graph.
        body_mesh: the body.
        driven: see above.
    """

    def __init__(
        self,
        subject: Subject,
        garment: Garment,
        graph: EmbeddedGraph,
        body_graph: EmbeddedGraph | None = None,
        smoothing: float = SMOOTHING,
        driven: Tensor | None = None,
    ) -> None:
        self.subject = subject
        self.garment = garment
        self.driven = driven_joints(subject) if driven is None else driven
        indices, weights = garment_skinning(garment, subject, smoothing)
        self.garment_mesh = DeformableMesh(garment.rest_vertices, indices, weights, graph)
        self.body_mesh = DeformableMesh(
            subject.rest_vertices, subject.skinning_indices, subject.skinning_weights, body_graph
        )
        held = subject.faces[garment.attached_faces]
        needed, number = torch.cat((subject.landmark_indices.flatten(), held.flatten())).unique(
            return_inverse=True
        )
        self._needed = needed
        self._needed_mesh = self.body_mesh.some(needed)
        n_landmark = subject.landmark_indices.numel()
        self._landmark_indices = number[:n_landmark].reshape(subject.landmark_indices.shape)
        self._held_faces = number[n_landmark:].reshape(-1, 3)
        self._held = replace(garment, attached_faces=torch.arange(len(held)))

    def __call__(
        self,
        angles: Tensor,
        root: Tensor,
        A: Tensor | None = None,
        T: Tensor | None = None,
        body_A: Tensor | None = None,
        body_T: Tensor | None = None,
        *,
        with_body: bool = False,
    ) -> Deformed:
        """Garment, landmarks and attachment of B poses.

        Args:
            angles: θ (B, D, 3) [rad], see PoseParameters.
            root: α (B, 3) [rad], see PoseParameters.
            A: Euler angles of the garment's nodes (B, K, 3) [rad]; the garment is only posed if None.
            T: translations of the garment's nodes (B, K, 3) [m].
            body_A: Euler angles of the body's nodes (B, K', 3) [rad].
            body_T: translations of the body's nodes (B, K', 3) [m].
            with_body: whether to pose the whole body too.

        Returns:
            In the type of ``angles``.

        Raises:
            InputError: shapes that do not fit the skeleton or the graphs.
        """
        transforms = self.transforms(angles, root)
        garment = self.garment_mesh.deform(transforms, A, T)
        body = None
        if with_body:
            body = self.body_mesh.deform(transforms, body_A, body_T)
            surface = body[:, self._needed]
        else:
            surface = self._needed_mesh.deform(transforms, body_A, body_T)
        weights = self.subject.landmark_weights[..., None].to(surface)
        landmarks = (surface[:, self._landmark_indices] * weights).sum(-2)
        held = replace(
            self._held,
            attached_barycentric=self._held.attached_barycentric.to(surface),
            attached_offsets=self._held.attached_offsets.to(surface),
        )
        return Deformed(garment, landmarks, attached_targets(held, surface, self._held_faces), body)

    def transforms(self, angles: Tensor, root: Tensor) -> Tensor:
        """Transforms of the joints from rest to camera- and root-relative space, (B, J, 4, 4).

        Args:
            angles: θ (B, D, 3) [rad].
            root: α (B, 3) [rad].

        Raises:
            InputError: shapes that do not fit the skeleton.
        """
        expected = (len(root), len(self.driven), 3)
        if angles.shape != expected or root.shape != (len(root), 3):
            raise InputError(
                "Pose belongs to another skeleton",
                where="angles, root",
                expected=f"(B, {len(self.driven)}, 3), (B, 3)",
                got=f"{tuple(angles.shape)}, {tuple(root.shape)}",
            )
        # Single precision would add up along the chain of a hundred joints.
        rotations = torch.eye(3, dtype=torch.float64).repeat(len(root), len(self.subject.joint_names), 1, 1)
        rotations[:, self.driven] = rotation_of_angles(angles.double().cpu())
        facing = torch.tensor(FACING, dtype=torch.float64)
        rotations[:, 0] = facing @ rotation_of_angles(root.double().cpu())
        to_origin = -self.subject.rest_joints[0, :3, 3].expand(len(root), 3)
        poses = from_world_axes(self.subject, rotations, to_origin)
        return joint_transforms(self.subject, poses).to(angles)


def driven_joints(subject: Subject) -> Tensor:
    """Joints that θ turns, (D,) int64: those that have limits, or all but the root if none has."""
    limited = torch.isfinite(subject.joint_limits).any(-1).any(-1)
    limited[0] = False
    if not bool(limited.any()):
        limited = torch.arange(len(limited)) > 0
    return limited.nonzero().ravel()


def parameters_of_poses(
    subject: Subject, poses: Poses, camera: Camera, driven: Tensor | None = None
) -> PoseParameters:
    """The poses of the world as a camera sees them: inverse of f at A = T = 0.

    Rotations of joints that are not driven are lost.

    Args:
        subject: whose poses.
        poses: B of them.
        camera: the one that α is relative to.
        driven: (D,), joints that θ turns; see ``driven_joints`` if None.
    """
    driven = driven_joints(subject) if driven is None else driven
    root = torch.tensor(FACING, dtype=torch.float64).T @ camera.R @ in_world_axes(subject, poses)[:, 0]
    return PoseParameters(
        angles=joint_angles(subject, poses)[:, driven],
        root=roma.rotmat_to_euler(AXES, root),
        translation=subject.rest_joints[0, :3, 3] + poses.root_translation,
    )
