"""Warp kernels of the internal energy, its gradient and its Hessian over element stencils.

Both angle energies are functions of the cosine c of the angle between the edges u and v:

    ∂c/∂u   = (v̂ - c û) / |u|
    ∂²c/∂u² = (3 c ûûᵀ - v̂ûᵀ - ûv̂ᵀ - c I) / |u|²
    ∂²c/∂u∂v = (I - ûûᵀ)(I - v̂v̂ᵀ) / (|u| |v|)
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, valid-type"

import warp as wp

# Below this sine an angle energy with a non-zero rest angle is treated as if at this sine: its true gradient
# has no direction at a complete fold.
_MIN_SINE = 1.0e-4


@wp.func
def edge_terms(d: wp.vec3d, rest: wp.float64):
    """Length, direction and stretch (length - rest) of an edge vector."""
    length = wp.max(wp.length(d), wp.float64(1.0e-12))
    return length, d / length, length - rest


@wp.func
def angle_terms(c: wp.float64, s: wp.float64, rest: wp.float64):
    """Value, first and second derivative with respect to c of ½ (θ - rest)², θ = atan2(s, c)."""
    theta = wp.atan2(s, c)
    if rest == wp.float64(0.0) and theta < wp.float64(0.02):
        t2 = theta * theta
        g1 = -(wp.float64(1.0) + t2 / wp.float64(6.0) + wp.float64(7.0 / 360.0) * t2 * t2)
        g2 = wp.float64(1.0 / 3.0) + wp.float64(2.0 / 15.0) * t2
        return wp.float64(0.5) * t2, g1, g2
    sine = wp.max(s, wp.float64(_MIN_SINE))
    g1 = -(theta - rest) / sine
    g2 = (wp.float64(1.0) + g1 * c) / (sine * sine)
    return wp.float64(0.5) * (theta - rest) * (theta - rest), g1, g2


@wp.kernel(enable_backward=False)
def edge_energy(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    out: wp.array(dtype=wp.float64),
):
    """Add Σ ½ w (‖e‖ - L₀)² to out[0]."""
    e = wp.tid()
    _length, _direction, stretch = edge_terms(x[index[e, 1]] - x[index[e, 0]], rest[e])
    wp.atomic_add(out, 0, wp.float64(0.5) * weight[e] * stretch * stretch)


@wp.kernel(enable_backward=False)
def angle_energy(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    sign: wp.float64,
    slot: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add Σ ½ w (θ - rest)² to out[slot]; sign -1 for straight angles."""
    e = wp.tid()
    k = x[index[e, 1]]
    u = wp.normalize(sign * (x[index[e, 0]] - k))
    v = wp.normalize(x[index[e, 2]] - k)
    energy, _g1, _g2 = angle_terms(wp.dot(u, v), wp.length(wp.cross(u, v)), rest[e])
    wp.atomic_add(out, slot, weight[e] * energy)


@wp.func
def add_block(
    band: wp.array(dtype=wp.float64, ndim=2),
    coupling: wp.array(dtype=wp.float64, ndim=2),
    position: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    p: wp.int32,
    q: wp.int32,
    block: wp.mat33d,
):
    """Add ∂²E/∂x_p∂x_q: to the band where both are free, to the coupling where q is held."""
    if held[p] >= 0:
        return
    if held[q] >= 0:
        for r in range(3):
            for c in range(3):
                wp.atomic_add(coupling, 3 * held[q] + c, 3 * p + r, block[r, c])
        return
    row = 3 * position[p]
    column = 3 * position[q]
    if row < column:
        return
    for r in range(3):
        for c in range(3):
            if row + r >= column + c:
                wp.atomic_add(band, column + c, row + r - column - c, block[r, c])


@wp.kernel(enable_backward=False)
def edge_derivatives(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    stiffness: wp.float64,
    hessian: wp.int32,
    convex: wp.int32,
    position: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    gradient: wp.array(dtype=wp.vec3d),
    band: wp.array(dtype=wp.float64, ndim=2),
    coupling: wp.array(dtype=wp.float64, ndim=2),
):
    """Add the unit-stiffness gradient and, on request, the stiffness-weighted Hessian of stretching."""
    e = wp.tid()
    p = index[e, 0]
    q = index[e, 1]
    length, direction, stretch = edge_terms(x[q] - x[p], rest[e])
    g = weight[e] * stretch * direction
    wp.atomic_add(gradient, q, g)
    wp.atomic_add(gradient, p, -g)
    if hessian == 1:
        transverse = stretch / length
        if convex == 1:
            transverse = wp.max(transverse, wp.float64(0.0))
        outer = wp.outer(direction, direction)
        identity = wp.identity(n=3, dtype=wp.float64)
        block = stiffness * weight[e] * (outer + transverse * (identity - outer))
        add_block(band, coupling, position, held, p, p, block)
        add_block(band, coupling, position, held, q, q, block)
        add_block(band, coupling, position, held, p, q, -block)
        add_block(band, coupling, position, held, q, p, -block)


@wp.kernel(enable_backward=False)
def angle_derivatives(
    x: wp.array(dtype=wp.vec3d),
    index: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64),
    weight: wp.array(dtype=wp.float64),
    sign: wp.float64,
    stiffness: wp.float64,
    hessian: wp.int32,
    convex: wp.int32,
    position: wp.array(dtype=wp.int32),
    held: wp.array(dtype=wp.int32),
    gradient: wp.array(dtype=wp.vec3d),
    band: wp.array(dtype=wp.float64, ndim=2),
    coupling: wp.array(dtype=wp.float64, ndim=2),
):
    """Add the unit-stiffness gradient and, on request, the stiffness-weighted Hessian of an angle energy."""
    e = wp.tid()
    i = index[e, 0]
    k = index[e, 1]
    j = index[e, 2]
    u = sign * (x[i] - x[k])
    v = x[j] - x[k]
    lu = wp.max(wp.length(u), wp.float64(1.0e-12))
    lv = wp.max(wp.length(v), wp.float64(1.0e-12))
    u = u / lu
    v = v / lv
    c = wp.dot(u, v)
    s = wp.length(wp.cross(u, v))
    _value, g1, g2 = angle_terms(c, s, rest[e])
    # Derivatives with respect to the vectors x_i - x_k (a) and x_j - x_k (b); sign² = 1.
    da = sign * (v - c * u) / lu
    db = (u - c * v) / lv
    w = weight[e]
    ga = w * g1 * da
    gb = w * g1 * db
    wp.atomic_add(gradient, i, ga)
    wp.atomic_add(gradient, j, gb)
    wp.atomic_add(gradient, k, -ga - gb)
    if hessian == 1:
        identity = wp.identity(n=3, dtype=wp.float64)
        uu = wp.outer(u, u)
        vv = wp.outer(v, v)
        uv = wp.outer(u, v)
        mixed = (identity - uu) * (identity - vv)
        scale = stiffness * w
        haa = wp.mat33d()
        hbb = wp.mat33d()
        hab = wp.mat33d()
        if convex == 0:
            curvature_a = wp.float64(3.0) * c * uu - uv - wp.transpose(uv) - c * identity
            curvature_b = wp.float64(3.0) * c * vv - uv - wp.transpose(uv) - c * identity
            haa = scale * (g2 * wp.outer(da, da) + (g1 / (lu * lu)) * curvature_a)
            hbb = scale * (g2 * wp.outer(db, db) + (g1 / (lv * lv)) * curvature_b)
            hab = scale * (g2 * wp.outer(da, db) + (g1 * sign / (lu * lv)) * mixed)
        elif rest[e] == wp.float64(0.0):
            # Gauss-Newton of ½ |v̂ - û|², which agrees with ½ θ² to second order in θ.
            haa = (scale / (lu * lu)) * (identity - uu)
            hbb = (scale / (lv * lv)) * (identity - vv)
            hab = (-sign * scale / (lu * lv)) * mixed
        else:
            sine = wp.max(s, wp.float64(0.05))
            gn = scale / (sine * sine)
            haa = gn * wp.outer(da, da)
            hbb = gn * wp.outer(db, db)
            hab = gn * wp.outer(da, db)
        hba = wp.transpose(hab)
        hak = -haa - hab
        hbk = -hba - hbb
        add_block(band, coupling, position, held, i, i, haa)
        add_block(band, coupling, position, held, j, j, hbb)
        add_block(band, coupling, position, held, i, j, hab)
        add_block(band, coupling, position, held, j, i, hba)
        add_block(band, coupling, position, held, i, k, hak)
        add_block(band, coupling, position, held, k, i, wp.transpose(hak))
        add_block(band, coupling, position, held, j, k, hbk)
        add_block(band, coupling, position, held, k, j, wp.transpose(hbk))
        add_block(band, coupling, position, held, k, k, -hak - hbk)
