"""A template from a point cloud of the scene, seen by the camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from toile.errors import InputError
from toile.geometry.io import read_point_cloud
from toile.geometry.mesh import grid_faces
from toile.geometry.point_cloud import largest_cluster, require_enough, seen_surface, smooth_depth
from toile.geometry.quadrilateral import smooth_side
from toile.geometry.surface import Floats, border_of_disc, nearest_points
from toile.limits import Fraction, NonNegative, TwoOrMore
from toile.preparation.template_making.axes import Axes
from toile.preparation.template_making.gridding import grid_on_disc
from toile.preparation.template_making.still import Still
from toile.preparation.template_making.surface import Layout, SurfaceGrid, inside_mask, project, require_seen
from toile.scenes.masks import outline_of

_LATTICE = 4000  # points of the surface that is laid flat, four per vertex of a 32 x 32 grid
_JUMP = 5.0  # times the median edge; a longer one bridges a jump in depth


@dataclass(frozen=True)
class PointsSurface:
    """A point cloud of the scene, of which the mask tells the cloth.

    The depth of the cloth is a smooth function of the pixel, fitted locally to the points inside the mask
    over a radius of ``smoothing`` grid cells; the outline is the mask's.

    Attributes:
        file: .npy, .pt, .ply or .xyz, (N, 3).
        axes: of the file.
        smoothing: radius of the local fit, in grid cells.
        minimum_cover: fraction of the mask that must have points nearby.
        side_degree: degree of the polynomial that straightens each side of the mask's outline.
    """

    file: str | Path
    axes: Axes
    smoothing: NonNegative
    minimum_cover: Fraction
    side_degree: TwoOrMore

    def lay_grid(self, still: Still, layout: Layout) -> SurfaceGrid:
        """Lay a grid on the surface that the points inside the mask show; see Surface."""
        where = str(self.file)
        everything = self.axes.to_camera(read_point_cloud(self.file).numpy().astype(np.float64))
        everything = everything[np.isfinite(everything).all(1)]
        require_enough(len(everything), where, "in the file")
        inside = everything[inside_mask(everything, still)]
        if len(inside) < 0.01 * len(everything):
            require_seen(everything, still, 0.01, where)
        require_enough(len(inside), where, "inside the mask")
        points = inside[largest_cluster(inside)]
        require_enough(len(points), where, "after cleaning")

        mask = still.mask.numpy() > 0.5
        step = max(float(np.sqrt(mask.sum() / _LATTICE)), 1.5)
        radius = self.smoothing * float(np.sqrt(mask.sum() / np.prod(layout.grid)))
        pixels, region = _lattice(mask, step)
        seen = project(still.camera, points)
        depth, distance = smooth_depth(seen, points[:, 2], pixels, radius)
        near = distance <= 2 * radius
        _require_cover(mask, pixels, near, self.minimum_cover, where)
        pixels, depth = pixels[near], depth[near]
        rays = np.column_stack((pixels, np.ones(len(pixels)))) @ np.linalg.inv(still.camera.K.numpy()).T
        positions = depth[:, None] * rays
        spacing = step * float(np.median(depth)) / min(still.camera.fx, still.camera.fy)
        mesh = seen_surface(pixels, positions, region, _JUMP * spacing, where)
        border = border_of_disc(mesh, where)
        outline, _ = nearest_points(outline_of(still.mask), project(still.camera, mesh.vertices), mesh.faces)
        fit = partial(smooth_side, degree=self.side_degree)
        gridding = grid_on_disc(mesh, border, outline, still, layout, fit, where)
        vertices = gridding.positions.reshape(-1, 3)
        _, to_template = nearest_points(points, vertices, grid_faces(*layout.grid).numpy())
        _, to_surface = nearest_points(vertices, mesh.vertices, mesh.faces)
        mean, most = gridding.stretch
        return SurfaceGrid(
            gridding.positions,
            to_template,
            to_surface,
            {
                "input": f"{len(everything)} points, {len(inside)} inside the mask, "
                f"{len(inside) - len(points)} outliers",
                "stretch by flattening": f"mean {100 * mean:.2f} %, max {100 * most:.2f} %",
            },
        )


def _lattice(mask: np.ndarray, step: float) -> tuple[Floats, np.ndarray]:
    """A lattice of pixels (N, 2) over a mask (h, w), two steps wider than it, and that region (h, w)."""
    from scipy import ndimage

    h, w = mask.shape
    margin = int(np.ceil(3 * step))
    wide = ndimage.distance_transform_edt(np.pad(~mask, margin, constant_values=True)) <= 2 * step
    region = wide[margin:-margin, margin:-margin]
    y, x = np.mgrid[0.5:h:step, 0.5:w:step]
    pixels = np.column_stack((x.ravel(), y.ravel()))
    keep = region[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    return pixels[keep], region


def _require_cover(mask: np.ndarray, pixels: Floats, near: np.ndarray, least: float, where: str) -> None:
    inside = mask[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    cover = float(near[inside].mean())
    if cover < least:
        raise InputError(
            "Point cloud does not cover the mask",
            where=where,
            expected=f"points near at least {100 * least:.0f} % of mask 0",
            got=f"{100 * cover:.1f} %",
        )
