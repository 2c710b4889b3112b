"""Stage 2, interpolate: perspective-correct texture coordinates and depth at each pixel centre.

With the edge functions e_i [px²] of a pixel and w_i = e_i / z_i, an attribute is Σ w_i a_i / Σ w_i. Along a
row every e_i is linear in x, so a run of pixels that show one face needs a single set-up.
"""

# Kernels are Python in syntax only: float(0.0) declares a variable that a loop may change, and arrays and
# numbers follow Warp's own typing rules.
# ruff: noqa: UP018, RUF046
# mypy: disable-error-code="arg-type, assignment, call-overload, index, misc, no-untyped-def, operator"

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from toile.rendering.warp.arrays import launch, share, span
from toile.rendering.warp.rasterize import edge_function

wp.set_module_options({"enable_backward": False})


@wp.kernel
def interpolate_kernel(
    screen: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    coordinates: wp.array[wp.vec2],
    keys: wp.array[wp.int64],
    n_vertices: int,
    height: int,
    width: int,
    span: int,
    uv: wp.array[wp.vec2],
    depth: wp.array[float],
):
    """One thread per (frame, row, span of pixels)."""
    batch, row, part = wp.tid()
    pixel = (batch * height + row) * width
    y = float(row) + 0.5
    run = int(-1)
    start = float(0.0)
    # Weight and attributes, relative to corner a, as value + slope * (x - start).
    w_0 = float(0.0)
    w_x = float(0.0)
    u_0 = float(0.0)
    u_x = float(0.0)
    v_0 = float(0.0)
    v_x = float(0.0)
    z_0 = float(0.0)
    z_x = float(0.0)
    u_a = float(0.0)
    v_a = float(0.0)
    z_a = float(0.0)
    for column in range(part * span, wp.min((part + 1) * span, width)):
        t = wp.int32(keys[pixel + column])
        if t < 0:
            uv[pixel + column] = wp.vec2(0.0, 0.0)
            depth[pixel + column] = 0.0
        else:
            x = float(column) + 0.5
            if t != run:
                run = t
                start = x
                corners = faces[t]
                first = batch * n_vertices
                a = screen[first + corners[0]]
                b = screen[first + corners[1]]
                c = screen[first + corners[2]]
                wa_0 = edge_function(b, c, x, y) / a[2]
                wb_0 = edge_function(c, a, x, y) / b[2]
                wc_0 = edge_function(a, b, x, y) / c[2]
                wa_x = (b[1] - c[1]) / a[2]
                wb_x = (c[1] - a[1]) / b[2]
                wc_x = (a[1] - b[1]) / c[2]
                w_0 = wa_0 + wb_0 + wc_0
                w_x = wa_x + wb_x + wc_x
                at_a = coordinates[corners[0]]
                to_b = coordinates[corners[1]] - at_a
                to_c = coordinates[corners[2]] - at_a
                u_a = at_a[0]
                v_a = at_a[1]
                z_a = a[2]
                u_0 = wb_0 * to_b[0] + wc_0 * to_c[0]
                u_x = wb_x * to_b[0] + wc_x * to_c[0]
                v_0 = wb_0 * to_b[1] + wc_0 * to_c[1]
                v_x = wb_x * to_b[1] + wc_x * to_c[1]
                z_0 = wb_0 * (b[2] - z_a) + wc_0 * (c[2] - z_a)
                z_x = wb_x * (b[2] - z_a) + wc_x * (c[2] - z_a)
            d = x - start
            scale = 1.0 / (w_0 + w_x * d)
            uv[pixel + column] = wp.vec2(u_a + (u_0 + u_x * d) * scale, v_a + (v_0 + v_x * d) * scale)
            depth[pixel + column] = z_a + (z_0 + z_x * d) * scale


@wp.func
def add_run(
    screen: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    coordinates: wp.array[wp.vec2],
    first: int,
    t: int,
    x: float,
    y: float,
    q: wp.vec4,
    q_x: wp.vec4,
    grad_screen: wp.array[wp.vec3],
    grad_coordinates: wp.array[wp.vec2],
):
    """Add the gradient of one run of pixels.

    The gradient with respect to w_i is g · (a_i - a) / w, with w the sum of the weights. It is linear in
    q = (g_u, g_v, g_z, g · a) / w, so the sums of q and of q * (x - start) over the run hold all of it.
    """
    corners = faces[t]
    a = screen[first + corners[0]]
    b = screen[first + corners[1]]
    c = screen[first + corners[2]]
    at_a = coordinates[corners[0]]
    to_b = coordinates[corners[1]] - at_a
    to_c = coordinates[corners[2]] - at_a
    dz_b = b[2] - a[2]
    dz_c = c[2] - a[2]
    near_a = 1.0 / a[2]
    near_b = 1.0 / b[2]
    near_c = 1.0 / c[2]
    ea_0 = edge_function(b, c, x, y)
    eb_0 = edge_function(c, a, x, y)
    ec_0 = edge_function(a, b, x, y)
    ea_x = b[1] - c[1]
    eb_x = c[1] - a[1]
    ec_x = a[1] - b[1]
    # Gradient with respect to each w_i, summed over the run, plain (h) and times x - start (k).
    h_a = -q[3]
    h_b = q[0] * to_b[0] + q[1] * to_b[1] + q[2] * dz_b - q[3]
    h_c = q[0] * to_c[0] + q[1] * to_c[1] + q[2] * dz_c - q[3]
    k_a = -q_x[3]
    k_b = q_x[0] * to_b[0] + q_x[1] * to_b[1] + q_x[2] * dz_b - q_x[3]
    k_c = q_x[0] * to_c[0] + q_x[1] * to_c[1] + q_x[2] * dz_c - q_x[3]
    # Through w_i = e_i / z_i to the depth, and through the attribute z itself (weight w_i / w).
    z_a = (q[2] * ea_0 + q_x[2] * ea_x - (h_a * ea_0 + k_a * ea_x) * near_a) * near_a
    z_b = (q[2] * eb_0 + q_x[2] * eb_x - (h_b * eb_0 + k_b * eb_x) * near_b) * near_b
    z_c = (q[2] * ec_0 + q_x[2] * ec_x - (h_c * ec_0 + k_c * ec_x) * near_c) * near_c
    # Gradient with respect to e_i. For e_a, over edge b→c: d/db = (c_y - y, x - c_x) and
    # d/dc = (y - b_y, b_x - x).
    h_a = h_a * near_a
    h_b = h_b * near_b
    h_c = h_c * near_c
    k_a = k_a * near_a
    k_b = k_b * near_b
    k_c = k_c * near_c
    wp.atomic_add(
        grad_screen,
        first + corners[0],
        wp.vec3(
            h_b * (y - c[1]) + h_c * (b[1] - y),
            h_b * (c[0] - x) - k_b + h_c * (x - b[0]) + k_c,
            z_a,
        ),
    )
    wp.atomic_add(
        grad_screen,
        first + corners[1],
        wp.vec3(
            h_c * (y - a[1]) + h_a * (c[1] - y),
            h_c * (a[0] - x) - k_c + h_a * (x - c[0]) + k_a,
            z_b,
        ),
    )
    wp.atomic_add(
        grad_screen,
        first + corners[2],
        wp.vec3(
            h_a * (y - b[1]) + h_b * (a[1] - y),
            h_a * (b[0] - x) - k_a + h_b * (x - a[0]) + k_b,
            z_c,
        ),
    )
    q_uv = wp.vec2(q[0], q[1])
    q_uv_x = wp.vec2(q_x[0], q_x[1])
    wp.atomic_add(grad_coordinates, corners[0], (q_uv * ea_0 + q_uv_x * ea_x) * near_a)
    wp.atomic_add(grad_coordinates, corners[1], (q_uv * eb_0 + q_uv_x * eb_x) * near_b)
    wp.atomic_add(grad_coordinates, corners[2], (q_uv * ec_0 + q_uv_x * ec_x) * near_c)


@wp.kernel
def interpolate_backward_kernel(
    screen: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    coordinates: wp.array[wp.vec2],
    keys: wp.array[wp.int64],
    n_vertices: int,
    height: int,
    width: int,
    span: int,
    uv: wp.array[wp.vec2],
    depth: wp.array[float],
    grad_uv: wp.array[wp.vec2],
    grad_depth: wp.array[float],
    has_grad_depth: int,
    grad_screen: wp.array[wp.vec3],
    grad_coordinates: wp.array[wp.vec2],
):
    """Sum each run of pixels in registers, then add it to the three corners."""
    batch, row, part = wp.tid()
    first = batch * n_vertices
    pixel = (batch * height + row) * width
    y = float(row) + 0.5
    run = int(-1)
    start = float(0.0)
    w_0 = float(0.0)
    w_x = float(0.0)
    u_a = float(0.0)
    v_a = float(0.0)
    z_a = float(0.0)
    q = wp.vec4(0.0, 0.0, 0.0, 0.0)
    q_x = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for column in range(part * span, wp.min((part + 1) * span, width)):
        t = wp.int32(keys[pixel + column])
        x = float(column) + 0.5
        if t != run:
            if run >= 0:
                add_run(
                    screen, faces, coordinates, first, run, start, y, q, q_x, grad_screen, grad_coordinates
                )
            run = t
            start = x
            q = wp.vec4(0.0, 0.0, 0.0, 0.0)
            q_x = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if t >= 0:
                corners = faces[t]
                a = screen[first + corners[0]]
                b = screen[first + corners[1]]
                c = screen[first + corners[2]]
                w_0 = (
                    edge_function(b, c, x, y) / a[2]
                    + edge_function(c, a, x, y) / b[2]
                    + edge_function(a, b, x, y) / c[2]
                )
                w_x = (b[1] - c[1]) / a[2] + (c[1] - a[1]) / b[2] + (a[1] - b[1]) / c[2]
                u_a = coordinates[corners[0]][0]
                v_a = coordinates[corners[0]][1]
                z_a = a[2]
        if t >= 0:
            d = x - start
            scale = 1.0 / (w_0 + w_x * d)
            here = uv[pixel + column]
            g = grad_uv[pixel + column]
            g_u = g[0] * scale
            g_v = g[1] * scale
            g_z = float(0.0)
            if has_grad_depth != 0:
                g_z = grad_depth[pixel + column] * scale
            s = g_u * (here[0] - u_a) + g_v * (here[1] - v_a) + g_z * (depth[pixel + column] - z_a)
            now = wp.vec4(g_u, g_v, g_z, s)
            q += now
            q_x += now * d
    if run >= 0:
        add_run(screen, faces, coordinates, first, run, start, y, q, q_x, grad_screen, grad_coordinates)


class Interpolate(torch.autograd.Function):
    """(screen, texture coordinates) -> texture coordinates and depth of each pixel."""

    @staticmethod
    def forward(
        ctx: Any, screen: Tensor, coordinates: Tensor, faces: Tensor, keys: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Interpolate (V, 2) ``coordinates`` and z to uv (B, h, w, 2) and depth (B, h, w) [m]."""
        batch, height, width = keys.shape
        uv = torch.empty((batch, height, width, 2), device=screen.device)
        depth = torch.empty((batch, height, width), device=screen.device)
        step = span(width, screen.device)
        inputs = [
            share(screen, wp.vec3),
            share(faces, wp.vec3i),
            share(coordinates, wp.vec2),
            share(keys, wp.int64),
            screen.shape[1],
            height,
            width,
            step,
            share(uv, wp.vec2),
            share(depth, wp.float32),
        ]
        launch(interpolate_kernel, (batch, height, -(-width // step)), inputs, screen.device)
        ctx.save_for_backward(screen, coordinates, faces, keys, uv, depth)
        ctx.set_materialize_grads(False)
        return uv, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        """Gradients to screen (B, V, 3) and coordinates (V, 2)."""
        screen, coordinates, faces, keys, uv, depth = ctx.saved_tensors
        grad_uv, grad_depth = grads
        batch, height, width = keys.shape
        grad_screen = torch.zeros_like(screen)
        grad_coordinates = torch.zeros_like(coordinates)
        grad_uv = torch.zeros_like(uv) if grad_uv is None else grad_uv.contiguous()
        has_depth = grad_depth is not None
        step = span(width, screen.device)
        inputs = [
            share(screen, wp.vec3),
            share(faces, wp.vec3i),
            share(coordinates, wp.vec2),
            share(keys, wp.int64),
            screen.shape[1],
            height,
            width,
            step,
            share(uv, wp.vec2),
            share(depth, wp.float32),
            share(grad_uv, wp.vec2),
            share(grad_depth.contiguous() if has_depth else depth, wp.float32),
            int(has_depth),
            share(grad_screen, wp.vec3),
            share(grad_coordinates, wp.vec2),
        ]
        launch(interpolate_backward_kernel, (batch, height, -(-width // step)), inputs, screen.device)
        return grad_screen, grad_coordinates, None, None
