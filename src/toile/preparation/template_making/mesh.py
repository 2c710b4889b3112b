"""A template from a triangle mesh of the cloth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from toile.geometry.io import read_mesh
from toile.geometry.mesh import grid_faces
from toile.geometry.quadrilateral import exact_side
from toile.geometry.surface import (
    TriangleMesh,
    at_vertices,
    border_of_disc,
    nearest_points,
    triangle_mesh,
)
from toile.limits import Fraction
from toile.preparation.template_making.axes import Axes
from toile.preparation.template_making.gridding import grid_on_disc
from toile.preparation.template_making.still import Still
from toile.preparation.template_making.surface import Layout, SurfaceGrid, require_seen


@dataclass(frozen=True)
class MeshSurface:
    """A mesh of the whole cloth and nothing else: one piece, one border, no holes.

    Attributes:
        file: OBJ, PLY, STL, OFF or GLB.
        axes: of the file.
        minimum_inside: fraction of its vertices that must project into the mask.
    """

    file: str | Path
    axes: Axes
    minimum_inside: Fraction

    def lay_grid(self, still: Still, layout: Layout) -> SurfaceGrid:
        """Lay a grid on the mesh, its border on the mesh's border; see Surface."""
        where = str(self.file)
        read = triangle_mesh(read_mesh(self.file), where)
        mesh = TriangleMesh(self.axes.to_camera(read.vertices), read.faces)
        border = border_of_disc(mesh, where)
        require_seen(mesh.vertices, still, self.minimum_inside, where)
        gridding = grid_on_disc(mesh, border, at_vertices(mesh, border), still, layout, exact_side, where)
        vertices = gridding.positions.reshape(-1, 3)
        _, to_template = nearest_points(mesh.vertices, vertices, grid_faces(*layout.grid).numpy())
        _, to_surface = nearest_points(vertices, mesh.vertices, mesh.faces)
        mean, most = gridding.stretch
        return SurfaceGrid(
            gridding.positions,
            to_template,
            to_surface,
            {
                "input": f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles",
                "stretch by flattening": f"mean {100 * mean:.2f} %, max {100 * most:.2f} %",
            },
        )
