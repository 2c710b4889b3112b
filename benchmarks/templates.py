"""How well `toile template` finds the grid again, on the nine published templates.

    python benchmarks/templates.py

Every template's surface is given away three times: as an irregular triangle mesh (random points, Delaunay in
parameter space, so nothing of the grid survives), as 20,000 points with 1 mm of Gaussian noise beside a wall
and strays, and not at all but for the published size (a flat sheet). The mask is the projection of the
template, since only R1 comes with masks. Writes docs/results/templates.csv and templates.md.
"""

from __future__ import annotations

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from results import ROOT
from scipy.spatial import Delaunay

from toile.cli.machine import machine
from toile.geometry.io import write_mesh, write_point_cloud
from toile.geometry.mesh import sample_surface
from toile.geometry.surface import nearest_points
from toile.preparation.template_making.axes import Axes
from toile.preparation.template_making.mesh import MeshSurface
from toile.preparation.template_making.points import PointsSurface
from toile.preparation.template_making.sheet import SheetSurface
from toile.preparation.template_making.still import Still
from toile.preparation.template_making.surface import Layout, Surface
from toile.rendering.warp.renderer import WarpRenderer
from toile.scenes.registry import load_template
from toile.scenes.template import Template

NAMES = tuple(f"R{k}" for k in range(1, 10))
N_VERTICES, N_BORDER = 3000, 124  # of the irregular mesh: inside, and along each side
N_POINTS, NOISE = 20_000, 0.001  # of the cloud, noise in m
CORNERS = ([0, 0, -1, -1], [0, -1, 0, -1])
OPENCV = Axes(rotation=((1.0, 0, 0), (0, 1, 0), (0, 0, 1)), translation=(0.0, 0, 0), scale=1.0)


def still_of(template: Template) -> Still:
    """A first frame whose mask is the projection of the template."""
    camera = template.camera
    images = WarpRenderer().render(
        template.positions.reshape(1, -1, 3).float(),
        template.faces,
        template.texture_coordinates.reshape(-1, 2),
        template.texture,
        camera,
    )
    return Still(Path(), images.rgb[0], (images.silhouette[0] > 0.5).float(), camera, 50.0, 1)


def irregular_mesh(template: Template, folder: Path) -> Surface:
    """The template's surface through random points."""
    random = np.random.default_rng(0)
    s = np.linspace(0, 1, N_BORDER, endpoint=False)
    zero, one = np.zeros_like(s), np.ones_like(s)
    border = [(s, zero), (one, s), (1 - s, one), (zero, 1 - s)]
    q = np.concatenate([random.uniform(0.003, 0.997, (N_VERTICES, 2)), *map(np.column_stack, border)])
    file = folder / "mesh.ply"
    write_mesh(file, torch.from_numpy(on_grid(template.positions.numpy(), q)), Delaunay(q).simplices)
    return MeshSurface(file, OPENCV, minimum_inside=0.8)


def on_grid(positions: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Points (n, 3) on the triangles of a grid (H, W, 3) at parameters (n, 2) in [0, 1]."""
    cells = np.array(positions.shape[:2]) - 1
    i, j = np.minimum((q * cells).astype(int), cells - 1).T
    a, b = (q * cells - np.column_stack((i, j))).T[:, :, None]
    low, high = positions[i, j], positions[i + 1, j + 1]
    down, right = positions[i, j + 1], positions[i + 1, j]
    first = (1 - b) * low + (b - a) * down + a * high
    second = (1 - a) * low + (a - b) * right + b * high
    return np.where(a <= b, first, second)


def noisy_points(template: Template, folder: Path) -> Surface:
    """Points of the surface with noise, a wall half a metre behind and 20 strays in front."""
    generator = torch.Generator().manual_seed(0)
    p = template.positions.reshape(-1, 3)
    cloth = sample_surface(p, template.faces, N_POINTS, generator)
    cloth = cloth + NOISE * torch.randn(cloth.shape, generator=generator, dtype=cloth.dtype)
    wall = 3 * (torch.rand(N_POINTS // 4, 3, generator=generator, dtype=cloth.dtype) - 0.5) + p.mean(0)
    wall[:, 2] = p[:, 2].max() + 0.5
    strays = cloth[:20] - torch.tensor([0.0, 0.0, 0.2])
    file = folder / "cloud.npy"
    write_point_cloud(file, torch.cat((cloth, wall, strays)))
    return PointsSurface(file, OPENCV, smoothing=1.0, minimum_cover=0.95, side_degree=8)


def flat_sheet(template: Template, folder: Path) -> Surface:
    """Nothing but the size."""
    return SheetSurface(maximum_error=0.1)


WAYS: dict[str, tuple[Callable[[Template, Path], Surface], bool]] = {
    "mesh": (irregular_mesh, False),
    "points, 1 mm noise": (noisy_points, False),
    "flat sheet": (flat_sheet, True),
}
"""How a surface is given, and whether its size is."""


def row(name: str, way: str) -> dict[str, Any]:
    """One template recovered in one way."""
    template = load_template(name)
    make, sized = WAYS[way]
    with tempfile.TemporaryDirectory() as folder:
        surface, still = make(template, Path(folder)), still_of(template)
        layout = Layout(template.grid, template.cloth_size if sized else None, None)
        found = surface.lay_grid(still, layout).positions
    true = template.positions.numpy()
    if np.linalg.norm(true[0, 0] - found[0, 0]) > np.linalg.norm(true[-1, 0] - found[0, 0]):
        true = true[::-1]  # R2 to R9 are stored from the upper right to the left
    vertex = 1e3 * np.linalg.norm(found - true, axis=-1)
    faces = template.faces.numpy()
    # The mesh of the reversed grid is the same surface.
    _, to_original = nearest_points(found.reshape(-1, 3), true.reshape(-1, 3), faces)
    _, to_found = nearest_points(true.reshape(-1, 3), found.reshape(-1, 3), faces)
    return {
        "scene": name,
        "from": way,
        "to the original surface, mean [mm]": 1e3 * to_original.mean(),
        "max [mm]": 1e3 * to_original.max(),
        "and back, mean [mm]": 1e3 * to_found.mean(),
        "back, max [mm]": 1e3 * to_found.max(),
        "corners, max [mm]": vertex[CORNERS].max(),
        "vertices, mean [mm]": vertex.mean(),
        "vertices, max [mm]": vertex.max(),
        "edge spread [%]": spread(found),
        "of the original [%]": spread(true),
    }


def spread(grid: np.ndarray) -> float:
    """Standard deviation over mean of the edge lengths, mean of the two axes [%]."""
    lengths = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1) for axis in (0, 1)]
    return 100 * float(np.mean([values.std() / values.mean() for values in lengths]))


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=NAMES, choices=NAMES)
    options = parser.parse_args()
    table = pd.DataFrame([row(name, way) for way in WAYS for name in options.only])
    means = table.drop(columns="scene").groupby("from", sort=False).mean().reset_index()
    docs = ROOT / "docs" / "results"
    table.to_csv(docs / "templates.csv", index=False, float_format="%.4g")
    m = machine()
    where = f"{m['processor']}, {m['processors']} cores, {m['threads']} thread"
    head = "\n".join(
        (
            "# Templates found again (`make templates`)",
            "",
            f"`python benchmarks/templates.py`, on {where}.",
            "",
            " ".join((__doc__ or "").split("\n\n")[2].split("Writes")[0].split()),
            "",
            "The surface is what can be found again. Where on it the vertices lie cannot, since the "
            "originals' edges are not of equal length (last column): that is most of the vertex errors of "
            "mesh and points, which lie along the surface. Edge spread: standard deviation over mean.",
            "",
        )
    )
    parts = (
        head,
        means.to_markdown(index=False, floatfmt=".3g"),
        "",
        table.to_markdown(index=False, floatfmt=".3g"),
    )
    text = "\n".join(parts) + "\n"
    (docs / "templates.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
