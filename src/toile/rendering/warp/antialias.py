"""Stage 4, antialias: analytic coverage where a silhouette edge passes between two pixel centres.

The idea is that of the antialias operation in Laine et al. 2020, section 3.6: an edge that is steeper than
45° blends horizontal neighbours, any other edge blends vertical neighbours, and the blend weight is how far
the edge reaches past the middle between the two pixel centres. Summed along an edge, the weights are its
covered area by the midpoint rule, so the area has the right gradient with respect to the two ends.

Unlike there, the work starts from the edges and not from the pixel pairs: each silhouette edge walks along
the pixel centres that it passes and claims the pair on either side of it. Where several claim one pair, as
on the ragged contour of a fold whose triangles are smaller than a pixel, the one that reaches furthest
outwards is the outline and wins. Triangles too thin to own a pixel are found this way, and the cost grows
with the length of the silhouette rather than with the image. A pixel at the image's border is not blended
with what lies beyond it.
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

from toile.rendering.edges import MeshEdges
from toile.rendering.warp.arrays import launch, share
from toile.rendering.warp.rasterize import edge_function

wp.set_module_options({"enable_backward": False})

CLAIM = wp.constant(0)
BLEND = wp.constant(1)
BACKWARD = wp.constant(2)
DEPTH_MARGIN = wp.constant(8.0)
"""Depth range, in multiples of that of the faces at an edge, in which a pixel shows the same sheet.

Measured on folded grids of 8² to 64² vertices in a 64×48 image: with 0 the area's gradient loses 16 to 40 %
where triangles are smaller than a pixel, with 4 to 32 it is within 3 %.
"""


@wp.func
def touches(corners: wp.vec3i, vertex: int):
    """Whether a face has this vertex."""
    return corners[0] == vertex or corners[1] == vertex or corners[2] == vertex


@wp.func
def nearness(screen: wp.array[wp.vec3], first: int, corners: wp.vec3i, x: float, y: float):
    """1 / z [1/m] of the plane of a face at a point of the screen."""
    a = screen[first + corners[0]]
    b = screen[first + corners[1]]
    c = screen[first + corners[2]]
    e_a = edge_function(b, c, x, y)
    e_b = edge_function(c, a, x, y)
    e_c = edge_function(a, b, x, y)
    return (e_a / a[2] + e_b / b[2] + e_c / c[2]) / (e_a + e_b + e_c)


@wp.kernel
def antialias_kernel(
    screen: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    edges: wp.array[wp.vec2i],
    opposite: wp.array[wp.vec2i],
    keys: wp.array[wp.int64],
    n_vertices: int,
    height: int,
    width: int,
    winners: wp.array[wp.int64],
    mode: int,
    rgb: wp.array[wp.vec3],
    silhouette: wp.array[float],
    grad_rgb: wp.array[wp.vec3],
    grad_silhouette: wp.array[float],
    out_rgb: wp.array[wp.vec3],
    out_silhouette: wp.array[float],
    grad_screen: wp.array[wp.vec3],
):
    """One thread per (frame, edge), in one of three modes.

    CLAIM writes to ``winners``, two slots per pixel: the pair with the pixel below and with the one to the
    right. BLEND adds to ``out_*``. BACKWARD reads the gradients of these in ``grad_*``, and adds those with
    respect to ``rgb`` to ``out_rgb`` and those with respect to the edge's ends to ``grad_screen``.
    """
    batch, edge = wp.tid()
    first = batch * n_vertices
    ends = edges[edge]
    others = opposite[edge]
    p0 = screen[first + ends[0]]
    p1 = screen[first + ends[1]]
    if wp.min(p0[2], p1[2]) <= 0.0:
        return

    along = int(1)  # the edge runs along y: blend horizontal neighbours
    if wp.abs(p1[0] - p0[0]) > wp.abs(p1[1] - p0[1]):
        along = 0
    across = 1 - along
    low = int(0)
    if p0[along] > p1[along]:
        low = 1
        swap = p0
        p0 = p1
        p1 = swap
    length = p1[along] - p0[along]
    if not (length > 0.0):
        return
    slope = (p1[across] - p0[across]) / length

    # On which side the cloth lies; both faces on one side make a contour, one on each side does not.
    side_0 = float(0.0)
    side_1 = float(0.0)
    o = screen[first + others[0]]
    if o[2] > 0.0:
        side_0 = wp.sign(o[across] - p0[across] - slope * (o[along] - p0[along]))
    if others[1] >= 0:
        o = screen[first + others[1]]
        if o[2] > 0.0:
            side_1 = wp.sign(o[across] - p0[across] - slope * (o[along] - p0[along]))
    if side_0 * side_1 < 0.0 or side_0 + side_1 == 0.0:
        return
    inside = wp.sign(side_0 + side_1)

    # Depth range of the sheet beside the edge.
    lowest = wp.min(p0[2], p1[2])
    highest = wp.max(p0[2], p1[2])
    for side in range(2):
        if others[side] >= 0:
            z = screen[first + others[side]][2]
            if z > 0.0:
                lowest = wp.min(lowest, z)
                highest = wp.max(highest, z)
    margin = DEPTH_MARGIN * (highest - lowest)
    lowest -= margin
    highest += margin

    n_lines = height
    n_pixels = width
    line_stride = width
    pixel_stride = int(1)
    if along == 0:
        n_lines = width
        n_pixels = height
        line_stride = 1
        pixel_stride = width
    first_line = wp.max(wp.ceil(p0[along] - 0.5), 0.0)
    last_line = wp.min(wp.ceil(p1[along] - 0.5) - 1.0, float(n_lines) - 1.0)
    if not (first_line <= last_line):
        return

    grad_0 = float(0.0)
    grad_1 = float(0.0)
    for line in range(int(first_line), int(last_line) + 1):
        position = float(line) + 0.5
        t = (position - p0[along]) / length
        crossing = p0[across] + (position - p0[along]) * slope
        before = wp.floor(crossing - 0.5)
        if before >= 0.0 and before + 1.0 < float(n_pixels):
            beyond = crossing - before - 1.0  # past the middle between the two centres, in [-0.5, 0.5)
            here = batch * height * width + line * line_stride + int(before) * pixel_stride
            p = here
            q = here + pixel_stride
            if inside > 0.0:
                p = here + pixel_stride
                q = here
                beyond = -beyond
            slot = here * 2 + across
            if mode == CLAIM:
                face_p = wp.int32(keys[p])
                face_q = wp.int32(keys[q])
                visible = face_p >= 0 and face_p != face_q
                if visible:
                    # The inner pixel has to show the cloth beside this edge, else the edge is hidden.
                    c = faces[face_p]
                    visible = touches(c, ends[0]) or touches(c, ends[1])
                    visible = visible or touches(c, others[0]) or touches(c, others[1])
                    if not visible:
                        centre = before + 0.5
                        if inside > 0.0:
                            centre = before + 1.5
                        x = centre
                        y = position
                        if along == 0:
                            x = position
                            y = centre
                        z = 1.0 / nearness(screen, first, c, x, y)
                        visible = z > lowest and z < highest
                if visible and face_q >= 0:
                    # The outer pixel has to show something behind the edge.
                    x = crossing
                    y = position
                    if along == 0:
                        x = position
                        y = crossing
                    visible = (1.0 - t) / p0[2] + t / p1[2] > nearness(screen, first, faces[face_q], x, y)
                if visible:
                    # The edge that reaches furthest over the outer pixel is the outline.
                    reach = wp.int64((beyond + 0.5) * 16777216.0)
                    wp.atomic_max(winners, slot, (reach << wp.int64(32)) | wp.int64(edge))
            elif wp.int32(winners[slot]) == edge:
                target = p
                if beyond > 0.0:
                    target = q
                if mode == BLEND:
                    wp.atomic_add(out_rgb, target, (rgb[p] - rgb[q]) * beyond)
                    wp.atomic_add(out_silhouette, target, (silhouette[p] - silhouette[q]) * beyond)
                else:
                    g = grad_rgb[target]
                    wp.atomic_add(out_rgb, p, g * beyond)
                    wp.atomic_add(out_rgb, q, g * -beyond)
                    weight = -inside * (
                        wp.dot(g, rgb[p] - rgb[q]) + grad_silhouette[target] * (silhouette[p] - silhouette[q])
                    )
                    grad_0 += weight * (1.0 - t)
                    grad_1 += weight * t
    if mode == BACKWARD and (grad_0 != 0.0 or grad_1 != 0.0):
        at_0 = wp.vec3(grad_0, -slope * grad_0, 0.0)
        at_1 = wp.vec3(grad_1, -slope * grad_1, 0.0)
        if along == 0:
            at_0 = wp.vec3(-slope * grad_0, grad_0, 0.0)
            at_1 = wp.vec3(-slope * grad_1, grad_1, 0.0)
        wp.atomic_add(grad_screen, first + ends[low], at_0)
        wp.atomic_add(grad_screen, first + ends[1 - low], at_1)


def _run(
    mode: int,
    screen: Tensor,
    faces: Tensor,
    edges: MeshEdges,
    keys: Tensor,
    winners: Tensor,
    rgb: Tensor,
    silhouette: Tensor,
    grads: tuple[Tensor, Tensor],
    outs: tuple[Tensor, Tensor],
    grad_screen: Tensor,
) -> None:
    inputs = [
        share(screen, wp.vec3),
        share(faces, wp.vec3i),
        share(edges.vertices, wp.vec2i),
        share(edges.opposite, wp.vec2i),
        share(keys, wp.int64),
        screen.shape[1],
        keys.shape[1],
        keys.shape[2],
        share(winners, wp.int64),
        mode,
        share(rgb, wp.vec3),
        share(silhouette, wp.float32),
        share(grads[0], wp.vec3),
        share(grads[1], wp.float32),
        share(outs[0], wp.vec3),
        share(outs[1], wp.float32),
        share(grad_screen, wp.vec3),
    ]
    launch(antialias_kernel, (screen.shape[0], edges.vertices.shape[0]), inputs, screen.device)


def _claim(
    screen: Tensor, faces: Tensor, edges: MeshEdges, keys: Tensor, rgb: Tensor, silhouette: Tensor
) -> Tensor:
    """Winning edge of each pixel pair (B, h, w, 2), int64; in its low 32 bits, -1 where there is none."""
    winners = torch.full((*keys.shape, 2), -1, dtype=torch.int64, device=keys.device)
    images = rgb, silhouette
    _run(CLAIM, screen, faces, edges, keys, winners, rgb, silhouette, images, images, screen)
    return winners


class Antialias(torch.autograd.Function):
    """(screen, colour, coverage) -> colour and coverage, blended across the silhouette."""

    @staticmethod
    def forward(
        ctx: Any,
        screen: Tensor,
        rgb: Tensor,
        silhouette: Tensor,
        faces: Tensor,
        edges: MeshEdges,
        keys: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Blend ``rgb`` (B, h, w, 3) and ``silhouette`` (B, h, w); all indices int32."""
        before = rgb, silhouette
        after = rgb.clone(), silhouette.clone()
        winners = _claim(screen, faces, edges, keys, rgb, silhouette)
        _run(BLEND, screen, faces, edges, keys, winners, rgb, silhouette, before, after, screen)
        ctx.save_for_backward(screen, rgb, silhouette, faces, keys)
        ctx.edges = edges
        return after

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Any) -> Any:
        """Gradients to screen (B, V, 3) and to the colour before blending."""
        screen, rgb, silhouette, faces, keys = ctx.saved_tensors
        grad_after = grads[0].contiguous(), grads[1].contiguous()
        grad_before = grad_after[0].clone()
        grad_screen = torch.zeros_like(screen)
        # Claimed anew: cheaper than to keep 16 bytes per pixel until here.
        winners = _claim(screen, faces, ctx.edges, keys, rgb, silhouette)
        _run(
            BACKWARD,
            screen,
            faces,
            ctx.edges,
            keys,
            winners,
            rgb,
            silhouette,
            grad_after,
            (grad_before, grad_after[1]),
            grad_screen,
        )
        # Coverage before blending is 0 or 1 and has no gradient.
        return grad_screen, grad_before, None, None, None, None
