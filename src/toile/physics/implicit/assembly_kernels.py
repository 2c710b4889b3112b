"""Warp kernels of the internal energy, its gradient and its Hessian over element stencils.

Both angle energies are functions of the cosine c of the angle between the edges u and v:

    ∂c/∂u   = (v̂ - c û) / |u|
    ∂²c/∂u² = (3 c ûûᵀ - v̂ûᵀ - ûv̂ᵀ - c I) / |u|²
    ∂²c/∂u∂v = (I - ûûᵀ)(I - v̂v̂ᵀ) / (|u| |v|) = (I - ûûᵀ - v̂v̂ᵀ + c ûv̂ᵀ) / (|u| |v|)

One launch goes over all elements, edges first, because a launch costs as much as a thousand elements.
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

from itertools import accumulate

import warp as wp

# What ``derivatives`` adds besides the gradient.
GRADIENT_ONLY = 0
EXACT_HESSIAN = 1
CONVEX_HESSIAN = 2

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
def edge_terms(d: wp.vec3d, rest: wp.float64):
    """Length, direction and stretch (length - rest) of an edge vector."""
    length = wp.max(wp.length(d), wp.float64(1.0e-12))
    return length, d / length, length - rest


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
def kind_of_angle(a: wp.int32, n_corners: wp.int32):
    """Sign of the first edge and term of the energy: corners come first, then straight angles."""
    if a < n_corners:
        return wp.float64(1.0), 1
    return wp.float64(-1.0), 2


@wp.kernel(enable_backward=False)
def energies(
    x: wp.array(dtype=wp.vec3d),
    edges: wp.array(dtype=wp.int32, ndim=2),
    lengths: wp.array(dtype=wp.float64),
    edge_weight: wp.array(dtype=wp.float64),
    angles: wp.array(dtype=wp.int32, ndim=2),
    n_corners: wp.int32,
    rest_angles: wp.array(dtype=wp.float64),
    angle_weight: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64),
):
    """Add Σ ½ w (‖e‖ - L₀)² to out[0], Σ ½ w (φ - φ₀)² to out[1] and Σ ½ w θ² to out[2]."""
    e = wp.tid()
    if e < edges.shape[0]:
        _length, _direction, stretch = edge_terms(x[edges[e, 1]] - x[edges[e, 0]], lengths[e])
        wp.atomic_add(out, 0, wp.float64(0.5) * edge_weight[e] * stretch * stretch)
        return
    a = e - edges.shape[0]
    sign, term = kind_of_angle(a, n_corners)
    k = x[angles[a, 1]]
    u = wp.normalize(sign * (x[angles[a, 0]] - k))
    v = wp.normalize(x[angles[a, 2]] - k)
    energy, _g1, _g2, _c, _q = angle_terms(u, v, rest_angles[a])
    wp.atomic_add(out, term, angle_weight[a] * energy)


@wp.func
def add_block(
    band: wp.array(dtype=wp.float64),
    coupling: wp.array(dtype=wp.float64, ndim=2),
    width: wp.int32,
    place: wp.array(dtype=wp.int32),
    p: wp.int32,
    q: wp.int32,
    u: wp.vec3d,
    a: wp.vec3d,
    v: wp.vec3d,
    b: wp.vec3d,
    diagonal: wp.float64,
):
    """Add ∂²E/∂x_p∂x_q = u aᵀ + v bᵀ + diagonal I, p ≠ q: to the band, to the coupling where one is held."""
    at_p = place[p]
    at_q = place[q]
    if at_p >= 0 and at_q >= 0:
        # Entry (row, column) of the lower triangle is at row + column · (width - 1).
        of_p = wp.int32(1)
        of_q = width - 1
        if at_p < at_q:
            of_p = width - 1
            of_q = wp.int32(1)
        first = 3 * (at_p * of_p + at_q * of_q)
        for r in range(3):
            for c in range(3):
                value = u[r] * a[c] + v[r] * b[c]
                if r == c:
                    value += diagonal
                wp.atomic_add(band, first + r * of_p + c * of_q, value)
    elif at_p >= 0 or at_q >= 0:
        for r in range(3):
            for c in range(3):
                value = u[r] * a[c] + v[r] * b[c]
                if r == c:
                    value += diagonal
                if at_p >= 0:
                    wp.atomic_add(coupling, -3 * (at_q + 1) + c, 3 * p + r, value)
                else:
                    wp.atomic_add(coupling, -3 * (at_p + 1) + r, 3 * q + c, value)


@wp.func
def add_diagonal_block(
    band: wp.array(dtype=wp.float64),
    width: wp.int32,
    place: wp.array(dtype=wp.int32),
    p: wp.int32,
    u: wp.vec3d,
    a: wp.vec3d,
    v: wp.vec3d,
    b: wp.vec3d,
    diagonal: wp.float64,
):
    """Add ∂²E/∂x_p² = u aᵀ + v bᵀ + diagonal I to the band where p is free."""
    at = place[p]
    if at >= 0:
        first = 3 * at * width
        for c in range(3):
            for r in range(c, 3):
                value = u[r] * a[c] + v[r] * b[c]
                if r == c:
                    value += diagonal
                wp.atomic_add(band, first + c * (width - 1) + r, value)


@wp.func
def add_edge(
    x: wp.array(dtype=wp.vec3d),
    p: wp.int32,
    q: wp.int32,
    rest: wp.float64,
    weight: wp.float64,
    stiffness: wp.float64,
    order: wp.int32,
    width: wp.int32,
    place: wp.array(dtype=wp.int32),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    band: wp.array(dtype=wp.float64),
    coupling: wp.array(dtype=wp.float64, ndim=2),
):
    """Add the derivatives of one stretching element."""
    length, u, stretch = edge_terms(x[q] - x[p], rest)
    g = weight * stretch * u
    wp.atomic_add(gradients, 0, q, g)
    wp.atomic_add(gradients, 0, p, -g)
    if order == wp.static(GRADIENT_ONLY):
        return
    scale = stiffness * weight
    transverse = stretch / length
    if order == wp.static(CONVEX_HESSIAN):
        transverse = wp.max(transverse, wp.float64(0.0))
    none = wp.vec3d()
    diagonal = scale * transverse
    a = (scale - diagonal) * u
    add_diagonal_block(band, width, place, p, u, a, none, none, diagonal)
    add_diagonal_block(band, width, place, q, u, a, none, none, diagonal)
    add_block(band, coupling, width, place, p, q, u, -a, none, none, -diagonal)


@wp.func
def add_angle(
    x: wp.array(dtype=wp.vec3d),
    i: wp.int32,
    k: wp.int32,
    j: wp.int32,
    sign: wp.float64,
    term: wp.int32,
    rest: wp.float64,
    weight: wp.float64,
    stiffness: wp.float64,
    order: wp.int32,
    width: wp.int32,
    place: wp.array(dtype=wp.int32),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    band: wp.array(dtype=wp.float64),
    coupling: wp.array(dtype=wp.float64, ndim=2),
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
    e = -c * g1
    e_ab = g1
    if order == wp.static(CONVEX_HESSIAN) and rest == wp.float64(0.0):
        # Gauss-Newton of ½ |v̂ - û|², which agrees with ½ θ² to second order in θ.
        same = wp.float64(1.0)
        cross = wp.float64(0.0)
        other = wp.float64(0.0)
        own = wp.float64(-1.0)
        e = wp.float64(1.0)
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
    aa = ka * e
    bb = kb * e
    ab = kab * e_ab
    add_diagonal_block(band, width, place, i, u, aa_u, v, aa_v, aa)
    add_diagonal_block(band, width, place, j, u, bb_u, v, bb_v, bb)
    all_u = aa_u + ab_u + ba_u + bb_u
    all_v = aa_v + ab_v + ba_v + bb_v
    add_diagonal_block(band, width, place, k, u, all_u, v, all_v, aa + bb + ab + ab)
    add_block(band, coupling, width, place, i, j, u, ab_u, v, ab_v, ab)
    add_block(band, coupling, width, place, i, k, u, -aa_u - ab_u, v, -aa_v - ab_v, -aa - ab)
    add_block(band, coupling, width, place, j, k, u, -bb_u - ba_u, v, -bb_v - ba_v, -bb - ab)


@wp.kernel(enable_backward=False)
def derivatives(
    x: wp.array(dtype=wp.vec3d),
    edges: wp.array(dtype=wp.int32, ndim=2),
    lengths: wp.array(dtype=wp.float64),
    edge_weight: wp.array(dtype=wp.float64),
    angles: wp.array(dtype=wp.int32, ndim=2),
    n_corners: wp.int32,
    rest_angles: wp.array(dtype=wp.float64),
    angle_weight: wp.array(dtype=wp.float64),
    gradients: wp.array(dtype=wp.vec3d, ndim=2),
    stiffness: wp.array(dtype=wp.float64),
    width: wp.int32,
    place: wp.array(dtype=wp.int32),
    order: wp.int32,
    band: wp.array(dtype=wp.float64),
    coupling: wp.array(dtype=wp.float64, ndim=2),
):
    """Add the unit-stiffness gradients and, as ``order`` says, the stiffness-weighted Hessian.

    ``place`` is the position of a free vertex in the band, or -1 - slot for a held one; ``width`` is the
    length of a column of the band, which is given flattened.
    """
    e = wp.tid()
    if e < edges.shape[0]:
        add_edge(
            x,
            edges[e, 0],
            edges[e, 1],
            lengths[e],
            edge_weight[e],
            stiffness[0],
            order,
            width,
            place,
            gradients,
            band,
            coupling,
        )
        return
    a = e - edges.shape[0]
    sign, term = kind_of_angle(a, n_corners)
    add_angle(
        x,
        angles[a, 0],
        angles[a, 1],
        angles[a, 2],
        sign,
        term,
        rest_angles[a],
        angle_weight[a],
        stiffness[term],
        order,
        width,
        place,
        gradients,
        band,
        coupling,
    )
