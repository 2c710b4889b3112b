"""Warp kernels of the texture-point term."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def"
# mypy: disable-error-code="operator, valid-type"

import warp as wp


@wp.func
def texel(features: wp.array(dtype=wp.vec4, ndim=3), frame: wp.int32, row: wp.int32, column: wp.int32):
    """Features of a pixel, clamped to the image."""
    r = wp.clamp(row, 0, features.shape[1] - 1)
    c = wp.clamp(column, 0, features.shape[2] - 1)
    return features[frame, r, c]


@wp.func
def bilinear(features: wp.array(dtype=wp.vec4, ndim=3), frame: wp.int32, x: wp.float32, y: wp.float32):
    """Features at continuous pixel coordinates."""
    column = wp.int32(wp.floor(x - 0.5))
    row = wp.int32(wp.floor(y - 0.5))
    fx = x - 0.5 - wp.float32(column)
    fy = y - 0.5 - wp.float32(row)
    top = texel(features, frame, row, column) * (1.0 - fx) + texel(features, frame, row, column + 1) * fx
    bottom = (
        texel(features, frame, row + 1, column) * (1.0 - fx)
        + texel(features, frame, row + 1, column + 1) * fx
    )
    return top * (1.0 - fy) + bottom * fy


@wp.kernel(enable_backward=False)
def sample_features(
    features: wp.array(dtype=wp.vec4, ndim=3),
    pixels: wp.array(dtype=wp.vec2),
    out: wp.array(dtype=wp.vec4),
):
    """Features of the first picture at given pixels."""
    p = wp.tid()
    out[p] = bilinear(features, 0, pixels[p][0], pixels[p][1])


@wp.kernel(enable_backward=False)
def point_term(
    x: wp.array(dtype=wp.vec3d, ndim=2),
    vertices: wp.array(dtype=wp.int32, ndim=2),
    weights: wp.array(dtype=wp.float64, ndim=2),
    border: wp.array(dtype=wp.int32),
    reference: wp.array(dtype=wp.vec4),
    visible: wp.array(dtype=wp.float32, ndim=2),
    features: wp.array(dtype=wp.vec4, ndim=3),
    first_frame: wp.int32,
    intrinsics: wp.vec4d,
    colour_weight: wp.float64,
    border_weight: wp.float64,
    inner_weight: wp.float64,
    colour_scale: wp.float64,
    mask_scale: wp.float64,
    inside_threshold: wp.float32,
    derivatives: wp.int32,
    cost: wp.array(dtype=wp.vec2d),
    gradient: wp.array(dtype=wp.vec3d, ndim=2),
    matrix: wp.array(dtype=wp.mat33d, ndim=2),
):
    """Cost per frame, gradient per vertex and Gauss-Newton matrix per point, see TexturePointTerm."""
    f, p = wp.tid()
    seen = wp.float64(visible[f, p])
    point = wp.vec3d()
    for c in range(4):
        point += weights[p, c] * x[f, vertices[p, c]]
    z = point[2]
    matrix[f, p] = wp.mat33d()
    if z <= wp.float64(1.0e-3) or seen == wp.float64(0.0):
        return
    px = wp.float32(intrinsics[0] * point[0] / z + intrinsics[2])
    py = wp.float32(intrinsics[1] * point[1] / z + intrinsics[3])
    frame = first_frame + f
    value = bilinear(features, frame, px, py)
    target = reference[p]
    r = wp.vec3d()
    for c in range(3):
        r[c] = wp.float64(value[c] - target[c])
    colour = wp.float64(0.0)
    if value[3] > inside_threshold and target[3] > 0.5:
        colour = colour_weight * seen
    # Pseudo-Huber: δ² (√(1 + |r|²/δ²) - 1), as a multiple of δ².
    norm = wp.sqrt(wp.dot(r, r) + colour_scale * colour_scale)
    energy = colour * (norm - colour_scale) / colour_scale
    wc = colour / (norm * colour_scale)
    m = wp.float64(value[3] - target[3])
    weight = border_weight
    if border[p] == 0:
        m = wp.min(m, wp.float64(0.0))
        weight = inner_weight
    m_norm = wp.sqrt(m * m + mask_scale * mask_scale)
    mask_energy = seen * weight * (m_norm - mask_scale) / mask_scale
    wm = seen * weight / (m_norm * mask_scale)
    wp.atomic_add(cost, f, wp.vec2d(energy, mask_energy))
    if derivatives == 0:
        return
    gx = 0.5 * (bilinear(features, frame, px + 1.0, py) - bilinear(features, frame, px - 1.0, py))
    gy = 0.5 * (bilinear(features, frame, px, py + 1.0) - bilinear(features, frame, px, py - 1.0))
    a = wp.float64(0.0)
    b = wp.float64(0.0)
    d = wp.float64(0.0)
    g0 = wp.float64(0.0)
    g1 = wp.float64(0.0)
    for c in range(3):
        u = wp.float64(gx[c])
        v = wp.float64(gy[c])
        a += wc * u * u
        b += wc * u * v
        d += wc * v * v
        g0 += wc * u * r[c]
        g1 += wc * v * r[c]
    mu = wp.float64(gx[3])
    mv = wp.float64(gy[3])
    a += wm * mu * mu
    b += wm * mu * mv
    d += wm * mv * mv
    g0 += wm * mu * m
    g1 += wm * mv * m
    jx = wp.vec3d(intrinsics[0] / z, wp.float64(0.0), -intrinsics[0] * point[0] / (z * z))
    jy = wp.vec3d(wp.float64(0.0), intrinsics[1] / z, -intrinsics[1] * point[1] / (z * z))
    g = g0 * jx + g1 * jy
    for c in range(4):
        wp.atomic_add(gradient, f, vertices[p, c], weights[p, c] * g)
    cross = wp.outer(jx, jy)
    matrix[f, p] = a * wp.outer(jx, jx) + b * (cross + wp.transpose(cross)) + d * wp.outer(jy, jy)


@wp.kernel(enable_backward=False)
def apply_matrices(
    change: wp.array(dtype=wp.vec3d, ndim=2),
    vertices: wp.array(dtype=wp.int32, ndim=2),
    weights: wp.array(dtype=wp.float64, ndim=2),
    matrix: wp.array(dtype=wp.mat33d, ndim=2),
    out: wp.array(dtype=wp.vec3d, ndim=2),
):
    """Sum over points of (weights ⊗ matrix ⊗ weights) times a change of the vertices."""
    f, p = wp.tid()
    moved = wp.vec3d()
    for c in range(4):
        moved += weights[p, c] * change[f, vertices[p, c]]
    force = matrix[f, p] * moved
    for c in range(4):
        wp.atomic_add(out, f, vertices[p, c], weights[p, c] * force)
