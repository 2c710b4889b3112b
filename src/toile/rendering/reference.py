"""Plain torch renderer: slow, short, in float64, differentiated by autograd. The oracle of the fast ones."""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.limits import Count
from toile.rendering.base import (
    Fragments,
    RenderedImages,
    Renderer,
    check_supersampling,
    downsample,
    to_screen,
)
from toile.rendering.edges import mesh_edges

DEPTH_MARGIN = 8.0
"""Depth range, in multiples of that of the faces at an edge, in which a pixel shows the same sheet."""


@final
class ReferenceRenderer(Renderer):
    """Renders frame by frame, face by face, edge by edge; for small meshes and small images.

    Args:
        supersampling: samples per pixel and axis; 1 draws at the image's own resolution.

    Raises:
        InputError: ``supersampling`` is not a whole number of at least 1.
    """

    def __init__(self, supersampling: Count = 1) -> None:
        self.supersampling = check_supersampling(supersampling)

    def _render(
        self, vertices: Tensor, faces: Tensor, texture_coordinates: Tensor, texture: Tensor, camera: Camera
    ) -> RenderedImages:
        fine = camera.scaled(self.supersampling)
        edges = mesh_edges(faces)
        frames = []
        for screen in to_screen(vertices.double(), fine):
            face = rasterize(screen.detach(), faces, fine.height, fine.width)
            uv, depth = interpolate(screen, faces, texture_coordinates.double(), face)
            covered = (face >= 0).double()
            colour = sample_texture(texture.double(), uv) * covered[..., None]
            image = torch.cat((colour, covered[..., None]), dim=-1)
            image = antialias(screen, faces, edges.vertices, edges.opposite, face, image)
            frames.append((image[..., :3], image[..., 3], depth))
        rgb, silhouette, depth = (torch.stack(part).float() for part in zip(*frames, strict=True))
        return downsample(RenderedImages(rgb, silhouette, depth), self.supersampling)

    def _rasterize(self, vertices: Tensor, faces: Tensor, camera: Camera) -> Fragments:
        frames = []
        for screen in to_screen(vertices.double(), camera):
            face = rasterize(screen, faces, camera.height, camera.width)
            weights, depth = barycentrics(screen, faces, face)
            frames.append((face, weights.float(), depth.float()))
        return Fragments(*(torch.stack(part) for part in zip(*frames, strict=True)))


def edge_function(a: Tensor, b: Tensor, p: Tensor) -> Tensor:
    """Twice the signed area of the screen triangle (a, b, p) [px²]; each (..., 2 or more)."""
    return (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
        p[..., 0] - a[..., 0]
    )


def pixel_centres(height: int, width: int, like: Tensor) -> Tensor:
    """Pixel centres (h, w, 2) as (x, y) [px]."""
    y = torch.arange(height, dtype=like.dtype, device=like.device) + 0.5
    x = torch.arange(width, dtype=like.dtype, device=like.device) + 0.5
    return torch.stack((x.expand(height, width), y[:, None].expand(height, width)), dim=-1)


def rasterize(screen: Tensor, faces: Tensor, height: int, width: int) -> Tensor:
    """Nearest face of each pixel (h, w), int64, or -1; ``screen`` (V, 3) as in ``to_screen``."""
    centres = pixel_centres(height, width, screen)
    best = torch.zeros_like(centres[..., 0])
    face = torch.full((height, width), -1, dtype=torch.int64, device=screen.device)
    for t, corners in enumerate(screen[faces]):
        a, b, c = corners
        area = edge_function(a, b, c)
        if (corners[:, 2] <= 0).any() or area == 0:
            continue
        e = torch.stack([edge_function(*ends, centres) for ends in ((b, c), (c, a), (a, b))], dim=-1) / area
        nearness = (e / corners[:, 2]).sum(-1)  # 1 / z is linear on the screen
        # Within rounding of the depth found so far, the lower index keeps the pixel.
        wins = (e >= 0).all(-1) & (nearness > best * (1 + 1e-6))
        best = torch.where(wins, nearness, best)
        face[wins] = t
    return face


def barycentrics(screen: Tensor, faces: Tensor, face: Tensor) -> tuple[Tensor, Tensor]:
    """Perspective-correct barycentrics (h, w, 3) and depth (h, w) [m] of the ``face`` (h, w) hit, else 0."""
    hit = face >= 0
    corners = screen[faces[face[hit]]]  # (N, 3, 3)
    a, b, c = corners.unbind(1)
    p = pixel_centres(face.shape[0], face.shape[1], screen)[hit]
    e = torch.stack((edge_function(b, c, p), edge_function(c, a, p), edge_function(a, b, p)), dim=-1)
    w = e / corners[..., 2]
    w = w / w.sum(-1, keepdim=True)
    weights = screen.new_zeros(*face.shape, 3).index_put((hit,), w)
    depth = screen.new_zeros(face.shape).index_put((hit,), (w * corners[..., 2]).sum(-1))
    return weights, depth


def interpolate(screen: Tensor, faces: Tensor, attribute: Tensor, face: Tensor) -> tuple[Tensor, Tensor]:
    """Vertex ``attribute`` (V, C) at each pixel (h, w, C), and depth (h, w) [m]; 0 where nothing was hit."""
    weights, depth = barycentrics(screen, faces, face)
    corners = attribute[faces[face.clamp(min=0)]]  # (h, w, 3, C)
    return (weights[..., None] * corners).sum(-2), depth


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Bilinear lookup of (h_t, w_t, 3) at (h, w, 2), clamped at the border -> (h, w, 3)."""
    height, width = texture.shape[:2]
    x = (uv[..., 0] * width - 0.5).clamp(0, width - 1)
    y = (uv[..., 1] * height - 0.5).clamp(0, height - 1)
    left, top = x.detach().long(), y.detach().long()
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    s, r = (x - left)[..., None], (y - top)[..., None]
    above = texture[top, left] * (1 - s) + texture[top, right] * s
    below = texture[bottom, left] * (1 - s) + texture[bottom, right] * s
    return above * (1 - r) + below * r


def antialias(
    screen: Tensor, faces: Tensor, edges: Tensor, opposite: Tensor, face: Tensor, image: Tensor
) -> Tensor:
    """Blend ``image`` (h, w, C) across silhouette edges; see ``toile.rendering.warp.antialias``.

    ``edges`` and ``opposite`` (E, 2) are those of ``MeshEdges``; ``face`` (h, w) is what the pixels show.
    """
    flat = image.reshape(-1, image.shape[-1])
    claims = [
        _claims(screen, faces, *edge, face) for edge in zip(edges.tolist(), opposite.tolist(), strict=True)
    ]
    # The edge that reaches furthest over the outer pixel of a pair is the outline.
    winners: dict[tuple[int, int], tuple[float, Tensor]] = {}
    for p, q, beyond in claims:
        for inner, outer, weight in zip(p.tolist(), q.tolist(), beyond, strict=True):
            pair = min(inner, outer), max(inner, outer)
            reach = float(weight.detach())
            if pair not in winners or reach >= winners[pair][0]:
                winners[pair] = reach, torch.stack((weight, *weight.new_tensor((inner, outer))))
    if not winners:
        return image
    beyond, inner, outer = torch.stack([record for _, record in winners.values()]).unbind(-1)
    p, q = inner.long(), outer.long()
    target = torch.where(beyond > 0, q, p)
    return flat.index_add(0, target, beyond[:, None] * (flat[p] - flat[q])).reshape(image.shape)


def _claims(
    screen: Tensor, faces: Tensor, ends: list[int], others: list[int], face: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixel pairs between which one edge is a visible silhouette.

    Returns the inner pixels (N,), the outer pixels (N,), both as flat indices, and how far (N,) [px] the edge
    reaches past the middle between the two, towards the outer one.
    """
    nothing = face.new_zeros(0), face.new_zeros(0), screen.new_zeros(0)
    p0, p1 = screen[ends[0]], screen[ends[1]]
    third = [screen[o] for o in others if o >= 0 and screen[o, 2] > 0]
    if p0[2] <= 0 or p1[2] <= 0 or not third:
        return nothing
    sides = [float(torch.sign(edge_function(p0, p1, o)).detach()) for o in third]
    if min(sides) * max(sides) < 0 or sum(sides) == 0:
        return nothing  # cloth on both sides, or seen exactly edge-on
    along = 0 if abs(p1[0] - p0[0]) > abs(p1[1] - p0[1]) else 1
    across = 1 - along
    if p0[along] > p1[along]:
        p0, p1 = p1, p0
    if p0[along] == p1[along]:
        return nothing

    # Lines of pixel centres that the edge passes: rows if it is steep, else columns.
    height, width = face.shape
    n_lines, n_pixels = (height, width) if along == 1 else (width, height)
    line = torch.arange(n_lines, dtype=screen.dtype, device=screen.device) + 0.5
    line = line[(line >= p0[along]) & (line < p1[along])]
    t = (line - p0[along]) / (p1[along] - p0[along])
    crossing = p0[across] + t * (p1[across] - p0[across])
    before = torch.floor(crossing.detach() - 0.5)
    kept = (before >= 0) & (before + 1 < n_pixels)
    line, t, crossing, before = line[kept], t[kept], crossing[kept], before[kept]

    def flat_index(pixel: Tensor) -> Tensor:
        row, column = (line, pixel) if along == 1 else (pixel, line)
        return row.long() * width + column.long()

    def on_screen(position: Tensor) -> Tensor:
        return torch.stack((position, line) if along == 1 else (line, position), dim=-1)

    slope = (p1[across] - p0[across]) / (p1[along] - p0[along])
    inside = sum(float((o[across] - p0[across] - (o[along] - p0[along]) * slope).detach()) for o in third)
    inner, outer = (before, before + 1) if inside < 0 else (before + 1, before)
    p, q = flat_index(inner), flat_index(outer)
    beyond = (crossing - before - 1) * (1 if inside < 0 else -1)

    # The inner pixel shows the sheet beside the edge: a face that touches it, or one at about its depth.
    flat_face = face.reshape(-1)
    face_p, face_q = flat_face[p], flat_face[q]
    around = torch.tensor([*ends, *(o for o in others if o >= 0)], device=face.device)
    touches = (faces[face_p.clamp(min=0)][:, :, None] == around).any(-1).any(-1)
    depths = torch.stack([v[2] for v in (p0, p1, *third)]).detach()
    margin = DEPTH_MARGIN * (depths.max() - depths.min())
    z = 1 / _nearness(screen, faces, face_p, on_screen(inner + 0.5))
    beside = touches | ((z > depths.min() - margin) & (z < depths.max() + margin))
    # The outer pixel shows nothing, or something behind the edge.
    behind = _nearness(screen, faces, face_q, on_screen(crossing))
    in_front = (face_q < 0) | ((1 - t) / p0[2] + t / p1[2] > behind)

    visible = (face_p >= 0) & (face_p != face_q) & beside & in_front
    return p[visible], q[visible], beyond[visible]


def _nearness(screen: Tensor, faces: Tensor, face: Tensor, p: Tensor) -> Tensor:
    """1 / z (N,) [1/m] of the planes of faces (N,) at screen points (N, 2); no gradient."""
    corners = screen[faces[face.clamp(min=0)]].detach()
    p = p.detach()
    a, b, c = corners.unbind(1)
    e = torch.stack((edge_function(b, c, p), edge_function(c, a, p), edge_function(a, b, p)), dim=-1)
    return (e / corners[..., 2]).sum(-1) / e.sum(-1)
