"""Warp kernels of the dihedral bending energy.

With the edge e = b - a of unit direction ê, the normals n = e × (c - a) and m = (d - a) × e of the two faces
and p = n / |n|², q = m / |m|², the angle's gradient is

    ∂θ/∂c = -|e| p,   ∂θ/∂a = (b - c)·ê p + (b - d)·ê q,
    ∂θ/∂d = -|e| q,   ∂θ/∂b = (c - a)·ê p + (d - a)·ê q,

and the second derivatives follow from ∂p/∂n = (I - 2 n̂n̂ᵀ) / |n|², δn = δ × o for a vertex with the opposite
edge o, and the gradients of the scalars before p and q.
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, type-var, valid-type"

import warp as wp

from toile.physics.energies.block_kernels import CONVEX_HESSIAN, GRADIENT_ONLY, add_block

# Squared area below which a face has no normal to speak of [m⁴].
_LEAST = 1.0e-30


@wp.func
def signed_angle(edge: wp.vec3d, n: wp.vec3d, m: wp.vec3d):
    """Angle between the normals n and m about the edge."""
    sine = wp.dot(wp.cross(n, m), edge) / wp.max(wp.length(edge), wp.float64(1.0e-12))
    return wp.atan2(sine, wp.dot(n, m))


@wp.kernel(enable_backward=False)
def dihedral_bending_energies(
    x: wp.array(dtype=wp.vec3d),
    stencil: wp.array(dtype=wp.int32, ndim=2),
    rest: wp.array(dtype=wp.float64, ndim=2),
    factors: wp.array(dtype=wp.float64),
    first: wp.int32,
    out: wp.array(dtype=wp.float64),
):
    """Add Σ ½ w (θ - θ₀)²."""
    e = wp.tid()
    a = x[stencil[e, 0]]
    edge = x[stencil[e, 1]] - a
    n = wp.cross(edge, x[stencil[e, 2]] - a)
    m = wp.cross(x[stencil[e, 3]] - a, edge)
    away = signed_angle(edge, n, m) - rest[e, 0]
    wp.atomic_add(out, first, wp.float64(0.5) * factors[e] * rest[e, 1] * away * away)


@wp.func
def face_block(
    p: wp.vec3d,
    slope: wp.mat33d,
    scalar: wp.float64,
    of_scalar: wp.vec3d,
    opposite: wp.vec3d,
):
    """∂(scalar p)/∂x_w: ``of_scalar`` is the scalar's gradient, x_w lies opposite to that edge."""
    # δn = δ × o = -[o]× δ
    return wp.outer(p, of_scalar) - scalar * slope * wp.skew(opposite)


@wp.func
def slope_of(n: wp.vec3d, squared: wp.float64):
    """∂(n / |n|²)/∂n."""
    return (wp.identity(n=3, dtype=wp.float64) - (wp.float64(2.0) / squared) * wp.outer(n, n)) / squared


@wp.kernel(enable_backward=False)
def dihedral_bending_derivatives(
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
    t = wp.tid()
    a = x[stencil[t, 0]]
    b = x[stencil[t, 1]]
    c = x[stencil[t, 2]]
    d = x[stencil[t, 3]]
    edge = b - a
    length = wp.max(wp.length(edge), wp.float64(1.0e-12))
    along = edge / length
    n = wp.cross(edge, c - a)
    m = wp.cross(d - a, edge)
    away = signed_angle(edge, n, m) - rest[t, 0]
    n2 = wp.max(wp.dot(n, n), wp.float64(_LEAST))
    m2 = wp.max(wp.dot(m, m), wp.float64(_LEAST))
    p = n / n2
    q = m / m2
    # What stands before p and q in the gradient by each vertex.
    pa = wp.dot(b - c, along)
    pb = wp.dot(c - a, along)
    qa = wp.dot(b - d, along)
    qb = wp.dot(d - a, along)
    ga = pa * p + qa * q
    gb = pb * p + qb * q
    gc = -length * p
    gd = -length * q
    weight = factors[t] * rest[t, 1]
    slope = weight * away
    wp.atomic_add(gradients, first, stencil[t, 0], slope * ga)
    wp.atomic_add(gradients, first, stencil[t, 1], slope * gb)
    wp.atomic_add(gradients, first, stencil[t, 2], slope * gc)
    wp.atomic_add(gradients, first, stencil[t, 3], slope * gd)
    if order == wp.static(GRADIENT_ONLY):
        return
    k = coefficients[first] * weight
    haa = k * wp.outer(ga, ga)
    hbb = k * wp.outer(gb, gb)
    hcc = k * wp.outer(gc, gc)
    hdd = k * wp.outer(gd, gd)
    hab = k * wp.outer(ga, gb)
    hac = k * wp.outer(ga, gc)
    had = k * wp.outer(ga, gd)
    hbc = k * wp.outer(gb, gc)
    hbd = k * wp.outer(gb, gd)
    hcd = k * wp.outer(gc, gd)
    if order != wp.static(CONVEX_HESSIAN):
        r = k * away
        dn = r * slope_of(n, n2)
        dm = r * slope_of(m, m2)
        rp = r * p
        rq = r * q
        # ∂ê/∂b = (I - ê êᵀ) / |e| on the parts of the scalars that lie across the edge.
        across_c = (c - a - pb * along) / length
        across_d = (d - a - qb * along) / length
        none = wp.vec3d()
        # Face (a, b, c): opposite edges c - b, a - c and b - a turn the normal.
        oa = b - c
        ob = c - a
        oc = -edge
        # Gradients of pb = (c - a)·ê; pa = |e| - pb.
        pb_a = -along - across_c
        pb_b = across_c
        pb_c = along
        haa += face_block(rp, dn, pa, -along - pb_a, oa)
        hab += face_block(rp, dn, pa, along - pb_b, ob)
        hac += face_block(rp, dn, pa, -pb_c, oc)
        hbb += face_block(rp, dn, pb, pb_b, ob)
        hbc += face_block(rp, dn, pb, pb_c, oc)
        hcc += face_block(rp, dn, -length, none, oc)
        # Face (b, a, d), likewise.
        qb_a = -along - across_d
        qb_b = across_d
        qb_d = along
        ua = d - b
        ub = a - d
        ud = edge
        haa += face_block(rq, dm, qa, -along - qb_a, ua)
        hab += face_block(rq, dm, qa, along - qb_b, ub)
        had += face_block(rq, dm, qa, -qb_d, ud)
        hbb += face_block(rq, dm, qb, qb_b, ub)
        hbd += face_block(rq, dm, qb, qb_d, ud)
        hdd += face_block(rq, dm, -length, none, ud)
    add_block(blocks, slots[t, 0], haa)
    add_block(blocks, slots[t, 1], hbb)
    add_block(blocks, slots[t, 2], hcc)
    add_block(blocks, slots[t, 3], hdd)
    add_block(blocks, slots[t, 4], hab)
    add_block(blocks, slots[t, 5], hac)
    add_block(blocks, slots[t, 6], had)
    add_block(blocks, slots[t, 7], hbc)
    add_block(blocks, slots[t, 8], hbd)
    add_block(blocks, slots[t, 9], hcd)
