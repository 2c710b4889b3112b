"""Warp kernels of the questions to a moving surface."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, attr-defined, index, no-untyped-def, operator, valid-type"

import warp as wp

# Closer than this to the surface [m] the way to the nearest point is the face's normal.
_CLOSE = 1.0e-7

# Beyond the rounding of single precision within some metres [m].
_SINGLE = wp.constant(wp.float32(2.0e-6))

# Faces that share the nearest edge or corner are as near as each other, but for rounding [m].
_TIE = wp.constant(wp.float64(1.0e-12))

# Points and weights nearer than this to each other are the same.
_SAME = wp.constant(wp.float64(1.0e-9))

# How far behind each other two walls of a crease may be [m].
_FLAT = 1.0e-3


@wp.func
def place_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):  # noqa: PLR0911
    """Barycentric coordinates of the point nearest to p (Ericson, Real-Time Collision Detection, 5.1.5)."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, p - a)
    d2 = wp.dot(ac, p - a)
    if d1 <= zero and d2 <= zero:
        return wp.vec3d(one, zero, zero)
    d3 = wp.dot(ab, p - b)
    d4 = wp.dot(ac, p - b)
    if d3 >= zero and d4 <= d3:
        return wp.vec3d(zero, one, zero)
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero:
        t = d1 / (d1 - d3)
        return wp.vec3d(one - t, t, zero)
    d5 = wp.dot(ab, p - c)
    d6 = wp.dot(ac, p - c)
    if d6 >= zero and d5 <= d6:
        return wp.vec3d(zero, zero, one)
    vb = d5 * d2 - d1 * d6
    if vb <= zero and d2 >= zero and d6 <= zero:
        t = d2 / (d2 - d6)
        return wp.vec3d(one - t, zero, t)
    va = d3 * d6 - d5 * d4
    if va <= zero and d4 - d3 >= zero and d5 - d6 >= zero:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return wp.vec3d(zero, one - t, t)
    scale = one / (va + vb + vc)
    return wp.vec3d(va * scale, vb * scale, vc * scale)


@wp.func
def place_on_face(
    p: wp.vec3d,
    vertices: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.int32, ndim=2),
    face: wp.int32,
):
    """Barycentric coordinates of the point of a face nearest to p."""
    return place_on_triangle(
        p, vertices[triangles[face, 0]], vertices[triangles[face, 1]], vertices[triangles[face, 2]]
    )


@wp.func
def point_of_face(
    w: wp.vec3d,
    vertices: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.int32, ndim=2),
    face: wp.int32,
):
    """Point of a face at barycentric coordinates w."""
    return (
        w[0] * vertices[triangles[face, 0]]
        + w[1] * vertices[triangles[face, 1]]
        + w[2] * vertices[triangles[face, 2]]
    )


@wp.func
def normal_at(
    mesh: wp.uint64,
    on: wp.vec3d,
    vertices: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.int32, ndim=2),
):
    """Normal of the surface at a point on an edge or a corner: its faces' there, by their angles.

    Of those faces alone that meet in it; others at the same distance from whoever asks say nothing.
    """
    total = wp.vec3d()
    at = wp.vec3f(wp.float32(on[0]), wp.float32(on[1]), wp.float32(on[2]))
    box = wp.vec3f(_SINGLE, _SINGLE, _SINGLE)
    query = wp.mesh_query_aabb(mesh, at - box, at + box)
    face = wp.int32(0)
    one = wp.float64(1.0) - _SAME
    while wp.mesh_query_aabb_next(query, face):
        w = place_on_face(on, vertices, triangles, face)
        if wp.length(on - point_of_face(w, vertices, triangles, face)) < _SAME:
            a = vertices[triangles[face, 0]]
            b = vertices[triangles[face, 1]]
            c = vertices[triangles[face, 2]]
            # Half a turn along an edge.
            angle = wp.float64(wp.PI)
            if w[0] > one:
                angle = wp.acos(wp.clamp(wp.dot(wp.normalize(b - a), wp.normalize(c - a)), -one, one))
            if w[1] > one:
                angle = wp.acos(wp.clamp(wp.dot(wp.normalize(c - b), wp.normalize(a - b)), -one, one))
            if w[2] > one:
                angle = wp.acos(wp.clamp(wp.dot(wp.normalize(a - c), wp.normalize(b - c)), -one, one))
            total += wp.normalize(wp.cross(b - a, c - a)) * angle
    return total


@wp.kernel(enable_backward=False)
def nearest_places(
    mesh: wp.uint64,
    vertices: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.int32, ndim=2),
    points: wp.array(dtype=wp.vec3d),
    reach: wp.float32,
    with_sign: wp.bool,
    faces: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.vec3d),
    nearest: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    distances: wp.array(dtype=wp.float64),
):
    """Nearest face (-1: none within reach) and the nearest point on it, the same whatever the tree is."""
    i = wp.tid()
    p = points[i]
    asked = wp.vec3f(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))
    face = wp.int32(-1)
    found = wp.mesh_query_point_no_sign(mesh, asked, reach)
    if found.result:
        face = found.face
    if face < 0:
        faces[i] = face
        return
    w = place_on_face(p, vertices, triangles, face)
    least = wp.length(p - point_of_face(w, vertices, triangles, face))
    # Which of several faces at nearly one distance it is depends on the tree, and so on where the mesh was
    # first. Among all that may be nearest double precision decides, and their numbers where it can't.
    half = wp.float32(least) + _SINGLE
    box = wp.vec3f(half, half, half)
    query = wp.mesh_query_aabb(mesh, asked - box, asked + box)
    other_face = wp.int32(0)
    while wp.mesh_query_aabb_next(query, other_face):
        v = place_on_face(p, vertices, triangles, other_face)
        length = wp.length(p - point_of_face(v, vertices, triangles, other_face))
        if length < least - _TIE or (length <= least + _TIE and other_face < face):
            least = length
            face = other_face
            w = v
    faces[i] = face
    a = vertices[triangles[face, 0]]
    b = vertices[triangles[face, 1]]
    c = vertices[triangles[face, 2]]
    on = w[0] * a + w[1] * b + w[2] * c
    away = p - on
    length = wp.length(away)
    sign = wp.float64(1.0)
    normal = wp.normalize(wp.cross(b - a, c - a))
    if length > wp.float64(_CLOSE):
        if with_sign:
            outwards = normal
            if wp.min(wp.min(w[0], w[1]), w[2]) <= wp.float64(0.0):
                outwards = normal_at(mesh, on, vertices, triangles)
            if wp.dot(away, outwards) < wp.float64(0.0):
                sign = wp.float64(-1.0)
        normal = away * (sign / length)
    weights[i] = w
    nearest[i] = on
    normals[i] = normal
    distances[i] = sign * length


@wp.kernel(enable_backward=False)
def other_walls(
    mesh: wp.uint64,
    vertices: wp.array(dtype=wp.vec3d),
    triangles: wp.array(dtype=wp.int32, ndim=2),
    points: wp.array(dtype=wp.vec3d),
    walls: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    reach: wp.float32,
    turned: wp.float64,
    faces: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.vec3d),
    nearest: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    distances: wp.array(dtype=wp.float64),
):
    """As nearest_places, among faces that make a crease with a wall of known place and direction.

    Their normal's product with the direction is below ``turned``; both walls lie before each other, or what
    is found is the far side of something thin; and the way to the point runs along the normal, or the face is
    seen across a ridge.
    """
    i = wp.tid()
    p = points[i]
    asked = wp.vec3f(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))
    box = wp.vec3f(reach, reach, reach)
    least = wp.float64(reach)
    faces[i] = wp.int32(-1)
    query = wp.mesh_query_aabb(mesh, asked - box, asked + box)
    face = wp.int32(0)
    while wp.mesh_query_aabb_next(query, face):
        a = vertices[triangles[face, 0]]
        b = vertices[triangles[face, 1]]
        c = vertices[triangles[face, 2]]
        normal = wp.normalize(wp.cross(b - a, c - a))
        if wp.dot(normal, directions[i]) < turned:
            w = place_on_triangle(p, a, b, c)
            on = w[0] * a + w[1] * b + w[2] * c
            away = p - on
            length = wp.length(away)
            across = wp.dot(away, normal)
            between = on - walls[i]
            crease = wp.dot(between, directions[i]) > wp.float64(-_FLAT)
            crease = crease and wp.dot(between, normal) < wp.float64(_FLAT)
            nearer = length < least - _TIE or (length <= least + _TIE and face < faces[i])
            if crease and nearer and wp.abs(across) >= wp.float64(0.7) * length:
                least = length
                sign = wp.where(across < wp.float64(0.0), wp.float64(-1.0), wp.float64(1.0))
                if length > wp.float64(_CLOSE):
                    normal = away * (sign / length)
                faces[i] = face
                weights[i] = w
                nearest[i] = on
                normals[i] = normal
                distances[i] = sign * length


@wp.kernel(enable_backward=False)
def ray_hits(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3f),
    directions: wp.array(dtype=wp.vec3f),
    reach: wp.float32,
    distances: wp.array(dtype=wp.float32),
):
    """Distance along a ray to its first hit; -1 without one within reach."""
    i = wp.tid()
    found = wp.mesh_query_ray(mesh, points[i], directions[i], reach)
    distances[i] = wp.float32(-1.0)
    if found.result:
        distances[i] = found.t
