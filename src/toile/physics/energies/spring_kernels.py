"""Warp kernels of springs with a compression ratio."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

import warp as wp

from toile.physics.energies.stretching_kernels import add_edge, edge_terms


@wp.func
def add_spring_energy(
    x: wp.array(dtype=wp.vec3d),
    p: wp.int32,
    q: wp.int32,
    rest: wp.float64,
    weight: wp.float64,
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add ½ w (‖e‖ - L₀)² to the energy in tension (first) or in compression (first + 1)."""
    _length, _direction, stretch = edge_terms(x[q] - x[p], rest)
    term = first
    if stretch < wp.float64(0.0):
        term = first + 1
    wp.atomic_add(out, term, wp.float64(0.5) * weight * stretch * stretch)


@wp.func
def add_spring(
    x: wp.array(dtype=wp.vec3d),
    p: wp.int32,
    q: wp.int32,
    e: wp.int32,
    rest: wp.float64,
    weight: wp.float64,
    first: wp.int32,
    coefficients: wp.array(dtype=wp.float64),
    order: wp.int32,
    slots: wp.array(dtype=wp.int32, ndim=2),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """Add the derivatives of one spring."""
    length, u, stretch = edge_terms(x[q] - x[p], rest)
    term = first
    if stretch < wp.float64(0.0):
        term = first + 1
    add_edge(length, u, stretch, p, q, e, weight, term, coefficients, order, slots, gradients, blocks)


@wp.func
def diagonal_weight(factor: wp.float64, rest: wp.float64):
    """Of a diagonal's squared change of length: see DiagonalShearing."""
    return factor * wp.float64(4.0) / (rest * rest)


@wp.kernel(enable_backward=False)
def edge_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """See TermKernels.energies."""
    e = wp.tid()
    add_spring_energy(x, stencil[e, 0], stencil[e, 1], rest[e, 0], factors[e], first, out)


@wp.kernel(enable_backward=False)
def edge_derivatives(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    coefficients: wp.array(dtype=wp.float64),
    order: wp.int32,
    slots: wp.array(dtype=wp.int32, ndim=2),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """See TermKernels.derivatives."""
    e = wp.tid()
    p, q = stencil[e, 0], stencil[e, 1]
    add_spring(x, p, q, e, rest[e, 0], factors[e], first, coefficients, order, slots, gradients, blocks)


@wp.kernel(enable_backward=False)
def diagonal_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """See TermKernels.energies."""
    e = wp.tid()
    weight = diagonal_weight(factors[e], rest[e, 0])
    add_spring_energy(x, stencil[e, 0], stencil[e, 1], rest[e, 0], weight, first, out)


@wp.kernel(enable_backward=False)
def diagonal_derivatives(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    coefficients: wp.array(dtype=wp.float64),
    order: wp.int32,
    slots: wp.array(dtype=wp.int32, ndim=2),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """See TermKernels.derivatives."""
    e = wp.tid()
    p, q = stencil[e, 0], stencil[e, 1]
    weight = diagonal_weight(factors[e], rest[e, 0])
    add_spring(x, p, q, e, rest[e, 0], weight, first, coefficients, order, slots, gradients, blocks)
