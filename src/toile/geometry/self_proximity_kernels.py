"""Warp kernels of what of a triangle mesh comes near itself: vertices and faces, edges and edges.

A pair is four vertices: one and the three of a face, or the two of one edge and the two of another. The first
``n_faces`` pairs are of the first kind.
"""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, attr-defined, index, no-untyped-def, operator, valid-type"
# ruff: noqa: PLR1714

import warp as wp

from toile.geometry.moving_surface_kernels import place_on_triangle

# Iterations of conservative advancement, after which the time reached so far counts.
_ADVANCES = 200


@wp.func
def places_on_edges(p0: wp.vec3d, p1: wp.vec3d, q0: wp.vec3d, q1: wp.vec3d):
    """Shares s, t of the places where two edges are nearest (Ericson, Real-Time Collision Detection)."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    d1 = p1 - p0
    d2 = q1 - q0
    r = p0 - q0
    a = wp.dot(d1, d1)
    e = wp.dot(d2, d2)
    f = wp.dot(d2, r)
    c = wp.dot(d1, r)
    b = wp.dot(d1, d2)
    area = a * e - b * b
    s = zero
    if area > wp.float64(1.0e-12) * a * e:
        s = wp.clamp((b * f - c * e) / area, zero, one)
    t = (b * s + f) / e
    if t < zero:
        t = zero
        s = wp.clamp(-c / a, zero, one)
    elif t > one:
        t = one
        s = wp.clamp((b - c) / a, zero, one)
    return wp.vec2d(s, t)


@wp.func
def pair_weights(of_face: wp.bool, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d):
    """Weights of the four vertices in the two nearest places of a pair."""
    if of_face:
        w = place_on_triangle(x0, x1, x2, x3)
        return wp.vec4d(wp.float64(1.0), w[0], w[1], w[2])
    on = places_on_edges(x0, x1, x2, x3)
    one = wp.float64(1.0)
    return wp.vec4d(one - on[0], on[0], one - on[1], on[1])


@wp.func
def pair_distance(of_face: wp.bool, x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, x3: wp.vec3d):
    """Distance of the two nearest places of a pair."""
    w = pair_weights(of_face, x0, x1, x2, x3)
    if of_face:
        return wp.length(x0 - w[1] * x1 - w[2] * x2 - w[3] * x3)
    return wp.length(w[0] * x0 + w[1] * x1 - w[2] * x2 - w[3] * x3)


@wp.func
def single(p: wp.vec3d):
    """In single precision."""
    return wp.vec3f(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))


@wp.kernel(enable_backward=False)
def boxes(
    x: wp.array(dtype=wp.vec3d),
    elements: wp.array(dtype=wp.int32, ndim=2),
    margin: wp.float32,
    lowers: wp.array(dtype=wp.vec3f),
    uppers: wp.array(dtype=wp.vec3f),
):
    """Boxes of elements with a margin."""
    i = wp.tid()
    low = single(x[elements[i, 0]])
    high = low
    for k in range(1, elements.shape[1]):
        p = single(x[elements[i, k]])
        low = wp.min(low, p)
        high = wp.max(high, p)
    around = wp.vec3f(margin, margin, margin)
    lowers[i] = low - around
    uppers[i] = high + around


@wp.kernel(enable_backward=False)
def near_faces(
    bvh: wp.uint64,
    x: wp.array(dtype=wp.vec3d),
    faces: wp.array(dtype=wp.int32, ndim=2),
    held: wp.array(dtype=wp.int32),
    reach: wp.float64,
    count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.int32, ndim=2),
    distances: wp.array(dtype=wp.float64),
):
    """Pairs of a vertex and a face that are nearer than ``reach``; boxes of the tree are that much larger."""
    i = wp.tid()
    p = x[i]
    query = wp.bvh_query_aabb(bvh, single(p), single(p))
    t = wp.int32(0)
    while wp.bvh_query_next(query, t):
        a = faces[t, 0]
        b = faces[t, 1]
        c = faces[t, 2]
        if i != a and i != b and i != c and held[i] * held[a] * held[b] * held[c] == 0:
            d = pair_distance(True, p, x[a], x[b], x[c])
            if d < reach:
                place = wp.atomic_add(count, 0, 1)
                if place < pairs.shape[0]:
                    pairs[place, 0] = i
                    pairs[place, 1] = a
                    pairs[place, 2] = b
                    pairs[place, 3] = c
                    distances[place] = d


@wp.kernel(enable_backward=False)
def near_edges(
    bvh: wp.uint64,
    x: wp.array(dtype=wp.vec3d),
    edges: wp.array(dtype=wp.int32, ndim=2),
    held: wp.array(dtype=wp.int32),
    reach: wp.float64,
    count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.int32, ndim=2),
    distances: wp.array(dtype=wp.float64),
):
    """Pairs of edges that are nearer than ``reach``; boxes of the tree are that much larger."""
    i = wp.tid()
    a = edges[i, 0]
    b = edges[i, 1]
    p = x[a]
    q = x[b]
    query = wp.bvh_query_aabb(bvh, wp.min(single(p), single(q)), wp.max(single(p), single(q)))
    j = wp.int32(0)
    while wp.bvh_query_next(query, j):
        c = edges[j, 0]
        d = edges[j, 1]
        apart = a != c and a != d and b != c and b != d
        if j > i and apart and held[a] * held[b] * held[c] * held[d] == 0:
            distance = pair_distance(False, p, q, x[c], x[d])
            if distance < reach:
                place = wp.atomic_add(count, 0, 1)
                if place < pairs.shape[0]:
                    pairs[place, 0] = a
                    pairs[place, 1] = b
                    pairs[place, 2] = c
                    pairs[place, 3] = d
                    distances[place] = distance


@wp.kernel(enable_backward=False)
def nearest_of_pairs(
    x: wp.array(dtype=wp.vec3d),
    pairs: wp.array(dtype=wp.int32, ndim=2),
    n_faces: wp.int32,
    weights: wp.array(dtype=wp.vec4d),
    distances: wp.array(dtype=wp.float64),
):
    """Weights of the nearest places of every pair, and their distance."""
    i = wp.tid()
    x0 = x[pairs[i, 0]]
    x1 = x[pairs[i, 1]]
    x2 = x[pairs[i, 2]]
    x3 = x[pairs[i, 3]]
    weights[i] = pair_weights(i < n_faces, x0, x1, x2, x3)
    distances[i] = pair_distance(i < n_faces, x0, x1, x2, x3)


@wp.kernel(enable_backward=False)
def contact_times(
    x: wp.array(dtype=wp.vec3d),
    moves: wp.array(dtype=wp.vec3d),
    known: wp.array(dtype=wp.vec3d),
    pairs: wp.array(dtype=wp.int32, ndim=2),
    n_faces: wp.int32,
    known_distances: wp.array(dtype=wp.float64),
    passing: wp.array(dtype=wp.int32),
    kept: wp.float64,
    times: wp.array(dtype=wp.float64),
):
    """Lower the times of a pair's vertices to that at which its distance is down to the share ``kept`` of it.

    Vertices go from x to x + moves between the times 0 and 1. By additive conservative advancement (Li,
    Kaufman, Jiang, Codimensional Incremental Potential Contact, ACM Transactions on Graphics 40(4), 2021,
    section 5): a pair that is d apart can't meet before its two sides have gone d together.
    """
    i = wp.tid()
    zero = wp.float64(0.0)
    quarter = wp.float64(0.25)
    a = pairs[i, 0]
    b = pairs[i, 1]
    c = pairs[i, 2]
    d = pairs[i, 3]
    if passing[a] + passing[b] + passing[c] + passing[d] > 0:
        return
    # What all four do together brings them no nearer.
    u0 = x[a] - known[a]
    u1 = x[b] - known[b]
    u2 = x[c] - known[c]
    u3 = x[d] - known[d]
    mean = (u0 + u1 + u2 + u3) * quarter
    m0 = moves[a]
    m1 = moves[b]
    m2 = moves[c]
    m3 = moves[d]
    shift = (m0 + m1 + m2 + m3) * quarter
    m0 = m0 - shift
    m1 = m1 - shift
    m2 = m2 - shift
    m3 = m3 - shift
    g0 = wp.max(wp.length(u0 - mean), wp.length(u0 - mean + m0))
    g1 = wp.max(wp.length(u1 - mean), wp.length(u1 - mean + m1))
    g2 = wp.max(wp.length(u2 - mean), wp.length(u2 - mean + m2))
    g3 = wp.max(wp.length(u3 - mean), wp.length(u3 - mean + m3))
    of_face = i < n_faces
    gone = wp.max(g0, g1) + wp.max(g2, g3)
    if of_face:
        gone = g0 + wp.max(wp.max(g1, g2), g3)
    if gone < wp.float64(0.5) * known_distances[i]:
        return
    x0 = x[a]
    x1 = x[b]
    x2 = x[c]
    x3 = x[d]
    speed = wp.max(wp.length(m0), wp.length(m1)) + wp.max(wp.length(m2), wp.length(m3))
    if of_face:
        speed = wp.length(m0) + wp.max(wp.max(wp.length(m1), wp.length(m2)), wp.length(m3))
    distance = pair_distance(of_face, x0, x1, x2, x3)
    limit = kept * distance
    if speed <= distance - limit:
        return
    time = zero
    for _ in range(_ADVANCES):
        time += wp.float64(0.9) * (distance - limit) / speed + wp.float64(1.0e-9)
        if time >= wp.float64(1.0):
            return
        distance = pair_distance(of_face, x0 + time * m0, x1 + time * m1, x2 + time * m2, x3 + time * m3)
        if distance - limit < wp.float64(1.0e-2) * limit:
            break
    wp.atomic_min(times, a, time)
    wp.atomic_min(times, b, time)
    wp.atomic_min(times, c, time)
    wp.atomic_min(times, d, time)


@wp.func
def side(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Six times the signed volume of a tetrahedron."""
    return wp.dot(d - a, wp.cross(b - a, c - a))


@wp.kernel(enable_backward=False)
def crossing_faces(
    bvh: wp.uint64,
    x: wp.array(dtype=wp.vec3d),
    edges: wp.array(dtype=wp.int32, ndim=2),
    faces: wp.array(dtype=wp.int32, ndim=2),
    count: wp.array(dtype=wp.int32),
    marks: wp.array(dtype=wp.int32),
):
    """Number of faces that each edge goes through, of those that share no vertex; marks at the vertices."""
    i = wp.tid()
    a = edges[i, 0]
    b = edges[i, 1]
    p = x[a]
    q = x[b]
    query = wp.bvh_query_aabb(bvh, wp.min(single(p), single(q)), wp.max(single(p), single(q)))
    t = wp.int32(0)
    zero = wp.float64(0.0)
    while wp.bvh_query_next(query, t):
        c = faces[t, 0]
        d = faces[t, 1]
        e = faces[t, 2]
        apart = a != c and a != d and a != e and b != c and b != d and b != e
        if apart and side(x[c], x[d], x[e], p) * side(x[c], x[d], x[e], q) < zero:
            s0 = side(p, q, x[c], x[d])
            s1 = side(p, q, x[d], x[e])
            s2 = side(p, q, x[e], x[c])
            if (s0 > zero and s1 > zero and s2 > zero) or (s0 < zero and s1 < zero and s2 < zero):
                count[i] = count[i] + 1
                marks[a] = 1
                marks[b] = 1
                marks[c] = 1
                marks[d] = 1
                marks[e] = 1
