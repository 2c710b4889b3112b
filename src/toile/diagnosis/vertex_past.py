"""How forces of vertices hang on the motion before the step: drag, what faces them, curved rest shapes.

A force at a vertex depends on positions and velocities of its neighbours up to r away on the grid, r at most
two. So rows of the derivative that are 2 r + 1 apart share no column, and (2 r + 1)² adjoints for each axis
give all of it (Curtis, Powell and Reid 1974, On the estimation of sparse Jacobian matrices). Where neighbours
only turn the vertex's normal, one adjoint for each axis does, beside the derivative of the normals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from toile.diagnosis.past_products import PastProducts, some_at_once
from toile.geometry.mesh import face_normals
from toile.physics.cloth import Cloth
from toile.physics.implicit.terms import term_forces
from toile.physics.step_terms import StepContext, StepTerm, VertexTerm

Array = NDArray[np.float64]
Single = NDArray[np.float32]


class VertexPast:
    """The derivative from adjoints of vertices that do not meet.

    Args:
        terms: at least one.
        cloth: on a grid.
    """

    def __init__(self, terms: Sequence[StepTerm], cloth: Cloth) -> None:
        assert cloth.grid is not None
        self._terms = terms
        H, W = cloth.grid
        reach = max(term.past_reach for term in terms)
        n, apart = H * W, 2 * reach + 1
        i, j = (a.reshape(-1) for a in np.meshgrid(np.arange(H), np.arange(W), indexing="ij"))
        colours = [(a, b) for a in range(apart) for b in range(apart)]
        probes = np.zeros((len(colours), 3, n, 3))
        rows = np.zeros((len(colours), n), int)
        inside = np.zeros((len(colours), n), bool)
        for k, (a, b) in enumerate(colours):
            chosen = (i % apart == a) & (j % apart == b)
            for axis in range(3):
                probes[k, axis, chosen, axis] = 1.0
            # The one vertex of this colour that a vertex can act on.
            near = i + (a - i + reach) % apart - reach, j + (b - j + reach) % apart - reach
            inside[k] = (near[0] >= 0) & (near[0] < H) & (near[1] >= 0) & (near[1] < W)
            rows[k] = np.where(inside[k], near[0] * W + near[1], 0)
        self._probes = torch.from_numpy(probes.reshape(-1, n, 3))
        shape = (len(colours), 3, n, 3)
        axes = np.arange(3)
        self._rows = np.broadcast_to(3 * rows[:, None, :, None] + axes[:, None, None], shape).reshape(-1)
        self._columns = np.broadcast_to(3 * np.arange(n)[:, None] + axes, shape).reshape(-1)
        self._inside = np.broadcast_to(inside[:, None, :, None], shape).reshape(-1)
        self._size = 3 * n

    def products(self, now: StepContext, positions: Array) -> PastProducts:
        """Derivatives by positions [N/m] and velocities [N s/m], of a step that ends at (N, 3) [m]."""
        leaves = [t.detach().clone().requires_grad_() for t in (now.positions, now.velocities)]
        leaf = replace(now.detached(), positions=leaves[0], velocities=leaves[1])
        with torch.enable_grad():
            forces = term_forces(self._terms, leaf, torch.from_numpy(positions))
            if not forces.requires_grad:
                return PastProducts()
            found = torch.autograd.grad(
                forces, leaves, self._probes, is_grads_batched=True, allow_unused=True
            )
        by_position, by_velocity = (None if g is None else self._sparse(g.detach().numpy()) for g in found)
        return PastProducts(None, by_position, by_velocity)

    def _sparse(self, gradients: Array) -> csr_array:
        values = (gradients.reshape(-1) * self._inside).astype(np.float32)
        kept = values != 0
        at = (self._rows[kept], self._columns[kept])
        return csr_array((values[kept], at), shape=(self._size, self._size))


class FacingPast:
    """The derivative of terms whose neighbours do nothing but turn a vertex's normal (own_past).

    Args:
        terms: at least one.
        cloth: on a grid.
    """

    def __init__(self, terms: Sequence[VertexTerm], cloth: Cloth) -> None:
        self._terms = terms
        n = cloth.n_vertices
        of_vertices = 3 * np.arange(n)[:, None] + np.arange(3)
        self._columns = np.repeat(of_vertices, 3, axis=0).reshape(-1).astype(np.int32)
        self._starts = (3 * np.arange(3 * n + 1)).astype(np.int32)
        self._shape = (3 * n, 3 * n)

    def products(self, now: StepContext, positions: Array) -> PastProducts:
        """See VertexPast."""
        plain = now.detached()
        leaves = [t.clone().requires_grad_() for t in (plain.positions, plain.velocities, plain.normals)]
        x, v, normals = leaves
        leaf = replace(plain, positions=x, velocities=v).with_normals(normals)
        with torch.enable_grad():
            forces = term_forces(self._terms, leaf, torch.from_numpy(positions))
            if not forces.requires_grad:
                return PastProducts()
            rows = [
                torch.autograd.grad(forces[:, axis].sum(), leaves, retain_graph=True, allow_unused=True)
                for axis in range(3)
            ]
        return PastProducts(None, *(self._blocks(of_axes) for of_axes in zip(*rows, strict=True)))

    def _blocks(self, of_axes: Sequence[Tensor | None]) -> csr_array | None:
        """Of every vertex by itself, of rows (N, 3) for each axis."""
        if all(g is None for g in of_axes):
            return None
        known = next(g for g in of_axes if g is not None)
        rows = torch.stack([torch.zeros_like(known) if g is None else g for g in of_axes], dim=1)
        values = rows.detach().numpy().reshape(-1).astype(np.float32)
        return csr_array((values, self._columns, self._starts), shape=self._shape)


class StencilPast:
    """The derivative of a term that acts on stencils by where they are, and by a normal, when a step begins.

    Args:
        term: that has ``stencil_forces``.
        cloth: that it acts on.
    """

    def __init__(self, term: VertexTerm, cloth: Cloth) -> None:
        found = term.stencil_forces(cloth)
        assert found is not None
        self._acting = found
        self._vertices = found.stencil.numpy()
        E, K = self._vertices.shape
        rows = 3 * K
        own = (3 * self._vertices[:, :, None] + np.arange(3)).reshape(E, rows)
        facing = 3 * self._vertices[:, found.middle][:, None] + np.arange(3)
        self._own = np.repeat(own, rows, axis=0).reshape(-1).astype(np.int32)
        self._own_starts = (rows * np.arange(E * rows + 1)).astype(np.int32)
        self._facing = np.repeat(facing, rows, axis=0).reshape(-1).astype(np.int32)
        self._facing_starts = (3 * np.arange(E * rows + 1)).astype(np.int32)
        self._shape = (E * rows, 3 * cloth.n_vertices)
        ones = np.ones(E * rows, np.float32)
        at = (own.reshape(-1), np.arange(E * rows))
        self._after = csr_array((ones, at), shape=self._shape[::-1])

    def of_steps(self, steps: Sequence[StepContext]) -> list[PastProducts]:
        """Of every step."""
        return some_at_once(self._side_by_side, steps)

    def _side_by_side(self, steps: Sequence[StepContext]) -> list[PastProducts]:
        positions = torch.stack([now.positions.detach() for now in steps])
        normals = torch.stack([now.detached().normals for now in steps])
        x = positions[:, self._acting.stencil].requires_grad_()
        facing = normals[:, self._acting.stencil[:, self._acting.middle]].requires_grad_()
        with torch.enable_grad():
            forces = self._acting.forces(x, facing).flatten(-2)
        # Stencils stand side by side and share no vertex.
        rows = [torch.autograd.grad(own.sum(), (x, facing), retain_graph=True) for own in forces.unbind(-1)]
        by_own, by_facing = (
            torch.stack(own, dim=2).detach().numpy().reshape(len(steps), -1).astype(np.float32)
            for own in zip(*rows, strict=True)
        )
        return [
            PastProducts(
                self._after,
                csr_array((own, self._own, self._own_starts), shape=self._shape),
                None,
                csr_array((turned, self._facing, self._facing_starts), shape=self._shape),
            )
            for own, turned in zip(by_own, by_facing, strict=True)
        ]


_LEAST_LENGTH = 1e-12
"""Of the sum of faces' normals; as torch's normalize has it."""


class TurningNormals:
    """How normals of vertices turn with their neighbours, see geometry.mesh.vertex_normals.

    Args:
        cloth: with its faces.
    """

    def __init__(self, cloth: Cloth) -> None:
        faces = cloth.topology.faces.numpy()
        n, t = cloth.n_vertices, len(faces)
        self._faces = faces
        # Of a face: d(p₁ - p₀) × (p₂ - p₀) = Σ_c dp_c × e_c, e_c the edge opposite to the corner c.
        axis = np.arange(3)
        others = np.stack(((axis + 1) % 3, (axis + 2) % 3), axis=-1)
        columns = 3 * faces[:, None, :, None] + others[None, :, None, :]
        self._columns = columns.reshape(-1).astype(np.int32)
        self._starts = (6 * np.arange(3 * t + 1)).astype(np.int32)
        self._face_shape = (3 * t, 3 * n)
        vertex, face = faces.reshape(-1), np.repeat(np.arange(t), 3)
        order = np.argsort(vertex, kind="stable")
        self._around, around = vertex[order], face[order]
        counts = np.bincount(vertex, minlength=n)
        first = np.concatenate(([0], np.cumsum(counts)))
        # A vertex has three rows, each with three entries for every face around it.
        place = np.concatenate([np.tile(np.arange(first[k], first[k + 1]), 3) for k in range(n)])
        row = np.concatenate([np.repeat(np.arange(3), counts[k]) for k in range(n)])
        self._entry, self._row = place, row
        self._sum_columns = (3 * around[place][:, None] + np.arange(3)).reshape(-1).astype(np.int32)
        self._sum_starts = np.concatenate(([0], np.cumsum(3 * np.repeat(counts, 3)))).astype(np.int32)
        self._sum_shape = (3 * n, 3 * t)

    def change(self, positions: Array, moved: Single) -> Single:
        """Change of the normals (3N, R) of a cloth at positions (N, 3) [m] that is moved (3N, R) [m]."""
        p = positions[self._faces]
        opposite = np.stack((p[:, 1] - p[:, 2], p[:, 2] - p[:, 0], p[:, 0] - p[:, 1]), axis=1)
        # (d × e)_a = d_b e_c - d_c e_b for (a, b, c) in cyclic order.
        cyclic = np.stack((np.roll(opposite, -2, axis=-1), -np.roll(opposite, -1, axis=-1)), axis=-1)
        entries = cyclic.transpose(0, 2, 1, 3).reshape(-1).astype(np.float32)
        of_faces = csr_array((entries, self._columns, self._starts), shape=self._face_shape) @ moved
        total = np.zeros_like(positions)
        of_each = face_normals(torch.from_numpy(positions), torch.from_numpy(self._faces)).numpy()
        np.add.at(total, self._faces.reshape(-1), np.repeat(of_each, 3, 0))
        length = np.linalg.norm(total, axis=-1, keepdims=True).clip(min=_LEAST_LENGTH)
        unit = total / length
        across = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length[:, :, None]
        values = across[self._around[self._entry], self._row].reshape(-1).astype(np.float32)
        return np.asarray(
            csr_array((values, self._sum_columns, self._sum_starts), shape=self._sum_shape) @ of_faces
        )
