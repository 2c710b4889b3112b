"""Warp kernels of the surrogate: energies and their gradient on grids, line relaxation, network inputs.

Batched, CPU and CUDA; positions in float64, everything else in float32. The functions in
``toile.physics.energies`` are the oracle of energies and gradient.
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from toile.warp_runtime import start_warp

start_warp()

# Angles beyond this cosine are treated as if at it: the gradient of the angle has no direction there.
_MAX_COSINE = 0.9995
_N_GEOMETRY = 20
_N_COARSE = 11


@wp.func
def difference(to: wp.vec3d, start: wp.vec3d):
    """Positions are float64, their differences float32: a stiff spring multiplies every digit lost."""
    return wp.vec3(to - start)


@wp.func
def edge_length(e: wp.vec3):
    """Length of an edge vector, never zero."""
    return wp.sqrt(wp.dot(e, e) + 1.0e-12)


@wp.func
def stretch_of(to: wp.vec3d, start: wp.vec3d, rest: wp.float32):
    """Length minus rest length."""
    return wp.float32(wp.length(to - start) - wp.float64(rest))


@wp.func
def theta_over_sine(defect: wp.float32):
    """θ / sin θ as a function of 1 - cos θ."""
    d = wp.min(defect, 1.9995)
    ratio = 1.0 + d * (
        1.0 / 3.0 + d * (2.0 / 15.0 + d * (2.0 / 35.0 + d * (8.0 / 315.0 + d * (8.0 / 693.0))))
    )
    if d >= 0.2:
        ratio = wp.acos(1.0 - d) / wp.sqrt(d * (2.0 - d))
    return ratio


@wp.func
def bending_gradient(x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, stiffness: wp.float32):
    """Gradient of ½ B θ² with respect to the two edges."""
    e = difference(x1, x0)
    h = difference(x2, x1)
    length_e = edge_length(e)
    length_h = edge_length(h)
    p = e / length_e
    q = h / length_h
    defect = 0.5 * wp.dot(p - q, p - q)
    w = -stiffness * theta_over_sine(defect)
    c = 1.0 - defect
    return w / length_e * (q - c * p), w / length_h * (p - c * q)


@wp.kernel(enable_backward=False)
def energy_gradient_kernel(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    stiffness: wp.array(dtype=wp.vec3),
    rest_i: wp.array(dtype=wp.float32, ndim=3),
    rest_j: wp.array(dtype=wp.float32, ndim=3),
    out: wp.array(dtype=wp.vec3, ndim=3),
):
    """Add ∂E/∂x: each thread the edges, straight angles and the cell that begin at its vertex."""
    b, i, j = wp.tid()
    n_i = x.shape[1]
    n_j = x.shape[2]
    stretching = stiffness[b][0]
    shearing = stiffness[b][1]
    bending = stiffness[b][2]
    x00 = x[b, i, j]
    if i + 1 < n_i:
        e = difference(x[b, i + 1, j], x00)
        g = stretching * stretch_of(x[b, i + 1, j], x00, rest_i[b, i, j]) / edge_length(e) * e
        if i + 2 < n_i:
            g_first, g_second = bending_gradient(x00, x[b, i + 1, j], x[b, i + 2, j], bending)
            g += g_first
            wp.atomic_add(out, b, i + 2, j, g_second)
            wp.atomic_add(out, b, i + 1, j, -g_second)
        wp.atomic_add(out, b, i + 1, j, g)
        wp.atomic_add(out, b, i, j, -g)
    if j + 1 < n_j:
        e = difference(x[b, i, j + 1], x00)
        g = stretching * stretch_of(x[b, i, j + 1], x00, rest_j[b, i, j]) / edge_length(e) * e
        if j + 2 < n_j:
            g_first, g_second = bending_gradient(x00, x[b, i, j + 1], x[b, i, j + 2], bending)
            g += g_first
            wp.atomic_add(out, b, i, j + 2, g_second)
            wp.atomic_add(out, b, i, j + 1, -g_second)
        wp.atomic_add(out, b, i, j + 1, g)
        wp.atomic_add(out, b, i, j, -g)
    if i + 1 < n_i and j + 1 < n_j:
        x10 = x[b, i + 1, j]
        x01 = x[b, i, j + 1]
        x11 = x[b, i + 1, j + 1]
        f00 = wp.vec3()
        f10 = wp.vec3()
        f01 = wp.vec3()
        f11 = wp.vec3()
        for s in range(2):
            e = difference(x10, x00)
            if s == 1:
                e = difference(x11, x01)
            length_e = edge_length(e)
            p = e / length_e
            g_e = wp.vec3()
            for t in range(2):
                h = difference(x01, x00)
                if t == 1:
                    h = difference(x11, x10)
                length_h = edge_length(h)
                q = h / length_h
                c = wp.clamp(wp.dot(p, q), -_MAX_COSINE, _MAX_COSINE)
                w = shearing * wp.asin(c) / wp.sqrt(1.0 - c * c)
                g_e += w / length_e * (q - c * p)
                g_h = w / length_h * (p - c * q)
                if t == 0:
                    f01 += g_h
                    f00 -= g_h
                else:
                    f11 += g_h
                    f10 -= g_h
            if s == 0:
                f10 += g_e
                f00 -= g_e
            else:
                f11 += g_e
                f01 -= g_e
        wp.atomic_add(out, b, i, j, f00)
        wp.atomic_add(out, b, i + 1, j, f10)
        wp.atomic_add(out, b, i, j + 1, f01)
        wp.atomic_add(out, b, i + 1, j + 1, f11)


@wp.func
def squared_bending_angle(x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d):
    """θ² of two consecutive edges, by its series where cosines lose their digits."""
    p = difference(x1, x0)
    p = p / edge_length(p)
    q = difference(x2, x1)
    q = q / edge_length(q)
    defect = wp.min(0.5 * wp.dot(p - q, p - q), 2.0)
    squared = defect * (2.0 + defect * (1.0 / 3.0 + defect * (4.0 / 45.0 + defect / 35.0)))
    if defect >= 0.1:
        angle = wp.acos(1.0 - defect)
        squared = angle * angle
    return squared


@wp.kernel(enable_backward=False)
def energy_kernel(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    stiffness: wp.array(dtype=wp.vec3),
    rest_i: wp.array(dtype=wp.float32, ndim=3),
    rest_j: wp.array(dtype=wp.float32, ndim=3),
    out: wp.array(dtype=wp.float64, ndim=2),
):
    """Add stretching, shearing and bending energy to out (B, 3)."""
    b, i, j = wp.tid()
    n_i = x.shape[1]
    n_j = x.shape[2]
    x00 = x[b, i, j]
    stretch = wp.float32(0.0)
    shear = wp.float32(0.0)
    bend = wp.float32(0.0)
    if i + 1 < n_i:
        away = stretch_of(x[b, i + 1, j], x00, rest_i[b, i, j])
        stretch += away * away
        if i + 2 < n_i:
            bend += squared_bending_angle(x00, x[b, i + 1, j], x[b, i + 2, j])
    if j + 1 < n_j:
        away = stretch_of(x[b, i, j + 1], x00, rest_j[b, i, j])
        stretch += away * away
        if j + 2 < n_j:
            bend += squared_bending_angle(x00, x[b, i, j + 1], x[b, i, j + 2])
    if i + 1 < n_i and j + 1 < n_j:
        for s in range(2):
            e = difference(x[b, i + 1, j + s], x[b, i, j + s])
            p = e / edge_length(e)
            for t in range(2):
                h = difference(x[b, i + t, j + 1], x[b, i + t, j])
                angle = wp.asin(wp.clamp(wp.dot(p, h) / edge_length(h), -_MAX_COSINE, _MAX_COSINE))
                shear += angle * angle
    wp.atomic_add(out, b, 0, wp.float64(0.5 * stiffness[b][0] * stretch))
    wp.atomic_add(out, b, 1, wp.float64(0.5 * stiffness[b][1] * shear))
    wp.atomic_add(out, b, 2, wp.float64(0.5 * stiffness[b][2] * bend))


@wp.func
def vertex_of(x: wp.array(dtype=wp.vec3d, ndim=3), axis: wp.int32, b: wp.int32, line: wp.int32, k: wp.int32):
    """Vertex k of a grid line along the axis."""
    if axis == 0:
        return x[b, k, line]
    return x[b, line, k]


@wp.func
def tangent_of(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    axis: wp.int32,
    b: wp.int32,
    line: wp.int32,
    k: wp.int32,
    n: wp.int32,
):
    """Unit tangent of a grid line at its vertex k."""
    t = difference(
        vertex_of(x, axis, b, line, wp.min(k + 1, n - 1)), vertex_of(x, axis, b, line, wp.max(k - 1, 0))
    )
    return t / edge_length(t)


@wp.kernel(enable_backward=False)
def tangential_relaxation_kernel(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    stiffness: wp.array(dtype=wp.vec3),
    residual: wp.array(dtype=wp.vec3, ndim=3),
    masses: wp.array(dtype=wp.float32, ndim=2),
    free: wp.array(dtype=wp.float32, ndim=3),
    axis: wp.int32,
    work: wp.array(dtype=wp.float32, ndim=4),
    out: wp.array(dtype=wp.vec3, ndim=3),
):
    """Add, for one grid line a thread, the displacement along its tangents that its own springs allow."""
    b, line = wp.tid()
    n = x.shape[1]
    n_lines = x.shape[2]
    if axis == 1:
        n = x.shape[2]
        n_lines = x.shape[1]
    stretching = stiffness[b][0]
    # Neighbouring lines are taken as fixed: shearing and in-plane bending across lines hold a vertex back.
    crosswise = 8.0 * stiffness[b][1] + 10.0 * stiffness[b][2]
    if line == 0 or line == n_lines - 1:
        crosswise = 2.0 * stiffness[b][1] + 5.0 * stiffness[b][2]
    # work[..., 0 / 1 / 2]: diagonal, coupling to the next vertex, right-hand side.
    for k in range(n):
        t = tangent_of(x, axis, b, line, k, n)
        here = vertex_of(x, axis, b, line, k)
        # So do their springs as far as they lie along the tangent.
        across = wp.float32(0.0)
        if line > 0:
            e = difference(here, vertex_of(x, axis, b, line - 1, k))
            across += wp.dot(e, t) * wp.dot(e, t) / wp.dot(e, e)
        if line < n_lines - 1:
            e = difference(here, vertex_of(x, axis, b, line + 1, k))
            across += wp.dot(e, t) * wp.dot(e, t) / wp.dot(e, e)
        moves = free[b, k, line]
        m = masses[k, line]
        if axis == 1:
            moves = free[b, line, k]
            m = masses[line, k]
        work[b, line, k, 0] = moves * (m + crosswise + 2.0 * stretching * across) + 1.0 - moves
        work[b, line, k, 1] = 0.0
        r = residual[b, k, line]
        if axis == 1:
            r = residual[b, line, k]
        work[b, line, k, 2] = wp.dot(t, r) * moves
    for k in range(n - 1):
        moves0 = free[b, k, line]
        moves1 = free[b, k + 1, line]
        if axis == 1:
            moves0 = free[b, line, k]
            moves1 = free[b, line, k + 1]
        e = difference(vertex_of(x, axis, b, line, k + 1), vertex_of(x, axis, b, line, k))
        u = e / edge_length(e)
        c0 = wp.dot(u, tangent_of(x, axis, b, line, k, n)) * moves0
        c1 = wp.dot(u, tangent_of(x, axis, b, line, k + 1, n)) * moves1
        work[b, line, k, 0] = work[b, line, k, 0] + stretching * c0 * c0
        work[b, line, k + 1, 0] = work[b, line, k + 1, 0] + stretching * c1 * c1
        work[b, line, k, 1] = -stretching * c0 * c1
    for k in range(1, n):
        w = work[b, line, k - 1, 1] / work[b, line, k - 1, 0]
        work[b, line, k, 0] = work[b, line, k, 0] - w * work[b, line, k - 1, 1]
        work[b, line, k, 2] = work[b, line, k, 2] - w * work[b, line, k - 1, 2]
    s = wp.float32(0.0)
    for back in range(n):
        k = n - 1 - back
        s = (work[b, line, k, 2] - work[b, line, k, 1] * s) / work[b, line, k, 0]
        d = s * tangent_of(x, axis, b, line, k, n)
        if axis == 0:
            out[b, k, line] = out[b, k, line] + d * free[b, k, line]
        else:
            out[b, line, k] = out[b, line, k] + d * free[b, line, k]


# Unknowns along a line: three per vertex, coupled up to the second neighbour.
_BAND = 9


@wp.func
def add_line_block(
    band: wp.array(dtype=wp.float32, ndim=4),
    b: wp.int32,
    line: wp.int32,
    p: wp.int32,
    q: wp.int32,
    block: wp.mat33,
):
    """Add the block of vertices p >= q of a line to its lower band, stored by columns."""
    for r in range(3):
        for c in range(3):
            row = 3 * p + r
            column = 3 * q + c
            if row >= column:
                band[b, line, column, row - column] = band[b, line, column, row - column] + block[r, c]


@wp.kernel(enable_backward=False)
def line_relaxation_kernel(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    stiffness: wp.array(dtype=wp.vec3),
    residual: wp.array(dtype=wp.vec3, ndim=3),
    rest_along: wp.array(dtype=wp.float32, ndim=3),
    rest_across: wp.array(dtype=wp.float32, ndim=3),
    masses: wp.array(dtype=wp.float32, ndim=2),
    free: wp.array(dtype=wp.float32, ndim=3),
    axis: wp.int32,
    band: wp.array(dtype=wp.float32, ndim=4),
    out: wp.array(dtype=wp.vec3, ndim=3),
):
    """Newton step of one grid line a thread, neighbouring lines held still; banded Cholesky."""
    b, line = wp.tid()
    n = x.shape[1]
    n_lines = x.shape[2]
    if axis == 1:
        n = x.shape[2]
        n_lines = x.shape[1]
    stretching = stiffness[b][0]
    shearing = stiffness[b][1]
    bending = stiffness[b][2]
    identity = wp.identity(n=3, dtype=wp.float32)
    for k in range(3 * n):
        for d in range(_BAND):
            band[b, line, k, d] = 0.0
    before = wp.max(line - 1, 0)
    after = wp.min(line + 1, n_lines - 1)
    cells = wp.float32(after - before)
    for k in range(n):
        moves = free[b, k, line]
        m = masses[k, line]
        if axis == 1:
            moves = free[b, line, k]
            m = masses[line, k]
        here = vertex_of(x, axis, b, line, k)
        block = (m * moves + 1.0 - moves) * identity
        for side in range(2):
            other = line - 1 + 2 * side
            if other >= 0 and other < n_lines:
                e = difference(vertex_of(x, axis, b, other, k), here)
                length = edge_length(e)
                along = wp.outer(e / length, e / length)
                edge = wp.min(line, other)
                rest = rest_across[b, k, edge]
                if axis == 1:
                    rest = rest_across[b, edge, k]
                pull = wp.max(stretching * (length - rest) / length, 0.0)
                transverse = pull + 2.0 * shearing + 2.0 * bending
                block += moves * (stretching * along + transverse * (identity - along))
        add_line_block(band, b, line, k, k, block)
        if k + 1 < n:
            moves1 = free[b, k + 1, line]
            rest = rest_along[b, k, line]
            if axis == 1:
                moves1 = free[b, line, k + 1]
                rest = rest_along[b, line, k]
            e = difference(vertex_of(x, axis, b, line, k + 1), here)
            length = edge_length(e)
            u = e / length
            along = wp.outer(u, u)
            # Direction in the cloth across the edge: what shearing resists.
            w = difference(vertex_of(x, axis, b, after, k), vertex_of(x, axis, b, before, k)) + difference(
                vertex_of(x, axis, b, after, k + 1), vertex_of(x, axis, b, before, k + 1)
            )
            w = w - wp.dot(w, u) * u
            w = w / edge_length(w)
            pull = wp.max(stretching * (length - rest) / length, 0.0)
            spring = stretching * along + pull * (identity - along)
            spring += 2.0 * cells * shearing / (length * length) * wp.outer(w, w)
            add_line_block(band, b, line, k, k, moves * spring)
            add_line_block(band, b, line, k + 1, k + 1, moves1 * spring)
            add_line_block(band, b, line, k + 1, k, -moves * moves1 * spring)
            if k + 2 < n:
                moves2 = free[b, k + 2, line]
                if axis == 1:
                    moves2 = free[b, line, k + 2]
                h = difference(vertex_of(x, axis, b, line, k + 2), vertex_of(x, axis, b, line, k + 1))
                length_h = edge_length(h)
                t = u + h / length_h
                t = t / edge_length(t)
                angle = bending / (length * length_h) * (identity - wp.outer(t, t))
                add_line_block(band, b, line, k, k, moves * angle)
                add_line_block(band, b, line, k + 1, k + 1, 4.0 * moves1 * angle)
                add_line_block(band, b, line, k + 2, k + 2, moves2 * angle)
                add_line_block(band, b, line, k + 1, k, -2.0 * moves * moves1 * angle)
                add_line_block(band, b, line, k + 2, k + 1, -2.0 * moves1 * moves2 * angle)
                add_line_block(band, b, line, k + 2, k, moves * moves2 * angle)
    # Factorise in place (the diagonal is kept inverted) and substitute forward on the way.
    size = 3 * n
    for c in range(size):
        k = c / 3
        value = wp.float32(0.0)
        if axis == 0:
            value = residual[b, k, line][c - 3 * k] * free[b, k, line]
        else:
            value = residual[b, line, k][c - 3 * k] * free[b, line, k]
        for d in range(1, wp.min(_BAND - 1, c) + 1):
            value -= band[b, line, c - d, d] * band[b, line, c - d, _BAND]
        inverse = 1.0 / wp.sqrt(wp.max(band[b, line, c, 0], 1.0e-6))
        band[b, line, c, 0] = inverse
        band[b, line, c, _BAND] = value * inverse
        top = wp.min(_BAND - 1, size - 1 - c)
        for d in range(1, top + 1):
            band[b, line, c, d] = band[b, line, c, d] * inverse
        for d in range(1, top + 1):
            factor = band[b, line, c, d]
            for q in range(d, top + 1):
                band[b, line, c + d, q - d] = band[b, line, c + d, q - d] - factor * band[b, line, c, q]
    for back in range(size):
        c = size - 1 - back
        value = band[b, line, c, _BAND]
        for d in range(1, wp.min(_BAND - 1, size - 1 - c) + 1):
            value -= band[b, line, c, d] * band[b, line, c + d, _BAND]
        band[b, line, c, _BAND] = value * band[b, line, c, 0]
    for k in range(n):
        step = wp.vec3(
            band[b, line, 3 * k, _BAND], band[b, line, 3 * k + 1, _BAND], band[b, line, 3 * k + 2, _BAND]
        )
        if axis == 0:
            out[b, k, line] = step * free[b, k, line]
        else:
            out[b, line, k] = step * free[b, line, k]


@wp.func
def asinh(v: wp.float32):
    """Inverse hyperbolic sine: linear near zero, logarithmic far away."""
    a = wp.abs(v)
    return wp.sign(v) * wp.log(a + wp.sqrt(a * a + 1.0))


@wp.kernel(enable_backward=False)
def tension_kernel(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    stiffness: wp.array(dtype=wp.vec3),
    rest_i: wp.array(dtype=wp.float32, ndim=3),
    rest_j: wp.array(dtype=wp.float32, ndim=3),
    out: wp.array(dtype=wp.float32, ndim=4),
):
    """Tensions of the edges along i and along j that begin at a vertex, and the sum of the pulling ones."""
    b, i, j = wp.tid()
    y = stiffness[b][0]
    x00 = x[b, i, j]
    pull = wp.float32(0.0)
    t_i = wp.float32(0.0)
    t_j = wp.float32(0.0)
    if i + 1 < x.shape[1]:
        t_i = y * stretch_of(x[b, i + 1, j], x00, rest_i[b, i, j])
        pull += wp.max(t_i, 0.0)
    if i > 0:
        pull += wp.max(y * stretch_of(x00, x[b, i - 1, j], rest_i[b, i - 1, j]), 0.0)
    if j + 1 < x.shape[2]:
        t_j = y * stretch_of(x[b, i, j + 1], x00, rest_j[b, i, j])
        pull += wp.max(t_j, 0.0)
    if j > 0:
        pull += wp.max(y * stretch_of(x00, x[b, i, j - 1], rest_j[b, i, j - 1]), 0.0)
    out[b, i, j, 0] = pull
    out[b, i, j, 1] = t_i
    out[b, i, j, 2] = t_j


@wp.kernel(enable_backward=False)
def vertex_inputs_kernel(
    x: wp.array(dtype=wp.vec3d, ndim=3),
    residual: wp.array(dtype=wp.vec3, ndim=3),
    tension: wp.array(dtype=wp.float32, ndim=4),
    pinned: wp.array(dtype=wp.float32, ndim=3),
    masses: wp.array(dtype=wp.float32, ndim=2),
    stiffness: wp.array(dtype=wp.vec3),
    level: wp.int32,
    frames: wp.array(dtype=wp.vec3, ndim=4),
    out: wp.array(dtype=wp.float32, ndim=4),
):
    """Local frame of every vertex and what the network sees there; see ``vertex_inputs``."""
    b, i, j = wp.tid()
    n_i = x.shape[1]
    n_j = x.shape[2]
    i0 = wp.max(i - 1, 0)
    i1 = wp.min(i + 1, n_i - 1)
    j0 = wp.max(j - 1, 0)
    j1 = wp.min(j + 1, n_j - 1)
    spacing = wp.pow(2.0, wp.float32(level))
    a = difference(x[b, i1, j], x[b, i0, j]) / (wp.float32(wp.max(i1 - i0, 1)) * spacing)
    c = difference(x[b, i, j1], x[b, i, j0]) / (wp.float32(wp.max(j1 - j0, 1)) * spacing)
    length_a = edge_length(a)
    length_c = edge_length(c)
    # The orthonormal pair that treats both tangents alike.
    p = wp.normalize(a / length_a + c / length_c)
    q = a / length_a - c / length_c
    q = wp.normalize(q - wp.dot(q, p) * p)
    half = 0.70710678
    u = half * (p + q)
    v = half * (p - q)
    n = wp.cross(q, p)
    frames[b, i, j, 0] = u
    frames[b, i, j, 1] = v
    frames[b, i, j, 2] = n
    r = residual[b, i, j]
    r_u = wp.dot(u, r)
    r_v = wp.dot(v, r)
    r_n = wp.dot(n, r)
    area = spacing * spacing
    pull = tension[b, i, j, 0]
    bending = 12.0 * stiffness[b][2] / (area * area)
    in_plane = 1.0 + (2.0 * stiffness[b][0] + 4.0 * stiffness[b][1]) / area + bending
    normal = 1.0 + pull / area + bending
    out[b, i, j, 0] = r_u
    out[b, i, j, 1] = r_v
    out[b, i, j, 2] = r_n
    out[b, i, j, 3] = r_u / in_plane
    out[b, i, j, 4] = r_v / in_plane
    out[b, i, j, 5] = r_n / normal
    out[b, i, j, 6] = 0.3 * wp.log(1.0 + pull)
    out[b, i, j, 7] = length_a - 1.0
    out[b, i, j, 8] = length_c - 1.0
    out[b, i, j, 9] = wp.dot(a, c)
    out[b, i, j, 10] = pinned[b, i, j]
    if level == 0:
        out[b, i, j, 11] = asinh(tension[b, i, j, 1])
        out[b, i, j, 12] = asinh(tension[b, i, j, 2])
        bend_i = wp.vec3()
        bend_j = wp.vec3()
        if i > 0 and i + 1 < n_i:
            bend_i = difference(x[b, i + 1, j], x[b, i, j]) - difference(x[b, i, j], x[b, i - 1, j])
        if j > 0 and j + 1 < n_j:
            bend_j = difference(x[b, i, j + 1], x[b, i, j]) - difference(x[b, i, j], x[b, i, j - 1])
        out[b, i, j, 13] = wp.dot(u, bend_i)
        out[b, i, j, 14] = wp.dot(v, bend_i)
        out[b, i, j, 15] = wp.dot(n, bend_i)
        out[b, i, j, 16] = wp.dot(u, bend_j)
        out[b, i, j, 17] = wp.dot(v, bend_j)
        out[b, i, j, 18] = wp.dot(n, bend_j)
        out[b, i, j, 19] = masses[i, j]


def _launch(kernel: Any, n_threads: tuple[int, ...], *arguments: Tensor | int) -> None:
    """Launch on the device of the first tensor.

    What a kernel takes as vectors follows from its own signature. Bare array descriptors cost a fraction of
    wp.array objects; the tensors behind them are kept until the launch is over.
    """
    kept = [a.detach().contiguous() if isinstance(a, Tensor) else a for a in arguments]
    given: list[Any] = []
    for argument, declared in zip(kept, kernel.adj.args, strict=True):
        if isinstance(argument, Tensor):
            dtype = declared.type.dtype
            given.append(wp.from_torch(argument, dtype=dtype, return_ctype=True))
        else:
            given.append(argument)
    device = next(a for a in kept if isinstance(a, Tensor)).device
    stream = wp.stream_from_torch(device) if device.type == "cuda" else None
    wp.launch(kernel, dim=n_threads, inputs=given, device=str(wp.device_from_torch(device)), stream=stream)


def energy_gradient(positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
    """Gradient of E = E_Y + E_S + E_B (paper, Eqs. 5 to 9), all rest angles right or straight.

    Args:
        positions: (B, H, W, 3) float64.
        stiffness: (B, 3).
        rest_i: rest lengths along grid axis 0, (B, H-1, W).
        rest_j: rest lengths along grid axis 1, (B, H, W-1).

    Returns:
        (B, H, W, 3).
    """
    x = positions.double().contiguous()
    out = torch.zeros(x.shape, dtype=torch.float32, device=x.device)
    _launch(energy_gradient_kernel, tuple(x.shape[:3]), x, stiffness, rest_i, rest_j, out)
    return out


def energies(positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
    """Stretching, shearing and bending energy, (B, 3) float64; arguments as in ``energy_gradient``."""
    x = positions.double().contiguous()
    out = torch.zeros(len(x), 3, dtype=torch.float64, device=x.device)
    _launch(energy_kernel, tuple(x.shape[:3]), x, stiffness, rest_i, rest_j, out)
    return out


def tangential_relaxation(
    positions: Tensor, stiffness: Tensor, residual: Tensor, masses: Tensor, free: Tensor
) -> Tensor:
    """Displacement along warp and weft tangents that settles stretching along each grid line.

    Every line's displacements s_k along its own tangents t_k solve a tridiagonal system: the quadratic model
    of Φ in this subspace, neighbouring lines held still. What is left for the network is the soft part.

    Args:
        positions: (B, H, W, 3) float64.
        stiffness: (B, 3).
        residual: -∇Φ (B, H, W, 3), zero at pinned vertices.
        masses: (H, W).
        free: (B, H, W), 1 or 0.

    Returns:
        (B, H, W, 3), zero at pinned vertices.
    """
    x = positions.double().contiguous()
    batch, height, width, _ = x.shape
    out = torch.zeros(x.shape, dtype=torch.float32, device=x.device)
    work = torch.empty(batch, max(height, width), max(height, width), 3, device=x.device)
    for axis, n_lines in ((0, width), (1, height)):
        _launch(
            tangential_relaxation_kernel,
            (batch, n_lines),
            x,
            stiffness,
            residual,
            masses,
            free,
            axis,
            work,
            out,
        )
    return out


def line_relaxation(
    positions: Tensor,
    stiffness: Tensor,
    residual: Tensor,
    rest_i: Tensor,
    rest_j: Tensor,
    masses: Tensor,
    free: Tensor,
    axis: int,
) -> Tensor:
    """Newton step of every grid line along one axis for itself, its neighbours held still.

    Stretching, shearing and bending along the line in all three directions, with the convex part of the
    Hessian (banded Cholesky, one line a thread); neighbours enter as springs to fixed points.

    Args:
        positions: (B, H, W, 3) float64.
        stiffness: (B, 3).
        residual: -∇Φ (B, H, W, 3), zero at pinned vertices.
        rest_i: rest lengths along grid axis 0, (B, H-1, W).
        rest_j: rest lengths along grid axis 1, (B, H, W-1).
        masses: (H, W).
        free: (B, H, W), 1 or 0.
        axis: 0 for the lines along i, 1 for those along j.

    Returns:
        (B, H, W, 3), zero at pinned vertices.
    """
    x = positions.double().contiguous()
    batch, height, width, _ = x.shape
    out = torch.empty(x.shape, dtype=torch.float32, device=x.device)
    n, n_lines = (height, width) if axis == 0 else (width, height)
    # One column more than the band for the right-hand side.
    band = torch.empty(batch, n_lines, 3 * n, _BAND + 1, device=x.device)
    along, across = (rest_i, rest_j) if axis == 0 else (rest_j, rest_i)
    threads = (batch, n_lines)
    _launch(
        line_relaxation_kernel, threads, x, stiffness, residual, along, across, masses, free, axis, band, out
    )
    return out


def tensions(positions: Tensor, stiffness: Tensor, rest_i: Tensor, rest_j: Tensor) -> Tensor:
    """(B, H, W, 3): sum of the pulling tensions at a vertex, tension of its edges to i + 1 and to j + 1."""
    x = positions.double().contiguous()
    out = torch.empty(*x.shape[:3], 3, device=x.device)
    _launch(tension_kernel, tuple(x.shape[:3]), x, stiffness, rest_i, rest_j, out)
    return out


def n_inputs(level: int) -> int:
    """Number of input channels of a level of the network."""
    return _N_GEOMETRY if level == 0 else _N_COARSE


def vertex_inputs(
    positions: Tensor,
    residual: Tensor,
    tension: Tensor,
    pinned: Tensor,
    masses: Tensor,
    stiffness: Tensor,
    level: int,
) -> tuple[Tensor, Tensor]:
    """Local frames and inputs of the network on a grid coarsened ``level`` times by two.

    Everything is seen in the frame of the vertex (warp and weft tangent made orthonormal, normal), so that
    the network is equivariant under rotation and translation by construction.

    Args:
        positions: (B, h, w, 3) float64.
        residual: (B, h, w, 3).
        tension: (B, h, w, 3), see ``tensions``.
        pinned: (B, h, w), share of pinned vertices.
        masses: (h, w), read at level 0 only.
        stiffness: (B, 3).
        level: 0 is the cloth's own grid.

    Returns:
        Frames (B, h, w, 3, 3), rows u, v, n; inputs (B, h, w, C): residual along u, v, n (0 to 2), the same
        over an estimate of the local stiffness, a displacement (3 to 5), pulling tension (6), metric of the
        surface (7 to 9), pinned (10); at level 0 also tensions (11, 12), second differences along i and j (13
        to 18) and mass (19).
    """
    x = positions.double().contiguous()
    frames = torch.empty(*x.shape[:3], 3, 3, device=x.device)
    out = torch.empty(*x.shape[:3], n_inputs(level), device=x.device)
    _launch(
        vertex_inputs_kernel,
        tuple(x.shape[:3]),
        x,
        residual,
        tension,
        pinned,
        masses,
        stiffness,
        level,
        frames,
        out,
    )
    return frames, out
