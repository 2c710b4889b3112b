"""Warp kernels of the questions to a moving surface."""

# Kernels are Python in syntax only: arrays and numbers follow Warp's own typing rules.
# mypy: disable-error-code="attr-defined, no-untyped-def, valid-type"

import warp as wp


@wp.kernel(enable_backward=False)
def nearest_places(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3f),
    reach: wp.float32,
    with_sign: wp.bool,
    faces: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.vec3f),
):
    """Nearest face (-1: none within reach), and of the point on it two barycentric coordinates and a side."""
    i = wp.tid()
    faces[i] = -1
    if with_sign:
        found = wp.mesh_query_point_sign_normal(mesh, points[i], reach)
        if found.result:
            faces[i] = found.face
            places[i] = wp.vec3f(found.u, found.v, found.sign)
    else:
        other = wp.mesh_query_point_no_sign(mesh, points[i], reach)
        if other.result:
            faces[i] = other.face
            places[i] = wp.vec3f(other.u, other.v, wp.float32(1.0))


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
