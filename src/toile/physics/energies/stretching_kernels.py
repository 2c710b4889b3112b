"""Warp kernels of the stretching energy (paper, Eq. 7)."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

import warp as wp

from toile.physics.energies.block_kernels import CONVEX_HESSIAN, GRADIENT_ONLY, add_block, outer_block


@wp.func
def edge_terms(d: wp.vec3d, rest: wp.float64):
    """Length, direction and stretch (length - rest) of an edge vector."""
    length = wp.max(wp.length(d), wp.float64(1.0e-12))
    return length, d / length, length - rest


@wp.func
def add_edge(
    length: wp.float64,
    u: wp.vec3d,
    stretch: wp.float64,
    p: wp.int32,
    q: wp.int32,
    e: wp.int32,
    weight: wp.float64,
    term: wp.int32,
    coefficients: wp.array(dtype=wp.float64),
    order: wp.int32,
    slots: wp.array(dtype=wp.int32, ndim=2),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """Add the derivatives of ½ w (‖e‖ - L₀)² for one edge of the terms of ``edge_terms``."""
    g = weight * stretch * u
    wp.atomic_add(gradients, term, q, g)
    wp.atomic_add(gradients, term, p, -g)
    if order == wp.static(GRADIENT_ONLY):
        return
    scale = coefficients[term] * weight
    transverse = stretch / length
    if order == wp.static(CONVEX_HESSIAN):
        transverse = wp.max(transverse, wp.float64(0.0))
    none = wp.vec3d()
    diagonal = scale * transverse
    a = (scale - diagonal) * u
    own = outer_block(u, a, none, none, diagonal)
    add_block(blocks, slots[e, 0], own)
    add_block(blocks, slots[e, 1], own)
    add_block(blocks, slots[e, 2], outer_block(u, -a, none, none, -diagonal))


@wp.kernel(enable_backward=False)
def stretching_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add Σ ½ w (‖e‖ - L₀)²."""
    e = wp.tid()
    _length, _direction, stretch = edge_terms(x[stencil[e, 1]] - x[stencil[e, 0]], rest[e, 0])
    wp.atomic_add(out, first, wp.float64(0.5) * factors[e] * stretch * stretch)


@wp.kernel(enable_backward=False)
def stretching_derivatives(
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
    p = stencil[e, 0]
    q = stencil[e, 1]
    length, u, stretch = edge_terms(x[q] - x[p], rest[e, 0])
    weight = factors[e]
    add_edge(length, u, stretch, p, q, e, weight, first, coefficients, order, slots, gradients, blocks)
