"""Stage 1, rasterize: the nearest face under each pixel centre."""

# Kernels are Python in syntax only: float(0.0) declares a variable that a loop may change, and arrays and
# numbers follow Warp's own typing rules.
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def, operator"

import torch
import warp as wp
from torch import Tensor

from toile.rendering.base import Fragments
from toile.rendering.warp.arrays import launch, share, span

wp.set_module_options({"enable_backward": False})

EMPTY = 2**63 - 1
"""Key of a pixel that shows nothing; its low half reads as face -1."""


@wp.func
def edge_function(a: wp.vec3, b: wp.vec3, x: float, y: float):
    """Twice the signed area of (a, b, pixel), from screen coordinates [px²]."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


@wp.kernel
def rasterize_kernel(
    screen: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    n_vertices: int,
    height: int,
    width: int,
    keys: wp.array[wp.int64],
):
    """One thread per (frame, face) walks the bounding box and keeps the smallest key of each pixel."""
    batch, t = wp.tid()
    corners = faces[t]
    i = corners[0]
    j = corners[1]
    k = corners[2]
    first = batch * n_vertices
    a = screen[first + i]
    b = screen[first + j]
    c = screen[first + k]
    if wp.min(wp.min(a[2], b[2]), c[2]) <= 0.0:
        return
    area = edge_function(a, b, c[0], c[1])
    if area == 0.0:
        return
    side = wp.sign(area)

    low_x = wp.max(wp.ceil(wp.min(wp.min(a[0], b[0]), c[0]) - 0.5), 0.0)
    low_y = wp.max(wp.ceil(wp.min(wp.min(a[1], b[1]), c[1]) - 0.5), 0.0)
    high_x = wp.min(wp.floor(wp.max(wp.max(a[0], b[0]), c[0]) - 0.5), float(width) - 1.0)
    high_y = wp.min(wp.floor(wp.max(wp.max(a[1], b[1]), c[1]) - 0.5), float(height) - 1.0)
    # Also false for nan, which must not reach the conversions to int.
    if not (low_x <= high_x and low_y <= high_y):
        return

    # Both faces at an edge must compute the same edge function up to its sign, or cracks open between
    # them. So each edge is walked from its lower vertex index, and nothing is accumulated along the way.
    a_origin = b
    a_end = c
    a_side = side
    if j > k:
        a_origin = c
        a_end = b
        a_side = -side
    b_origin = c
    b_end = a
    b_side = side
    if k > i:
        b_origin = a
        b_end = c
        b_side = -side
    c_origin = a
    c_end = b
    c_side = side
    if i > j:
        c_origin = b
        c_end = a
        c_side = -side
    # 1 / z is linear on the screen.
    scale = 1.0 / wp.abs(area)
    a_near = scale / a[2]
    b_near = scale / b[2]
    c_near = scale / c[2]

    for row in range(int(low_y), int(high_y) + 1):
        y = float(row) + 0.5
        a_row = (a_end[0] - a_origin[0]) * (y - a_origin[1])
        b_row = (b_end[0] - b_origin[0]) * (y - b_origin[1])
        c_row = (c_end[0] - c_origin[0]) * (y - c_origin[1])
        pixel = (batch * height + row) * width
        for column in range(int(low_x), int(high_x) + 1):
            x = float(column) + 0.5
            e_a = a_side * (a_row - (a_end[1] - a_origin[1]) * (x - a_origin[0]))
            e_b = b_side * (b_row - (b_end[1] - b_origin[1]) * (x - b_origin[0]))
            e_c = c_side * (c_row - (c_end[1] - c_origin[1]) * (x - c_origin[0]))
            if wp.min(wp.min(e_a, e_b), e_c) >= 0.0:
                nearness = e_a * a_near + e_b * b_near + e_c * c_near
                # Positive floats sort like their bits. The last four bits (1e-6 of the depth) are
                # rounded off, so that rounding errors do not decide between faces at equal depth.
                order = 0x7FFFFFF - ((wp.cast(nearness, wp.int32) + 8) >> 4)
                key = (wp.int64(order) << wp.int64(32)) | wp.int64(t)
                if key < keys[pixel + column]:
                    wp.atomic_min(keys, pixel + column, key)


@wp.kernel
def fragments_kernel(
    screen: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    keys: wp.array[wp.int64],
    n_vertices: int,
    height: int,
    width: int,
    span: int,
    face: wp.array[wp.int64],
    barycentrics: wp.array[wp.vec3],
    depth: wp.array[float],
):
    """Unpack the keys into face, perspective-correct barycentrics and depth."""
    batch, row, part = wp.tid()
    pixel = (batch * height + row) * width
    y = float(row) + 0.5
    for column in range(part * span, wp.min((part + 1) * span, width)):
        x = float(column) + 0.5
        t = wp.int32(keys[pixel + column])
        face[pixel + column] = wp.int64(t)
        if t < 0:
            barycentrics[pixel + column] = wp.vec3(0.0, 0.0, 0.0)
            depth[pixel + column] = 0.0
        else:
            corners = faces[t]
            first = batch * n_vertices
            a = screen[first + corners[0]]
            b = screen[first + corners[1]]
            c = screen[first + corners[2]]
            e = wp.vec3(edge_function(b, c, x, y), edge_function(c, a, x, y), edge_function(a, b, x, y))
            w = wp.vec3(e[0] / a[2], e[1] / b[2], e[2] / c[2])
            w = w / (w[0] + w[1] + w[2])
            barycentrics[pixel + column] = w
            depth[pixel + column] = w[0] * a[2] + w[1] * b[2] + w[2] * c[2]


def rasterize(screen: Tensor, faces: Tensor, height: int, width: int) -> Tensor:
    """Find the nearest face of each pixel.

    Race-free on a GPU: depth and face index are packed into one 64-bit key, and the smallest key wins.

    Args:
        screen: (B, V, 3) as (x [px], y [px], z [m]), z = 0 marks a vertex behind the camera; float32.
        faces: (T, 3), int32.
        height: image height [px].
        width: image width [px].

    Returns:
        Keys (B, h, w), int64; the low 32 bits are the face index, or -1.
    """
    keys = torch.full((screen.shape[0], height, width), EMPTY, dtype=torch.int64, device=screen.device)
    inputs = [
        share(screen, wp.vec3),
        share(faces, wp.vec3i),
        screen.shape[1],
        height,
        width,
        share(keys, wp.int64),
    ]
    launch(rasterize_kernel, (screen.shape[0], faces.shape[0]), inputs, screen.device)
    return keys


def fragments(screen: Tensor, faces: Tensor, keys: Tensor) -> Fragments:
    """Unpack the keys of ``rasterize`` into what lies under each pixel centre."""
    batch, height, width = keys.shape
    device = screen.device
    face = torch.empty_like(keys)
    barycentrics = torch.empty((batch, height, width, 3), device=device)
    depth = torch.empty((batch, height, width), device=device)
    step = span(width, device)
    inputs = [
        share(screen, wp.vec3),
        share(faces, wp.vec3i),
        share(keys, wp.int64),
        screen.shape[1],
        height,
        width,
        step,
        share(face, wp.int64),
        share(barycentrics, wp.vec3),
        share(depth, wp.float32),
    ]
    launch(fragments_kernel, (batch, height, -(-width // step)), inputs, device)
    return Fragments(face, barycentrics, depth)
