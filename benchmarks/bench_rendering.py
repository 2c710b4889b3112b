"""Speed and accuracy of the renderers.

``python benchmarks/bench_rendering.py [--device cuda] [--frames 1 8]`` prints two tables.

The scene is like a crop of a real recording: 32×32 vertices (1922 faces) that fill about 90 % of 450×450 px.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

# Sets the number of BLAS threads before NumPy is loaded.
import toile.cli  # noqa: F401

# isort: split
import pandas as pd
import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces
from toile.rendering import ReferenceRenderer, WarpRenderer
from toile.rendering.base import to_screen
from toile.rendering.edges import MeshEdges, mesh_edges
from toile.rendering.warp.antialias import Antialias
from toile.rendering.warp.interpolate import Interpolate
from toile.rendering.warp.rasterize import rasterize
from toile.rendering.warp.texture import Texture

CAMERA = Camera(970.0, 945.0, 225.0, 225.0, 450, 450)


def cloth(frames: int, n: int = 32, depth_wave: float = 0.03) -> tuple[Tensor, Tensor, Tensor]:
    """Wavy cloth (frames, n², 3) [m] of 0.55 m side at 1.25 m, with its faces and coordinates."""
    side = torch.linspace(-0.275, 0.275, n, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    phase = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None, None]
    z = 1.25 + depth_wave * torch.sin(18 * x + 9 * y + 6 * phase)
    vertices = torch.stack((x.expand_as(z), y.expand_as(z), z), dim=-1).reshape(frames, n * n, 3)
    return vertices, grid_faces(n, n), torch.stack((x, y), dim=-1).reshape(-1, 2).float() / 0.55 + 0.5


def milliseconds(call: Callable[[], object], device: torch.device, repeats: int = 10) -> float:
    """Best of ``repeats`` calls, after two to warm up [ms]."""
    best = math.inf
    for repeat in range(repeats + 2):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if repeat >= 2:
            best = min(best, time.perf_counter() - start)
    return 1e3 * best


def speed(frames: int, device: torch.device) -> list[list[object]]:
    """Milliseconds per frame, forward and backward, of each stage and of the whole."""
    renderer = WarpRenderer()
    vertices, faces, coordinates = (x.to(device) for x in cloth(frames))
    texture = torch.rand(450, 450, 3, generator=torch.Generator().manual_seed(0)).to(device)
    vertices.requires_grad_()
    coordinates.requires_grad_()
    edges = mesh_edges(faces)
    edges = MeshEdges(edges.vertices.int(), edges.opposite.int())
    faces32 = faces.int()
    rows: list[list[object]] = []

    def time_stage(name: str, forward: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        outputs = forward()
        wanted = [x for x in outputs if x.requires_grad]
        ones = [torch.ones_like(x) for x in wanted]

        def backward() -> None:
            torch.autograd.backward(wanted, ones, retain_graph=True)

        back = milliseconds(backward, device) / frames if wanted else 0.0
        rows.append([name, milliseconds(forward, device) / frames, back])
        return tuple(x.detach().requires_grad_(x.requires_grad) for x in outputs)

    (screen,) = time_stage("project", lambda: (to_screen(vertices, CAMERA).float(),))
    (keys,) = time_stage(
        "rasterize", lambda: (rasterize(screen.detach(), faces32, CAMERA.height, CAMERA.width),)
    )
    uv, depth = time_stage("interpolate", lambda: Interpolate.apply(screen, coordinates, faces32, keys))
    rgb, silhouette = time_stage("texture", lambda: Texture.apply(uv, texture, depth.detach()))
    time_stage("antialias", lambda: Antialias.apply(screen, rgb, silhouette, faces32, edges, keys))

    def whole() -> tuple[Tensor, ...]:
        images = renderer.render(vertices, faces, coordinates, texture, CAMERA)
        return images.rgb, images.silhouette

    time_stage("whole renderer", whole)
    return [[*row, float(row[1]) + float(row[2])] for row in rows]  # type: ignore[arg-type]


def accuracy() -> list[list[object]]:
    """Coverage and colour against an image of 16×16 samples per pixel, by supersampling factor."""
    camera = CAMERA.scaled(0.25)
    vertices, faces, coordinates = cloth(1, depth_wave=0.12)
    texture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    truth = WarpRenderer(16).render(vertices, faces, coordinates, texture, camera)
    rows: list[list[object]] = []
    for name, make in (("warp", WarpRenderer), ("reference", ReferenceRenderer)):
        for factor in (1, 2, 4) if name == "warp" else (1,):
            images = make(factor).render(vertices, faces, coordinates, texture, camera)
            border = (truth.silhouette > 0) & (truth.silhouette < 1)
            coverage = (images.silhouette - truth.silhouette)[border].abs()
            area = (images.silhouette.sum() / truth.silhouette.sum() - 1).item()
            colour = (images.rgb - truth.rgb).abs().mean().item()
            rows.append([name, factor, coverage.mean().item(), coverage.max().item(), area, colour])
    return rows


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 8])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    device = torch.device(arguments.device)
    for frames in arguments.frames:
        print(f"\nms per frame, {frames} frame(s) a call, on {device}, one thread")
        headers = ["stage", "forward", "backward", "both"]
        print(pd.DataFrame(speed(frames, device), columns=headers).to_markdown(index=False, floatfmt=".2f"))
    print("\nerrors against 16 × 16 samples per pixel, 112 × 112 px")
    headers = ["renderer", "supersampling", "coverage, mean at the border", "worst", "area", "colour, mean"]
    print(pd.DataFrame(accuracy(), columns=headers).to_markdown(index=False, floatfmt=".5f"))


if __name__ == "__main__":
    main()
