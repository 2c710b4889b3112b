"""Warp kernels of the membrane energies, as functions of the entries c = (C₁₁, C₁₂, C₂₂) of FᵀF.

With f₁, f₂ the columns of F and ψ_i, ψ_ij the derivatives of the energy per area by the entries,

    ∂ψ/∂f₁ = 2 ψ₁ f₁ + ψ₂ f₂,   ∂ψ/∂f₂ = ψ₂ f₁ + 2 ψ₃ f₂,
    ∂²ψ/∂f_a∂f_b = Σ_ij ψ_ij (∂c_i/∂f_a) (∂c_j/∂f_b)ᵀ + S_ab I,   S = [2 ψ₁, ψ₂; ψ₂, 2 ψ₃].

The convex Hessian keeps the tensile part of the stress S and a positive semi-definite part of ψ_ij.
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

import warp as wp

from toile.physics.energies.block_kernels import CONVEX_HESSIAN, GRADIENT_ONLY, add_block

# Ratio of areas below which a triangle is treated as if at this one: there is no normal at a collapse.
_MIN_AREA_RATIO = 1.0e-6


@wp.func
def columns_of_gradient(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    e: wp.int32,
):
    """The two columns of F."""
    first = x[stencil[e, 1]] - x[stencil[e, 0]]
    second = x[stencil[e, 2]] - x[stencil[e, 0]]
    return rest[e, 0] * first, rest[e, 1] * first + rest[e, 2] * second


@wp.func
def tensile_part(s11: wp.float64, s12: wp.float64, s22: wp.float64):
    """The symmetric 2×2 matrix without its negative eigenvalues, as (11, 12, 22)."""
    half = wp.float64(0.5) * (s11 + s22)
    away = wp.float64(0.5) * (s11 - s22)
    radius = wp.sqrt(away * away + s12 * s12)
    if half >= radius:
        return s11, s12, s22
    if half + radius <= wp.float64(0.0):
        return wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    # One positive eigenvalue: it times the projection on its direction.
    scale = (half + radius) / (wp.float64(2.0) * radius)
    return scale * (radius + away), scale * s12, scale * (radius - away)


@wp.func
def add_membrane(
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    e: wp.int32,
    f1: wp.vec3d,
    f2: wp.vec3d,
    stress: wp.vec3d,
    second: wp.mat33d,
    slots: wp.array(dtype=wp.int32, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """Add the Hessian for given S = (11, 12, 22) and ψ_ij, both times the weight of the element."""
    none = wp.vec3d()
    # ∂c_i/∂f_a as the columns of two matrices.
    of_1 = wp.matrix_from_cols(wp.float64(2.0) * f1, f2, none)
    of_2 = wp.matrix_from_cols(none, f1, wp.float64(2.0) * f2)
    one = wp.identity(n=3, dtype=wp.float64)
    h11 = of_1 * second * wp.transpose(of_1) + stress[0] * one
    h12 = of_1 * second * wp.transpose(of_2) + stress[1] * one
    h22 = of_2 * second * wp.transpose(of_2) + stress[2] * one
    h21 = wp.transpose(h12)
    # f_a = Σ_v b_va x_v
    b0 = wp.vec2d(-rest[e, 0], -rest[e, 1] - rest[e, 2])
    b1 = wp.vec2d(rest[e, 0], rest[e, 1])
    b2 = wp.vec2d(wp.float64(0.0), rest[e, 2])
    add_block(blocks, slots[e, 0], between(b0, b0, h11, h12, h21, h22))
    add_block(blocks, slots[e, 1], between(b1, b1, h11, h12, h21, h22))
    add_block(blocks, slots[e, 2], between(b2, b2, h11, h12, h21, h22))
    add_block(blocks, slots[e, 3], between(b0, b1, h11, h12, h21, h22))
    add_block(blocks, slots[e, 4], between(b0, b2, h11, h12, h21, h22))
    add_block(blocks, slots[e, 5], between(b1, b2, h11, h12, h21, h22))


@wp.func
def between(v: wp.vec2d, w: wp.vec2d, h11: wp.mat33d, h12: wp.mat33d, h21: wp.mat33d, h22: wp.mat33d):
    """Σ_ab v_a w_b h_ab."""
    return (v[0] * w[0]) * h11 + (v[0] * w[1]) * h12 + (v[1] * w[0]) * h21 + (v[1] * w[1]) * h22


@wp.func
def add_stress(
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    e: wp.int32,
    term: wp.int32,
    g1: wp.vec3d,
    g2: wp.vec3d,
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
):
    """Add the gradient for given ∂ψ/∂f₁ and ∂ψ/∂f₂, both times the weight of the element."""
    of_1 = rest[e, 0] * g1 + rest[e, 1] * g2
    of_2 = rest[e, 2] * g2
    wp.atomic_add(gradients, term, stencil[e, 1], of_1)
    wp.atomic_add(gradients, term, stencil[e, 2], of_2)
    wp.atomic_add(gradients, term, stencil[e, 0], -of_1 - of_2)


@wp.kernel(enable_backward=False)
def st_venant_kirchhoff_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add what multiplies λ and μ."""
    e = wp.tid()
    f1, f2 = columns_of_gradient(x, stencil, rest, e)
    half = wp.float64(0.5)
    e11 = half * (wp.dot(f1, f1) - wp.float64(1.0))
    e12 = half * wp.dot(f1, f2)
    e22 = half * (wp.dot(f2, f2) - wp.float64(1.0))
    weight = factors[e] * rest[e, 3]
    wp.atomic_add(out, first, weight * half * (e11 + e22) * (e11 + e22))
    wp.atomic_add(out, first + 1, weight * (e11 * e11 + wp.float64(2.0) * e12 * e12 + e22 * e22))


@wp.kernel(enable_backward=False)
def st_venant_kirchhoff_derivatives(
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
    f1, f2 = columns_of_gradient(x, stencil, rest, e)
    half = wp.float64(0.5)
    two = wp.float64(2.0)
    e11 = half * (wp.dot(f1, f1) - wp.float64(1.0))
    e12 = half * wp.dot(f1, f2)
    e22 = half * (wp.dot(f2, f2) - wp.float64(1.0))
    trace = e11 + e22
    weight = factors[e] * rest[e, 3]
    # Second Piola–Kirchhoff stress: λ tr E I + 2 μ E.
    add_stress(stencil, rest, e, first, weight * trace * f1, weight * trace * f2, gradients)
    mu_1 = two * weight * (e11 * f1 + e12 * f2)
    mu_2 = two * weight * (e12 * f1 + e22 * f2)
    add_stress(stencil, rest, e, first + 1, mu_1, mu_2, gradients)
    if order == wp.static(GRADIENT_ONLY):
        return
    lame = weight * coefficients[first]
    mu = weight * coefficients[first + 1]
    s11 = lame * trace + two * mu * e11
    s12 = two * mu * e12
    s22 = lame * trace + two * mu * e22
    if order == wp.static(CONVEX_HESSIAN):
        s11, s12, s22 = tensile_part(s11, s12, s22)
    quarter = wp.float64(0.25)
    zero = wp.float64(0.0)
    own = quarter * lame + half * mu
    second = wp.mat33d(own, zero, quarter * lame, zero, mu, zero, quarter * lame, zero, own)
    add_membrane(stencil, rest, e, f1, f2, wp.vec3d(s11, s12, s22), second, slots, blocks)


@wp.func
def area_ratio(c11: wp.float64, c12: wp.float64, c22: wp.float64):
    """J = √det C, not below _MIN_AREA_RATIO."""
    least = wp.static(_MIN_AREA_RATIO * _MIN_AREA_RATIO)
    return wp.sqrt(wp.max(c11 * c22 - c12 * c12, wp.float64(least)))


@wp.kernel(enable_backward=False)
def neo_hookean_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add what multiplies λ and μ."""
    e = wp.tid()
    f1, f2 = columns_of_gradient(x, stencil, rest, e)
    c11 = wp.dot(f1, f1)
    c12 = wp.dot(f1, f2)
    c22 = wp.dot(f2, f2)
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    e11 = half * (c11 - one)
    e12 = half * c12
    e22 = half * (c22 - one)
    trace = e11 + e22
    determinant = e11 * e22 - e12 * e12
    below = one + area_ratio(c11, c12, c22)
    # J - 1 and (tr C - 2) / 2 - (J - 1) without the cancellation at small strains, which Newton's line
    # search would stumble over.
    away = wp.float64(2.0) * (trace + wp.float64(2.0) * determinant) / below
    volume = half * away * away
    weight = factors[e] * rest[e, 3]
    wp.atomic_add(out, first, weight * volume)
    shape = (trace * away - wp.float64(4.0) * determinant) / below
    wp.atomic_add(out, first + 1, weight * (shape + volume))


@wp.kernel(enable_backward=False)
def neo_hookean_derivatives(
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
    f1, f2 = columns_of_gradient(x, stencil, rest, e)
    c11 = wp.dot(f1, f1)
    c12 = wp.dot(f1, f2)
    c22 = wp.dot(f2, f2)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    ratio = area_ratio(c11, c12, c22)
    away = ratio - one
    weight = factors[e] * rest[e, 3]
    # ∂J/∂f₁ and ∂J/∂f₂; those of (tr C - 2) / 2 are f₁ and f₂.
    j1 = (c22 * f1 - c12 * f2) / ratio
    j2 = (c11 * f2 - c12 * f1) / ratio
    add_stress(stencil, rest, e, first, weight * away * j1, weight * away * j2, gradients)
    beside = away - one
    mu_1 = weight * (f1 + beside * j1)
    mu_2 = weight * (f2 + beside * j2)
    add_stress(stencil, rest, e, first + 1, mu_1, mu_2, gradients)
    if order == wp.static(GRADIENT_ONLY):
        return
    mu = weight * coefficients[first + 1]
    volume = weight * coefficients[first] + mu
    # ψ = μ/2 (tr C - 2) - μ (J - 1) + volume/2 (J - 1)²
    by_j = volume * away - mu
    s11 = mu + by_j * c22 / ratio
    s12 = -by_j * c12 / ratio
    s22 = mu + by_j * c11 / ratio
    slope = wp.vec3d(c22, -two * c12, c11) / (two * ratio)
    curved = by_j
    if order == wp.static(CONVEX_HESSIAN):
        s11, s12, s22 = tensile_part(s11, s12, s22)
        # J is concave in the entries of C.
        curved = wp.min(by_j, wp.float64(0.0))
    zero = wp.float64(0.0)
    # ∂²J/∂c² = (∂² det C/∂c² / 2 - slope slopeᵀ) / J
    half_det = wp.mat33d(zero, zero, wp.float64(0.5), zero, -one, zero, wp.float64(0.5), zero, zero)
    second = (volume - curved / ratio) * wp.outer(slope, slope) + (curved / ratio) * half_det
    add_membrane(stencil, rest, e, f1, f2, wp.vec3d(s11, s12, s22), second, slots, blocks)
