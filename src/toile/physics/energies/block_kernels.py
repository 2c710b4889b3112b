"""What the kernels of all energies share: 3×3 blocks of the Hessian, and what is wanted of it."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

import warp as wp

# What a derivatives kernel adds besides the gradient.
GRADIENT_ONLY = 0
EXACT_HESSIAN = 1
CONVEX_HESSIAN = 2


@wp.func
def outer_block(u: wp.vec3d, a: wp.vec3d, v: wp.vec3d, b: wp.vec3d, diagonal: wp.float64):
    """The block u aᵀ + v bᵀ + diagonal I."""
    return wp.mat33d(
        u[0] * a[0] + v[0] * b[0] + diagonal,
        u[0] * a[1] + v[0] * b[1],
        u[0] * a[2] + v[0] * b[2],
        u[1] * a[0] + v[1] * b[0],
        u[1] * a[1] + v[1] * b[1] + diagonal,
        u[1] * a[2] + v[1] * b[2],
        u[2] * a[0] + v[2] * b[0],
        u[2] * a[1] + v[2] * b[1],
        u[2] * a[2] + v[2] * b[2] + diagonal,
    )


@wp.func
def add_block(blocks: wp.array(dtype=wp.mat33d), slot: wp.int32, block: wp.mat33d):
    """Add ∂²E/∂x_p∂x_q to its place; a slot of -1 - n says that place n holds the transpose."""
    if slot >= 0:
        wp.atomic_add(blocks, slot, block)
    else:
        wp.atomic_add(blocks, -1 - slot, wp.transpose(block))
