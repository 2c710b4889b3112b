"""Checks of a scene's parts, each returning findings: loaders raise the first error, the doctor shows all.

The thresholds are plausibility limits for cloth in front of a camera, not tuning parameters: nothing here
changes data, and a warning never stops a loader.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.geometry.io import PolygonMesh
from toile.scenes.findings import Finding, Severity, has_errors
from toile.scenes.frame_times import check_times
from toile.scenes.scene import GroundTruth, Scene

FARTHEST_CLOTH = 50.0  # [m]; anything beyond is a template in millimetres or centimetres
STANDARD_GRAVITY = 9.81  # [m/s²]


def check_scene(scene: Scene) -> list[Finding]:
    """All checks that a loaded scene allows."""
    where = scene.name if scene.source is None else str(scene.source)
    grid = scene.grid
    findings = check_camera(uncropped_camera(scene), where)
    findings += check_template(scene.template.reshape(-1, 3), grid, scene.cloth_size, where)
    findings += check_pinned_vertices(scene.pinned_vertices, grid, where)
    findings += check_timing(scene.fps, where)
    if scene.times is not None:
        findings += check_times(scene.times.tolist(), scene.n_frames, scene.fps, where)
    findings += check_masks(scene.masks, where)
    if has_errors(findings):
        return findings
    findings += check_gravity(scene.gravity, scene.template, scene.pinned_vertices, where)
    findings += check_vertex_axes(
        scene.gravity, scene.template, scene.pinned_vertices, scene.cloth_size, where
    )
    findings += check_projection(scene, where)
    if not has_errors(findings):
        findings += check_texture(scene, where)
    if scene.ground_truth is not None:
        findings += check_ground_truth(scene.ground_truth, scene.template, scene.n_frames, where)
    return findings


def uncropped_camera(scene: Scene) -> Camera:
    """Camera of the original image of a cropped scene."""
    (top, left), (height, width) = scene.crop, scene.original_size
    if height == 0 or width == 0:
        height, width = scene.camera.height + top, scene.camera.width + left
    return scene.camera.crop(-top, -left, height, width)


def check_camera(camera: Camera, where: str) -> list[Finding]:
    """Finite positive focal lengths, principal point inside the (uncropped) image."""
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    got = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}"
    if not all(math.isfinite(value) for value in (fx, fy, cx, cy)):
        return [Finding(Severity.ERROR, "Camera intrinsics are not finite", where, "finite K", got)]
    if fx <= 0 or fy <= 0:
        return [Finding(Severity.ERROR, "Focal length is not positive", where, "fx > 0 and fy > 0 [px]", got)]
    findings = []
    w, h = camera.width, camera.height
    if not (0 <= cx <= w and 0 <= cy <= h):
        swapped = 0 <= cy <= w and 0 <= cx <= h
        findings.append(
            Finding(
                Severity.ERROR if swapped else Severity.WARNING,
                "Principal point is outside the image"
                + (": cx and cy seem to be exchanged" if swapped else ""),
                where,
                f"0 <= cx <= {w} and 0 <= cy <= {h}",
                got,
            )
        )
    if not 0.5 < fx / fy < 2:
        findings.append(
            Finding(Severity.WARNING, "Pixels are far from square", where, "fx within a factor 2 of fy", got)
        )
    return findings


def check_timing(fps: float, where: str) -> list[Finding]:
    """A finite, positive frame rate."""
    if not (math.isfinite(fps) and fps > 0):
        return [Finding(Severity.ERROR, "Frame rate is not positive", f"{where}: fps", "fps > 0", f"{fps:g}")]
    return []


def check_pinned_vertices(pinned: Sequence[int], grid: tuple[int, int], where: str) -> list[Finding]:
    """Pinned vertices are distinct indices of the grid; none is unusual, since the cloth then falls."""
    where, n = f"{where}: pinned_vertices", grid[0] * grid[1]
    outside = [k for k in pinned if not 0 <= k < n]
    if outside:
        return [
            Finding(
                Severity.ERROR,
                "Pinned vertex is out of range",
                where,
                f"indices i * {grid[1]} + j from 0 to {n - 1}",
                ", ".join(map(str, outside)),
            )
        ]
    twice = sorted({k for k in pinned if list(pinned).count(k) > 1})
    if twice:
        got = ", ".join(map(str, twice)) + " more than once"
        return [Finding(Severity.ERROR, "Pinned vertex is listed twice", where, "distinct indices", got)]
    if not pinned:
        expected = "the vertices that it hangs from, if it hangs"
        return [Finding(Severity.WARNING, "No vertex is pinned: the cloth falls", where, expected, "none")]
    return []


def check_faces(mesh: PolygonMesh, grid: tuple[int, int], where: str) -> list[Finding]:
    """The mesh is the H×W grid: H*W vertices, every grid cell covered by one quad or two triangles.

    A face within a single grid row or column has no area in the grid and only causes a warning (the published
    R7 template has three).
    """
    H, W = grid
    n = len(mesh.vertices)
    if n != H * W:
        root = math.isqrt(n)
        hint = f"; {root} x {root} would fit" if root * root == n else ""
        return [
            Finding(
                Severity.ERROR,
                "Template is not the declared grid",
                where,
                f"{H} x {W} = {H * W} vertices and {(H - 1) * (W - 1)} quads",
                f"{n} vertices and {len(mesh.polygons)} faces{hint}",
            )
        ]
    cells = {(i, j): 0 for i in range(H - 1) for j in range(W - 1)}
    degenerate, foreign = [], []
    for face in mesh.polygons:
        rows, columns = {k // W for k in face}, {k % W for k in face}
        i, j = min(rows), min(columns)
        if len(rows) == 1 or len(columns) == 1:
            degenerate.append(face)
        elif rows == {i, i + 1} and columns == {j, j + 1} and len(face) == len(set(face)):
            cells[i, j] += 2 if len(face) == 4 else 1
        else:
            foreign.append(face)
    findings = []
    if foreign:
        findings.append(
            Finding(
                Severity.ERROR,
                "Template faces are not grid quads: the vertex order is permuted, or the grid size is wrong",
                where,
                f"faces (k, k+1, k+{W}, k+{W + 1}) of a row-major {H} x {W} grid",
                f"{len(foreign)} of {len(mesh.polygons)} faces join other vertices, "
                f"first {tuple(foreign[0])} (zero-based)",
            )
        )
    elif mesh.polygons and any(count != 2 for count in cells.values()):
        cell, count = next((cell, count) for cell, count in cells.items() if count != 2)
        wrong = sum(count != 2 for count in cells.values())
        findings.append(
            Finding(
                Severity.ERROR,
                "Template faces do not cover the grid once",
                where,
                f"{(H - 1) * (W - 1)} quads (or twice as many triangles), one per grid cell",
                f"{len(mesh.polygons)} faces; {wrong} cells are covered wrongly, first {cell} "
                f"with {count / 2:g} quads",
            )
        )
    if degenerate:
        findings.append(
            Finding(
                Severity.WARNING,
                "Template has faces without area in the grid, ignored",
                where,
                "faces of four neighbours",
                f"{len(degenerate)} faces, first {tuple(degenerate[0])} (zero-based)",
            )
        )
    return findings


def check_template(
    positions: Tensor, grid: tuple[int, int], cloth_size: tuple[float, float], where: str
) -> list[Finding]:
    """Finite positions in metres in front of the camera, in row-major order, of the declared size.

    Args:
        positions: (V, 3) in file order, already in the OpenCV camera frame.
        grid: (H, W).
        cloth_size: rest length of the sides [m] along grid axis 0 and 1.
        where: file the positions come from.
    """
    H, W = grid
    if H < 2 or W < 2 or len(positions) != H * W:
        got = f"{len(positions)} vertices for a grid of {H} x {W}"
        return [Finding(Severity.ERROR, "Template is not the declared grid", where, f"{H * W} vertices", got)]
    bad = (~positions.isfinite()).any(-1).nonzero().flatten()
    if len(bad):
        k = int(bad[0])
        got = f"{len(bad)} vertices are not finite, first vertex {k}: {positions[k].tolist()}"
        return [Finding(Severity.ERROR, "Template has NaN or infinite positions", where, "finite [m]", got)]
    if not all(math.isfinite(side) and side > 0 for side in cloth_size):
        return [
            Finding(
                Severity.ERROR, "Cloth size is not positive", where, "two lengths > 0 [m]", str(cloth_size)
            )
        ]
    findings = []
    depth = positions[:, 2].double()
    if float(depth.min()) <= 0:
        behind = int((depth <= 0).sum())
        findings.append(
            Finding(
                Severity.ERROR,
                "Template is behind the camera",
                where,
                "z > 0 for every vertex (OpenCV: x right, y down, z forward)",
                f"{behind} of {len(depth)} vertices with z <= 0, smallest {float(depth.min()):g}",
            )
        )
    elif float(depth.median()) > FARTHEST_CLOTH:
        findings.append(_wrong_units(where, f"{float(depth.median()):.4g} m median distance from the camera"))
    return findings or _check_edges(positions.double(), grid, cloth_size, where)


def _wrong_units(where: str, got: str) -> Finding:
    return Finding(
        Severity.ERROR,
        "Template seems to be in millimetres or centimetres",
        where,
        f"positions in metres, nearer than {FARTHEST_CLOTH:g} m, of the declared cloth size",
        got,
    )


def _check_edges(
    positions: Tensor, grid: tuple[int, int], cloth_size: tuple[float, float], where: str
) -> list[Finding]:
    """Neighbours in row-major order are about one rest length apart; otherwise say which order would fit."""
    H, W = grid
    ratios = _edge_ratios(positions.reshape(H, W, 3), cloth_size)
    along = [float(r.median()) for r in ratios]
    rest = f"edges near {cloth_size[0] / (H - 1):.4g} m (axis 0) and {cloth_size[1] / (W - 1):.4g} m (axis 1)"
    if any(_is_disordered(r) for r in ratios):
        a, b = _edge_ends(int(torch.cat(ratios).argmax()), grid)
        order = "permuted"
        other = _edge_ratios(_transposed(positions, grid), cloth_size)
        if H != W and not any(_is_disordered(r) for r in other):
            order = "transposed (column-major)"
        return [
            Finding(
                Severity.ERROR,
                f"Vertex order is not the row-major grid; it seems {order}",
                where,
                rest + f" between neighbours of a {H} x {W} grid with index i * {W} + j",
                f"edges scatter by {100 * max(_scatter(r) for r in ratios):.0f} %, the longest "
                f"between vertices {a} and {b}: {float((positions[a] - positions[b]).norm()):.4g} m",
            )
        ]
    got = f"median edges of {along[0]:.3g} and {along[1]:.3g} times that"
    if not all(1 / 8 < r < 8 for r in along):
        return [_wrong_units(where, f"{got}, {rest}")]
    findings = []
    if max(abs(math.log(r)) for r in along) > math.log(1.1):
        exchanged = (along[0] * cloth_size[0] / cloth_size[1], along[1] * cloth_size[1] / cloth_size[0])
        transposed = max(abs(math.log(r)) for r in exchanged) < 0.05
        far = max(abs(math.log(r)) for r in along) > math.log(1.3)
        findings.append(
            Finding(
                Severity.ERROR if far or transposed else Severity.WARNING,
                "Vertex order seems transposed, or the two cloth sizes are exchanged"
                if transposed
                else "Template and cloth size disagree",
                where,
                rest,
                got,
            )
        )
    scatter = [100 * _scatter(r) for r in ratios]
    findings.append(
        Finding(
            Severity.INFO,
            "Edge lengths of the template",
            where,
            "no scatter if the template is at rest under uniform rest lengths",
            f"{scatter[0]:.1f} % and {scatter[1]:.1f} % scatter along the two axes, mean "
            f"{float(ratios[0].mean()):.3f} and {float(ratios[1].mean()):.3f} of the rest length",
        )
    )
    return findings


def _edge_ratios(template: Tensor, cloth_size: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Edge lengths over their uniform rest length, along axis 0 and 1, each flattened row-major."""
    H, W = template.shape[:2]
    rest = _rest_lengths((H, W), cloth_size)
    first, second = (template.diff(dim=axis).norm(dim=-1).flatten() / rest[axis] for axis in (0, 1))
    return first, second


def _rest_lengths(grid: tuple[int, int], cloth_size: tuple[float, float]) -> tuple[float, float]:
    """Uniform rest lengths [m] along axis 0 and 1."""
    return cloth_size[0] / (grid[0] - 1), cloth_size[1] / (grid[1] - 1)


def _is_disordered(ratios: Tensor) -> bool:
    """Whether edges along one axis scatter as those of no cloth do; real templates scatter by 2 to 5 %."""
    return float(ratios.max()) > 3 * float(ratios.median()) or _scatter(ratios) > 0.3


def _scatter(ratios: Tensor) -> float:
    """Standard deviation over mean."""
    return float(ratios.std(correction=0) / ratios.mean())


def _edge_ends(k: int, grid: tuple[int, int]) -> tuple[int, int]:
    """Flattened indices of the vertices of edge k in the order of _edge_ratios, both axes concatenated."""
    H, W = grid
    along_first = (H - 1) * W
    if k < along_first:
        return k, k + W
    i, j = divmod(k - along_first, W - 1)
    return i * W + j, i * W + j + 1


def _transposed(positions: Tensor, grid: tuple[int, int]) -> Tensor:
    """The (H, W, 3) grid of positions that are stored column by column."""
    return positions.reshape(grid[1], grid[0], 3).transpose(0, 1)


def check_vertex_axes(
    gravity: Tensor,
    template: Tensor,
    pinned: Sequence[int],
    cloth_size: tuple[float, float],
    where: str,
) -> list[Finding]:
    """The cloth hangs from pinned vertices, so no reversal or transposition should lift them far higher.

    A square grid read in transposed order is still a valid grid; only where it is pinned gives it away.
    A warning, since a cloth may be pinned from below or at the side.
    """
    H, W = template.shape[:2]
    strength = float(gravity.norm())
    if not pinned or len(pinned) > max(H, W) or strength == 0:
        return []
    height = -(template @ (gravity.double() / strength))  # [m] against gravity
    index = torch.zeros(H, W, dtype=torch.bool)
    index.view(-1)[list(pinned)] = True
    candidates = {"reversed along axis 1": index.flip(1), "reversed along axis 0": index.flip(0)}
    if H == W:
        candidates = {"transposed": index.T} | candidates
    now = float(height[index].mean())
    gains = {name: float(height[other].mean()) - now for name, other in candidates.items()}
    best = max(gains, key=lambda name: gains[name])
    if gains[best] < 0.4 * min(cloth_size):
        return []
    return [
        Finding(
            Severity.WARNING,
            f"Pinned vertices are at the lower side; the vertex order may be {best}",
            f"{where}: pinned_vertices",
            "pinned vertices at the upper side of the template, against gravity",
            f"{gains[best]:.3f} m lower than with the grid {best}",
        )
    ]


def check_gravity(gravity: Tensor, template: Tensor, pinned: Sequence[int], where: str) -> list[Finding]:
    """Gravity is finite, of ordinary size, and roughly the direction in which the template hangs."""
    where = f"{where}: gravity"
    got = f"{[round(g, 4) for g in gravity.tolist()]} m/s²"
    if gravity.shape != (3,) or not bool(gravity.isfinite().all()):
        return [Finding(Severity.ERROR, "Gravity is not a finite vector", where, "three finite numbers", got)]
    findings = []
    strength = float(gravity.norm())
    if abs(strength - STANDARD_GRAVITY) > 0.1:
        findings.append(
            Finding(
                Severity.WARNING,
                "Gravity has an unusual magnitude",
                where,
                f"about {STANDARD_GRAVITY} m/s²",
                f"{strength:.4g} m/s², {got}",
            )
        )
    if strength > 0 and pinned:
        flat = template.reshape(-1, 3)
        hanging = flat.mean(0) - flat[list(pinned)].mean(0)
        length = float(hanging.norm())
        if length > 0:
            cosine = float(hanging @ gravity.double()) / (length * strength)
            angle = math.degrees(math.acos(max(-1.0, min(1.0, cosine))))
            if angle > 2:
                findings.append(
                    Finding(
                        Severity.WARNING if angle > 60 else Severity.INFO,
                        "Gravity is not the direction in which the template hangs",
                        where,
                        "pinned vertices above the centre of the cloth if frame 0 is at rest",
                        f"{angle:.1f} degrees between them, gravity {got}",
                    )
                )
    return findings


def check_masks(masks: Tensor, where: str) -> list[Finding]:
    """No frame (F, h, w) without a mask."""
    empty = [k for k, mask in enumerate(masks) if not bool((mask > 0).any())]
    if not empty:
        return []
    return [
        Finding(
            Severity.ERROR,
            "Mask is empty",
            f"{where}: frame {empty[0]}",
            "the cloth's pixels above 0 in every frame",
            f"{len(empty)} empty of {len(masks)} masks: frames {', '.join(map(str, empty[:10]))}",
        )
    ]


def silhouette_overlap(template: Tensor, camera: Camera, mask: Tensor) -> tuple[float, float]:
    """How a projected template fits a mask.

    Args:
        template: (H, W, 3) [m].
        camera: camera of the image the mask belongs to.
        mask: (h, w), inside above 0.5.

    Returns:
        Intersection over union of the filled projected grid with the mask, and the fraction of vertices that
        project into the mask, widened by 2 px because outline vertices lie on its border.
    """
    from PIL import Image, ImageDraw
    from scipy import ndimage

    if float(template[..., 2].min()) <= 0:
        return 0.0, 0.0
    pixels = camera.project(template)
    image = Image.new("1", (camera.width, camera.height))
    draw = ImageDraw.Draw(image)
    p = (pixels - 0.5).clamp(-1e5, 1e5)  # PIL counts from the pixel's centre
    quads = torch.stack((p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]), 2).reshape(-1, 8)
    for quad in quads.tolist():
        draw.polygon(quad, fill=1)
    silhouette = torch.from_numpy(np.array(image))
    inside = mask > 0.5
    union = int((silhouette | inside).sum())
    iou = int((silhouette & inside).sum()) / union if union else 0.0
    wide = torch.from_numpy(ndimage.binary_dilation(inside.numpy(), iterations=2))
    h, w = mask.shape
    x, y = pixels.floor().long().reshape(-1, 2).unbind(-1)
    visible = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    hit = wide[y.clamp(0, h - 1), x.clamp(0, w - 1)] & visible
    return iou, float(hit.double().mean())


def check_projection(scene: Scene, where: str) -> list[Finding]:
    """The template, projected, covers mask 0; if not, say which common mistake would explain it."""
    camera = uncropped_camera(scene)
    mask = torch.zeros(camera.height, camera.width)
    top, left = scene.crop
    mask[top : top + scene.masks.shape[1], left : left + scene.masks.shape[2]] = scene.masks[0]
    iou, inside = silhouette_overlap(scene.template, camera, mask)
    got = f"{100 * inside:.1f} % of the vertices inside mask 0, intersection over union {iou:.3f}"
    expected = "the template, projected by K into frame 0, to cover mask 0"
    if iou > 0.85:
        return [Finding(Severity.INFO, "Template and mask 0 agree", where, expected, got)]
    flip = torch.tensor
    c, t = camera, scene.template
    candidates: dict[str, tuple[Tensor, Camera]] = {
        "cx and cy are exchanged": (t, Camera(c.fx, c.fy, c.cy, c.cx, c.height, c.width)),
        "fx and fy are exchanged": (t, Camera(c.fy, c.fx, c.cx, c.cy, c.height, c.width)),
        "the template is mirrored in x": (t * flip([-1.0, 1, 1], dtype=t.dtype), c),
        "the template is flipped in y": (t * flip([1.0, -1, 1], dtype=t.dtype), c),
        "the template's x and y are negated": (t * flip([-1.0, -1, 1], dtype=t.dtype), c),
    }
    overlaps = {name: silhouette_overlap(*candidate, mask)[0] for name, candidate in candidates.items()}
    best = max(overlaps, key=lambda name: overlaps[name])
    if overlaps[best] > iou + 0.1 and overlaps[best] > 0.6:
        return [
            Finding(
                Severity.ERROR,
                f"Template does not project onto mask 0; it seems that {best}",
                where,
                expected,
                f"{got}; with that undone {overlaps[best]:.3f}",
            )
        ]
    severity = Severity.ERROR if iou < 0.3 else Severity.WARNING
    return [Finding(severity, "Template does not project onto mask 0", where, expected, got)]


def check_texture(scene: Scene, where: str, tolerance: float = 2.0) -> list[Finding]:
    """Where the texture is frame 0, its coordinates must be the projection of the template.

    Args:
        scene: the scene.
        where: name for the findings.
        tolerance: mean disagreement [px of the texture] that is still fine.
    """
    where = f"{where}: texture"
    uv = scene.texture_coordinates
    if not bool(uv.isfinite().all()):
        n = int((~uv.isfinite()).any(-1).sum())
        got = f"{n} vertices without or with non-finite coordinates"
        return [
            Finding(Severity.ERROR, "Texture coordinates are incomplete", where, "(u, v) per vertex", got)
        ]
    findings = []
    if float(uv.min()) < -0.01 or float(uv.max()) > 1.01:
        got = f"{float(uv.min()):.3f} to {float(uv.max()):.3f}"
        findings.append(
            Finding(Severity.WARNING, "Texture coordinates leave the texture", where, "0 to 1", got)
        )
    size = (int(scene.texture.shape[0]), int(scene.texture.shape[1]))
    full, (top, left) = uncropped_camera(scene), scene.crop
    h, w = scene.frames.shape[1:3]
    if size == (full.height, full.width):
        camera, seen = full, scene.texture[top : top + h, left : left + w]
        flipped = scene.texture.flip(0)[top : top + h, left : left + w]
    elif size == (h, w):
        camera, seen, flipped = scene.camera, scene.texture, scene.texture.flip(0)
    else:
        return findings
    cloth = scene.masks[0] > 0.5
    difference = float((seen - scene.frames[0])[cloth].abs().mean())
    if difference > 0.05:
        other = float((flipped - scene.frames[0])[cloth].abs().mean())
        if other < min(0.02, difference / 4):
            got = f"mean difference {difference:.3f}, upside down {other:.3f}"
            findings.append(
                Finding(Severity.ERROR, "Texture is upside down", where, "row 0 on top, as frame 0", got)
            )
        return findings
    scale = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    pixels = camera.project(scene.template)
    error = float((uv * scale - pixels).norm(dim=-1).mean())
    upside = torch.stack((uv[..., 0], 1 - uv[..., 1]), -1)
    other = float((upside * scale - pixels).norm(dim=-1).mean())
    if other < error / 4 and error > 10 * tolerance:
        findings.append(
            Finding(
                Severity.ERROR,
                "Texture coordinates seem to have v measured upwards",
                where,
                "v down from the top row of the texture, which is frame 0",
                f"{error:.1f} px from the projected template on average, {other:.1f} px with 1 - v",
            )
        )
    elif error > tolerance:
        findings.append(
            Finding(
                Severity.WARNING,
                "Texture coordinates disagree with the projected template",
                where,
                f"at most {tolerance:g} px, since the texture is frame 0 (0 px with projected coordinates)",
                f"{error:.2f} px on average",
            )
        )
    return findings


def check_ground_truth(truth: GroundTruth, template: Tensor, n_frames: int, where: str) -> list[Finding]:
    """Ground truth is finite, has one entry per frame and starts where the template is."""
    where = f"{where}: ground truth"
    findings: list[Finding] = []
    if truth.vertices is not None:
        vertices = truth.vertices
        expected = (n_frames, *template.shape)
        if tuple(vertices.shape) != expected:
            return [
                Finding(
                    Severity.ERROR,
                    "Ground-truth vertices have the wrong shape",
                    where,
                    f"{expected} [m]",
                    f"{tuple(vertices.shape)}",
                )
            ]
        bad = [k for k, frame in enumerate(vertices) if not bool(frame.isfinite().all())]
        if bad:
            return [_not_finite(f"{where}, frame {bad[0]}")]
        distance = float((vertices[0].double() - template).norm(dim=-1).mean())
        if distance > 0.01:
            findings.append(_away_from_template(where, distance))
    if truth.point_clouds is not None:
        clouds = truth.point_clouds
        if len(clouds) != n_frames:
            return [
                Finding(
                    Severity.ERROR,
                    "Ground-truth point clouds do not match the frames",
                    where,
                    f"{n_frames} clouds",
                    f"{len(clouds)}; n_frames={len(clouds)} would load only frames that have one",
                )
            ]
        bad = [k for k, cloud in enumerate(clouds) if not bool(cloud.isfinite().all())]
        if bad:
            return [*findings, _not_finite(f"{where}, frame {bad[0]}")]
        from scipy.spatial import cKDTree

        nearest, _ = cKDTree(clouds[0].numpy()).query(template.reshape(-1, 3).numpy())
        if float(nearest.mean()) > 0.02:
            findings.append(_away_from_template(where, float(nearest.mean())))
    return findings


def _not_finite(where: str) -> Finding:
    return Finding(
        Severity.ERROR, "Ground truth has NaN or infinite values", where, "finite [m]", "NaN or inf"
    )


def _away_from_template(where: str, distance: float) -> Finding:
    return Finding(
        Severity.WARNING,
        "Ground truth of frame 0 is away from the template",
        where,
        "the template at frame 0, to about 1 cm",
        f"{100 * distance:.2f} cm on average",
    )
