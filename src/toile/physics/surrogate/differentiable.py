"""The step problem in plain torch: what ``kernels`` computes, differentiable in every argument.

Made for one purpose: backpropagation through the surrogate, where every pass is computed once more with a
graph. Works in the precision of its tensors, so that derivatives can be checked in float64. In float32, where
it is used, forces and line solves come from the kernels, and only their derivatives from here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, final

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from toile.physics.surrogate import kernels
from toile.physics.surrogate.problem import StepProblem

_MAX_COSINE = 0.9995  # as in kernels
_TINY = 1e-12  # under the roots of edge lengths, as in kernels
_STEP = 1e-3  # of a central difference, norm of the whole displacement in edges
_NOTHING = 1e-30
_SERIES_ENDS = 0.2  # 1 - cos θ from which on the inverse cosine keeps enough digits


@final
class DifferentiableStepProblem(StepProblem):
    """A step whose forces, line solves and network inputs have gradients; see StepProblem.

    Step lengths are differentiated as well; which start is taken, and whether a step is accepted or halved,
    are choices and have no derivative.
    """

    @classmethod
    def of(cls, problem: StepProblem) -> DifferentiableStepProblem:
        """The same step."""
        return cls(**{field.name: getattr(problem, field.name) for field in fields(problem)})

    def residual(self, positions: Tensor) -> Tensor:
        """See StepProblem."""
        of = energy_gradient if self.stiffness.dtype == torch.float64 else fast_energy_gradient
        internal = of(positions, self.stiffness, self.rest_lengths_i, self.rest_lengths_j)
        inertia = self.masses[..., None] * (self.prediction - positions).to(self.forces.dtype)
        return (inertia + self.forces - internal) * self.free[..., None]

    def line_step(self, positions: Tensor, residual: Tensor, axis: int) -> Tensor:
        """See StepProblem."""
        return line_relaxation(self, positions, residual, axis)

    def tensions(self, positions: Tensor) -> Tensor:
        """See StepProblem."""
        return tensions(positions, self.stiffness, self.rest_lengths_i, self.rest_lengths_j)

    def vertex_inputs(
        self, positions: Tensor, residual: Tensor, tension: Tensor, pinned: Tensor, level: int
    ) -> tuple[Tensor, Tensor]:
        """See StepProblem."""
        return vertex_inputs(positions, residual, tension, pinned, self.masses, self.stiffness, level)


def energy_gradient(positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
    """Gradient of E (paper, Eqs. 5 to 9), (B, H, W, 3); arguments as in ``kernels.energy_gradient``."""
    y, s, b = (stiffness[:, k, None, None, None] for k in range(3))
    total = stiffness.new_zeros(positions.shape)
    for axis, rest in ((1, rest_i), (2, rest_j)):
        e = _difference(positions, axis, stiffness.dtype)
        pull = y * (_stretch(positions, axis, rest)[..., None]) * e / _length(e)
        n = e.shape[axis] - 1
        g_first, g_second = _bending(e.narrow(axis, 0, n), e.narrow(axis, 1, n), b)
        # Forces on edge vectors: the pair of a straight angle begins with every edge but the last.
        pull = pull + _shifted(g_first, axis, 0) + _shifted(g_second, axis, 1)
        total = total + _ends(pull, axis)
    return total + _shearing(positions, s)


def fast_energy_gradient(positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
    """The same by the kernel; its derivative by a central difference along the gradient that comes back."""
    found: Tensor = _FastEnergyGradient.apply(positions, stiffness, rest_i, rest_j)
    return found


class _FastEnergyGradient(torch.autograd.Function):
    """∂E/∂x is linear in the stiffness, and its derivative in x is symmetric."""

    @staticmethod
    def forward(ctx: Any, positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
        ctx.save_for_backward(positions, stiffness, rest_i, rest_j)
        return kernels.energy_gradient(positions, stiffness, rest_i, rest_j)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        x, k, rest_i, rest_j = ctx.saved_tensors
        v = gradients[0].double()
        largest = v.flatten(1).norm(dim=1)[:, None, None, None] + _NOTHING
        moved = _STEP / largest * v
        # One launch for all: ahead, behind, and here with one stiffness at a time.
        n = k.shape[1]
        positions = torch.cat((x + moved, x - moved, x.repeat(n, 1, 1, 1)))
        units = torch.eye(n, dtype=k.dtype).repeat_interleave(len(x), 0)
        found = kernels.energy_gradient(
            positions, torch.cat((k, k, units)), rest_i.repeat(n + 2, 1, 1), rest_j.repeat(n + 2, 1, 1)
        ).double()
        ahead, behind, *per_unit = found.split(len(x))
        to_x = (ahead - behind) * (largest / (2 * _STEP))
        to_k = torch.stack([(unit * v).sum((1, 2, 3)) for unit in per_unit], 1).to(k.dtype)
        return to_x, to_k, None, None


def tensions(positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
    """See ``kernels.tensions``; (B, H, W, 3)."""
    y = stiffness[:, 0, None, None]
    t_i, t_j = y * _stretch(positions, 1, rest_i), y * _stretch(positions, 2, rest_j)
    pull = sum(
        pad(t.clamp(min=0.0), sides)
        for t, sides in ((t_i, (0, 0, 0, 1)), (t_i, (0, 0, 1, 0)), (t_j, (0, 1)), (t_j, (1, 0)))
    )
    return torch.stack((torch.as_tensor(pull), pad(t_i, (0, 0, 0, 1)), pad(t_j, (0, 1))), -1)


def vertex_inputs(
    positions: Tensor,
    residual: Tensor,
    tension: Tensor,
    pinned: Tensor,
    masses: Tensor,
    stiffness: Tensor,
    level: int,
) -> tuple[Tensor, Tensor]:
    """See ``kernels.vertex_inputs``."""
    spacing = 2.0**level
    a, c = (_tangent(positions, axis, stiffness.dtype) / spacing for axis in (1, 2))
    length_a, length_c = _length(a), _length(c)
    p = _unit(a / length_a + c / length_c)
    q = a / length_a - c / length_c
    q = _unit(q - _dot(q, p) * p)
    u, v = 0.70710678 * (p + q), 0.70710678 * (p - q)
    n = torch.linalg.cross(q, p)
    frames = torch.stack((u, v, n), -2)
    along = (frames * residual[..., None, :]).sum(-1)
    area = spacing**2
    pull = tension[..., 0:1]
    k = stiffness[:, None, None, :]
    bending = 12.0 * k[..., 2:3] / area**2
    in_plane = 1.0 + (2.0 * k[..., 0:1] + 4.0 * k[..., 1:2]) / area + bending
    normal = 1.0 + pull / area + bending
    parts = [
        along,
        along[..., :2] / in_plane,
        along[..., 2:] / normal,
        0.3 * torch.log(1.0 + pull),
        length_a - 1.0,
        length_c - 1.0,
        _dot(a, c),
        pinned[..., None],
    ]
    if level == 0:
        parts.append(torch.asinh(tension[..., 1:]))
        for axis in (1, 2):
            bend = _difference(positions, axis, stiffness.dtype).diff(dim=axis)
            bend = _shifted(_shifted(bend, axis, 0), axis, 1)
            parts.append((frames * bend[..., None, :]).sum(-1))
        parts.append(masses.expand(len(positions), -1, -1)[..., None])
    return frames, torch.cat(parts, -1)


def line_relaxation(problem: StepProblem, positions: Tensor, residual: Tensor, axis: int) -> Tensor:
    """See ``kernels.line_relaxation``; (B, H, W, 3).

    The factorised system is a constant; its derivative comes from the defect of the solution, which is zero.
    """
    along, across = (1, 2) if axis == 0 else (2, 1)

    def lines(grid: Tensor) -> Tensor:
        """Lines first, then the vertices along them."""
        return grid.transpose(1, 2) if axis == 0 else grid

    rest = {1: problem.rest_lengths_i, 2: problem.rest_lengths_j}
    blocks = _line_blocks(
        lines(positions),
        problem.stiffness,
        lines(rest[along]),
        lines(rest[across]),
        lines(problem.masses.expand(len(positions), -1, -1)),
        lines(problem.free),
    )
    right = lines(residual * problem.free[..., None])
    if problem.stiffness.dtype == torch.float64:
        solve = partial(_solve_dense, torch.linalg.cholesky(_dense(*(block.detach() for block in blocks))))
    else:
        solve = partial(_solve_fast, problem, positions.detach(), axis)
    step = solve(right.detach())
    step = _Solved.apply(solve, step, right - _product(step, *blocks))
    return lines(step) * problem.free[..., None]


class _Solved(torch.autograd.Function):
    """The solution of symmetric systems, whose derivative is theirs applied to the defect's."""

    @staticmethod
    def forward(ctx: Any, solve: Callable[[Tensor], Tensor], solution: Tensor, defect: Tensor) -> Tensor:
        ctx.solve = solve
        return solution.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        return None, None, ctx.solve(gradients[0])


def _solve_dense(factor: Tensor, right: Tensor) -> Tensor:
    flat = right.flatten(-2)[..., None]
    return torch.cholesky_solve(flat, factor).view_as(right)


def _solve_fast(problem: StepProblem, positions: Tensor, axis: int, right: Tensor) -> Tensor:
    grid = right.transpose(1, 2) if axis == 0 else right
    solved = StepProblem.line_step(problem, positions, grid.contiguous(), axis)
    return solved.transpose(1, 2) if axis == 0 else solved


def _line_blocks(
    x: Tensor, stiffness: Tensor, rest_along: Tensor, rest_across: Tensor, masses: Tensor, free: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """3×3 blocks of every line's system: of a vertex (B, L, n, 3, 3), to its next and next but one."""
    y, s, b = (stiffness[:, k, None, None, None, None] for k in range(3))
    one = torch.eye(3, dtype=stiffness.dtype)
    moves = free[..., None, None]
    diagonal = (masses[..., None, None] * moves + 1.0 - moves) * one
    # Neighbouring lines, which are held still.
    e = _difference(x, 1, stiffness.dtype)
    length = _length(e)
    along = _outer(e / length)
    pull = (y * ((length - rest_across[..., None]) / length)[..., None]).clamp(min=0.0)
    held = y * along + (pull + 2.0 * s + 2.0 * b) * (one - along)
    held = pad(held, (0, 0, 0, 0, 0, 0, 0, 1)) + pad(held, (0, 0, 0, 0, 0, 0, 1, 0))
    diagonal = diagonal + moves * held
    # Edges along the line.
    e = _difference(x, 2, stiffness.dtype)
    length = _length(e)
    u = e / length
    along = _outer(u)
    wide = (torch.cat((x[:, 1:], x[:, -1:]), 1) - torch.cat((x[:, :1], x[:, :-1]), 1)).to(stiffness.dtype)
    w = wide[:, :, :-1] + wide[:, :, 1:]
    w = w - _dot(w, u) * u
    w = w / _length(w)
    cells = torch.full((x.shape[1],), 2.0, dtype=stiffness.dtype)
    cells[[0, -1]] = 1.0
    pull = (y * ((length - rest_along[..., None]) / length)[..., None]).clamp(min=0.0)
    spring = y * along + pull * (one - along)
    spring = spring + 2.0 * cells[:, None, None, None] * s / length[..., None].square() * _outer(w)
    m0, m1 = moves[:, :, :-1], moves[:, :, 1:]
    diagonal = diagonal + _at(m0 * spring, 0, 1) + _at(m1 * spring, 1, 0)
    following = -m0 * m1 * spring
    # Straight angles along the line.
    t = u[:, :, :-1] + u[:, :, 1:]
    t = t / _length(t)
    angle = b / (length[:, :, :-1] * length[:, :, 1:])[..., None] * (one - _outer(t))
    m0, m1, m2 = moves[:, :, :-2], moves[:, :, 1:-1], moves[:, :, 2:]
    diagonal = diagonal + _at(m0 * angle, 0, 2) + _at(4.0 * m1 * angle, 1, 1) + _at(m2 * angle, 2, 0)
    following = following + _at(-2.0 * m0 * m1 * angle, 0, 1) + _at(-2.0 * m1 * m2 * angle, 1, 0)
    return diagonal, following, m0 * m2 * angle


def _at(blocks: Tensor, before: int, after: int) -> Tensor:
    """Blocks (B, L, k, 3, 3) with zeros before and after along the line."""
    return pad(blocks, (0, 0, 0, 0, before, after))


def _dense(diagonal: Tensor, following: Tensor, second: Tensor) -> Tensor:
    """The lines' systems (B, L, 3 n, 3 n) float64."""
    batch, n_lines, n = diagonal.shape[:3]
    full = torch.zeros(batch, n_lines, n, 3, n, 3, dtype=torch.float64)
    for offset, blocks in ((0, diagonal), (1, following), (2, second)):
        for sign in {offset, -offset}:
            torch.diagonal(full, sign, 2, 4).copy_(blocks.permute(0, 1, 3, 4, 2))
    return full.view(batch, n_lines, 3 * n, 3 * n)


def _product(vectors: Tensor, diagonal: Tensor, following: Tensor, second: Tensor) -> Tensor:
    """The lines' systems times vectors (B, L, n, 3)."""

    def times(blocks: Tensor, part: Tensor) -> Tensor:
        return (blocks @ part[..., None])[..., 0]

    n = vectors.shape[2]
    total = times(diagonal, vectors)
    for offset, blocks in ((1, following), (2, second)):
        total = total + pad(times(blocks, vectors[:, :, offset:]), (0, 0, 0, offset))
        total = total + pad(times(blocks, vectors[:, :, : n - offset]), (0, 0, offset, 0))
    return total


def _shearing(positions: Tensor, stiffness: Tensor) -> Tensor:
    """Gradient of the shearing energy, (B, H, W, 3); stiffness (B, 1, 1, 1)."""
    e, h = (_difference(positions, axis, stiffness.dtype) for axis in (1, 2))
    length_e, length_h = _length(e), _length(h)
    p, q = e / length_e, h / length_h
    on_e, on_h = torch.zeros_like(e), torch.zeros_like(h)
    height, width = positions.shape[1:3]
    for i in range(2):
        for j in range(2):
            # The corner of every cell at vertex (i, j) of the cell: edge e of column j, edge h of row i.
            columns, rows = slice(j, width - 1 + j), slice(i, height - 1 + i)
            pc, qc = p[:, :, columns], q[:, rows]
            c = _dot(pc, qc).clamp(-_MAX_COSINE, _MAX_COSINE)
            w = stiffness * torch.asin(c) / torch.sqrt(1.0 - c * c)
            g_e = w / length_e[:, :, columns] * (qc - c * pc)
            g_h = w / length_h[:, rows] * (pc - c * qc)
            on_e = on_e + pad(g_e, (0, 0, j, 1 - j))
            on_h = on_h + pad(g_h, (0, 0, 0, 0, i, 1 - i))
    return _ends(on_e, 1) + _ends(on_h, 2)


def _bending(e: Tensor, h: Tensor, stiffness: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient of ½ B θ² with respect to two consecutive edges (..., 3)."""
    length_e, length_h = _length(e), _length(h)
    p, q = e / length_e, h / length_h
    defect = 0.5 * (p - q).square().sum(-1, keepdim=True)
    d = defect.clamp(max=1.9995)
    series = 1.0 + d * (
        1.0 / 3.0 + d * (2.0 / 15.0 + d * (2.0 / 35.0 + d * (8.0 / 315.0 + d * (8.0 / 693.0))))
    )
    far = d.clamp(min=_SERIES_ENDS)
    ratio = torch.where(d >= _SERIES_ENDS, torch.acos(1.0 - far) / torch.sqrt(far * (2.0 - far)), series)
    w, c = -stiffness * ratio, 1.0 - defect
    return w / length_e * (q - c * p), w / length_h * (p - c * q)


def _difference(x: Tensor, axis: int, dtype: torch.dtype) -> Tensor:
    """Edge vectors along a grid axis; positions are float64, their differences need not be."""
    return x.diff(dim=axis).to(dtype)


def _tangent(x: Tensor, axis: int, dtype: torch.dtype) -> Tensor:
    """Central differences per vertex, one-sided at the ends."""
    n = x.shape[axis]
    index = torch.arange(n)
    ahead, behind = (index + 1).clamp(max=n - 1), (index - 1).clamp(min=0)
    apart = (ahead - behind).clamp(min=1).to(dtype)
    difference = (x.index_select(axis, ahead) - x.index_select(axis, behind)).to(dtype)
    return difference / apart.reshape([-1, 1, 1] if axis == 1 else [-1, 1])


def _stretch(x: Tensor, axis: int, rest: Tensor) -> Tensor:
    """Length of the edges along an axis minus their rest length."""
    return (x.diff(dim=axis).norm(dim=-1) - rest).to(rest.dtype)


def _ends(forces: Tensor, axis: int) -> Tensor:
    """Forces on vertices of forces on edge vectors: minus where an edge begins, plus where it ends."""
    return _shifted(forces, axis, 1) - _shifted(forces, axis, 0)


def _shifted(edges: Tensor, axis: int, by: int) -> Tensor:
    """One more along the axis: zero in front (by = 1) or behind (by = 0)."""
    sides = (by, 1 - by)
    return pad(edges, (0, 0, 0, 0, *sides) if axis == 1 else (0, 0, *sides))


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _length(e: Tensor) -> Tensor:
    return (e.square().sum(-1, keepdim=True) + _TINY).sqrt()


def _unit(v: Tensor) -> Tensor:
    squared = v.square().sum(-1, keepdim=True)
    # A grid of one vertex has no direction; it stays zero.
    return v / torch.where(squared > 0, squared, 1.0).sqrt()


def _outer(v: Tensor) -> Tensor:
    return v[..., :, None] * v[..., None, :]
