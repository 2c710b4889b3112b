"""Warp kernels of the two energies of an angle: shearing (paper, Eq. 8) and bending (Eq. 9).

Both are functions of the cosine c of the angle between the edges u and v:

    ∂c/∂u   = (v̂ - c û) / |u|
    ∂²c/∂u² = (3 c ûûᵀ - v̂ûᵀ - ûv̂ᵀ - c I) / |u|²
    ∂²c/∂u∂v = (I - ûûᵀ)(I - v̂v̂ᵀ) / (|u| |v|) = (I - ûûᵀ - v̂v̂ᵀ + c ûv̂ᵀ) / (|u| |v|)
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

from itertools import accumulate

import warp as wp

from toile.physics.energies.block_kernels import CONVEX_HESSIAN, GRADIENT_ONLY, add_block, outer_block

# Below this sine an angle energy with a non-zero rest angle is treated as if at this sine: its true gradient
# has no direction at a complete fold.
_MIN_SINE = 1.0e-4

# Up to this squared sine the series below is exact to rounding (θ < 0.2).
_SERIES_LIMIT = 0.04

_N_TERMS = 12
# Of that series: 1/3, and each is the one before times (2n + 2) / (2n + 5).
_SERIES = wp.types.vector(length=_N_TERMS, dtype=wp.float64)(
    list(accumulate(range(_N_TERMS - 1), lambda a, n: a * (2 * n + 2) / (2 * n + 5), initial=1 / 3))
)


@wp.func
def straight_series(q: wp.float64):
    """(1 - θ cos θ / sin θ) / sin² θ as a series in q = sin² θ, without the cancellation of the quotient."""
    qq = q * q
    even = wp.float64(0.0)
    odd = wp.float64(0.0)
    # Two independent chains take half as long as one.
    for k in range(6):
        even = even * qq + wp.static(_SERIES)[10 - 2 * k]
        odd = odd * qq + wp.static(_SERIES)[11 - 2 * k]
    return even + q * odd


@wp.func
def angle_terms(u: wp.vec3d, v: wp.vec3d, rest: wp.float64):
    """Of ½ (θ - rest)², θ the angle between unit vectors: value, two derivatives by c = cos θ, c, sin² θ."""
    c = wp.dot(u, v)
    if wp.abs(c) < wp.float64(0.7):
        # Away from 0 and π the arc cosine is as accurate as the arc tangent, and cheaper.
        q = wp.float64(1.0) - c * c
        away = wp.acos(c) - rest
        g1 = -away / wp.sqrt(q)
        return wp.float64(0.5) * away * away, g1, (wp.float64(1.0) + g1 * c) / q, c, q
    normal = wp.cross(u, v)
    q = wp.dot(normal, normal)
    if rest == wp.float64(0.0) and c > wp.float64(0.0) and q < wp.float64(_SERIES_LIMIT):
        g2 = straight_series(q)
        g1 = (q * g2 - wp.float64(1.0)) / c
        return wp.float64(0.5) * g1 * g1 * q, g1, g2, c, q
    s = wp.sqrt(q)
    away = wp.atan2(s, c) - rest
    sine = wp.max(s, wp.float64(_MIN_SINE))
    g1 = -away / sine
    g2 = (wp.float64(1.0) + g1 * c) / (sine * sine)
    return wp.float64(0.5) * away * away, g1, g2, c, q


@wp.func
def angle_energy(
    x: wp.array(dtype=wp.vec3d), i: wp.int32, k: wp.int32, j: wp.int32, sign: wp.float64, rest: wp.float64
):
    """½ (φ - φ₀)² of the angle between the edges from k to i, times ``sign``, and from k to j."""
    u = wp.normalize(sign * (x[i] - x[k]))
    v = wp.normalize(x[j] - x[k])
    energy, _g1, _g2, _c, _q = angle_terms(u, v, rest)
    return energy


@wp.func
def add_angle(
    x: wp.array(dtype=wp.vec3d),
    i: wp.int32,
    k: wp.int32,
    j: wp.int32,
    sign: wp.float64,
    e: wp.int32,
    term: wp.int32,
    rest: wp.float64,
    weight: wp.float64,
    stiffness: wp.float64,
    order: wp.int32,
    slots: wp.array(dtype=wp.int32, ndim=2),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """Add the derivatives of one angle between the edges from k to i and from k to j."""
    u = sign * (x[i] - x[k])
    v = x[j] - x[k]
    ru = wp.float64(1.0) / wp.max(wp.length(u), wp.float64(1.0e-12))
    rv = wp.float64(1.0) / wp.max(wp.length(v), wp.float64(1.0e-12))
    u = u * ru
    v = v * rv
    _value, g1, g2, c, q = angle_terms(u, v, rest)
    # With respect to the vectors x_i - x_k (a) and x_j - x_k (b); sign² = 1.
    ga = (weight * g1 * sign * ru) * (v - c * u)
    gb = (weight * g1 * rv) * (u - c * v)
    wp.atomic_add(gradients, term, i, ga)
    wp.atomic_add(gradients, term, j, gb)
    wp.atomic_add(gradients, term, k, -ga - gb)
    if order == wp.static(GRADIENT_ONLY):
        return
    scale = stiffness * weight
    ka = scale * ru * ru
    kb = scale * rv * rv
    kab = scale * sign * ru * rv
    # Every block is [u v] K [u v]ᵀ + e I; below are the second derivatives by a and a, b and b, a and b:
    #     aa: K = ka (own, cross; cross, other),   bb: K = kb (other, cross; cross, own),   e = ka e, kb e
    #     ab: K = kab (same, uv; vu, same),        e = kab e_ab
    if order == wp.static(CONVEX_HESSIAN) and rest != wp.float64(0.0):
        # Gauss-Newton: the part with the first derivative goes.
        g1 = wp.float64(0.0)
        g2 = wp.float64(1.0) / wp.max(q, wp.float64(0.05 * 0.05))
    same = -(g2 * c + g1)
    cross = same
    other = g2
    own = c * (g1 + g1 - same)
    uv = -c * same
    vu = g2
    e_own = -c * g1
    e_ab = g1
    if order == wp.static(CONVEX_HESSIAN) and rest == wp.float64(0.0):
        # Gauss-Newton of ½ |v̂ - û|², which agrees with ½ θ² to second order in θ.
        same = wp.float64(1.0)
        cross = wp.float64(0.0)
        other = wp.float64(0.0)
        own = wp.float64(-1.0)
        e_own = wp.float64(1.0)
        uv = -c
        vu = wp.float64(0.0)
        e_ab = wp.float64(-1.0)
    # A block u pᵀ + v qᵀ + r I is kept as p, q and r. Those of x_k are minus the sums of the others.
    aa_u = ka * (own * u + cross * v)
    aa_v = ka * (cross * u + other * v)
    bb_u = kb * (other * u + cross * v)
    bb_v = kb * (cross * u + own * v)
    ab_u = kab * (same * u + uv * v)
    ab_v = kab * (vu * u + same * v)
    ba_u = kab * (same * u + vu * v)
    ba_v = kab * (uv * u + same * v)
    aa = ka * e_own
    bb = kb * e_own
    ab = kab * e_ab
    all_u = aa_u + ab_u + ba_u + bb_u
    all_v = aa_v + ab_v + ba_v + bb_v
    # Slots: i, k, j with themselves, then i and k, i and j, k and j.
    add_block(blocks, slots[e, 0], outer_block(u, aa_u, v, aa_v, aa))
    add_block(blocks, slots[e, 2], outer_block(u, bb_u, v, bb_v, bb))
    add_block(blocks, slots[e, 1], outer_block(u, all_u, v, all_v, aa + bb + ab + ab))
    add_block(blocks, slots[e, 4], outer_block(u, ab_u, v, ab_v, ab))
    add_block(blocks, slots[e, 3], outer_block(u, -aa_u - ab_u, v, -aa_v - ab_v, -aa - ab))
    # Of j and k, the other way round than its slot says.
    add_block(blocks, -1 - slots[e, 5], outer_block(u, -bb_u - ba_u, v, -bb_v - ba_v, -bb - ab))


@wp.func
def turned_energy(
    x: wp.array(dtype=wp.vec3d), i: wp.int32, k: wp.int32, j: wp.int32, towards: wp.vec3d
) -> wp.float64:
    """-<m, v̂ - û> of the edges u from i to k and v from k to j, m = ``towards``."""
    u = wp.normalize(x[k] - x[i])
    v = wp.normalize(x[j] - x[k])
    return -wp.dot(towards, v - u)


@wp.func
def turned_block(m: wp.vec3d, v: wp.vec3d, scale: wp.float64):
    """-scale ∂²<m, v̂>/∂v∂v times |v|², v the unit vector."""
    along = wp.dot(m, v)
    return scale * (
        wp.outer(m, v)
        + wp.outer(v, m)
        + along * (wp.identity(n=3, dtype=wp.float64) - wp.float64(3.0) * wp.outer(v, v))
    )


@wp.func
def add_turned(
    x: wp.array(dtype=wp.vec3d),
    i: wp.int32,
    k: wp.int32,
    j: wp.int32,
    e: wp.int32,
    term: wp.int32,
    towards: wp.vec3d,
    weight: wp.float64,
    stiffness: wp.float64,
    order: wp.int32,
    slots: wp.array(dtype=wp.int32, ndim=2),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    blocks: wp.array(dtype=wp.mat33d),
):
    """Add the derivatives of ``turned_energy``; a convex Hessian has none of its second ones."""
    u = x[k] - x[i]
    v = x[j] - x[k]
    ru = wp.float64(1.0) / wp.max(wp.length(u), wp.float64(1.0e-12))
    rv = wp.float64(1.0) / wp.max(wp.length(v), wp.float64(1.0e-12))
    u = u * ru
    v = v * rv
    # By u and by v; x_i is minus u's end, x_j is v's, x_k is u's end and minus v's.
    gu = (weight * ru) * (towards - wp.dot(towards, u) * u)
    gv = (-weight * rv) * (towards - wp.dot(towards, v) * v)
    wp.atomic_add(gradients, term, i, -gu)
    wp.atomic_add(gradients, term, j, gv)
    wp.atomic_add(gradients, term, k, gu - gv)
    if order == wp.static(GRADIENT_ONLY) or order == wp.static(CONVEX_HESSIAN):
        return
    scale = stiffness * weight
    of_u = turned_block(towards, u, -scale * ru * ru)
    of_v = turned_block(towards, v, scale * rv * rv)
    # Symmetric blocks: whichever way round a slot has them.
    add_block(blocks, slots[e, 0], of_u)
    add_block(blocks, slots[e, 1], of_u + of_v)
    add_block(blocks, slots[e, 2], of_v)
    add_block(blocks, slots[e, 3], -of_u)
    add_block(blocks, slots[e, 5], -of_v)


@wp.kernel(enable_backward=False)
def shearing_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add Σ ½ w (φ - φ₀)²."""
    e = wp.tid()
    energy = angle_energy(x, stencil[e, 0], stencil[e, 1], stencil[e, 2], wp.float64(1.0), rest[e, 0])
    wp.atomic_add(out, first, factors[e] * energy)


@wp.kernel(enable_backward=False)
def shearing_derivatives(
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
    add_angle(
        x,
        stencil[e, 0],
        stencil[e, 1],
        stencil[e, 2],
        wp.float64(1.0),
        e,
        first,
        rest[e, 0],
        factors[e],
        coefficients[first],
        order,
        slots,
        gradients,
        blocks,
    )


@wp.kernel(enable_backward=False)
def bending_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add Σ w (½ (θ - θ₀)² - <m, v̂ - û>), see Bending."""
    e = wp.tid()
    energy = angle_energy(x, stencil[e, 0], stencil[e, 1], stencil[e, 2], wp.float64(-1.0), rest[e, 0])
    towards = wp.vec3d(rest[e, 1], rest[e, 2], rest[e, 3])
    if wp.length_sq(towards) > wp.float64(0.0):
        energy = energy + turned_energy(x, stencil[e, 0], stencil[e, 1], stencil[e, 2], towards)
    wp.atomic_add(out, first, factors[e] * energy)


@wp.kernel(enable_backward=False)
def bending_derivatives(
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
    add_angle(
        x,
        stencil[e, 0],
        stencil[e, 1],
        stencil[e, 2],
        wp.float64(-1.0),
        e,
        first,
        rest[e, 0],
        factors[e],
        coefficients[first],
        order,
        slots,
        gradients,
        blocks,
    )
    towards = wp.vec3d(rest[e, 1], rest[e, 2], rest[e, 3])
    if wp.length_sq(towards) > wp.float64(0.0):
        add_turned(
            x,
            stencil[e, 0],
            stencil[e, 1],
            stencil[e, 2],
            e,
            first,
            towards,
            factors[e],
            coefficients[first],
            order,
            slots,
            gradients,
            blocks,
        )
