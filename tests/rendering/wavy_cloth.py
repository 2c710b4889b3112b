"""Small random folded cloths with a smooth texture, for the tests beside this file."""

import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces

CAMERA = Camera(60.0, 55.0, 31.3, 24.7, 48, 64)


def wavy_cloth(seed: int, n: int = 8, batch: int = 2, amplitude: float = 0.14, distance: float = 1.2):
    """n×n vertices (batch, n², 3) [m], bent by one random wave per axis, with faces and coordinates."""
    generator = torch.Generator().manual_seed(seed)
    side = torch.linspace(-0.42, 0.42, n, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    flat = torch.stack((x, y, torch.full_like(x, distance)), dim=-1)
    k = 8 * torch.rand(batch, 1, 1, 3, 3, generator=generator, dtype=torch.float64)
    wave = torch.sin(k[..., 0] * x[..., None] + k[..., 1] * y[..., None] + k[..., 2])
    vertices = flat + amplitude * wave * torch.tensor([1.0, 1.0, 2.0])
    coordinates = torch.stack((x, y), dim=-1).reshape(-1, 2) / 0.84 + 0.5
    return vertices.reshape(batch, n * n, 3), grid_faces(n, n), coordinates


def smooth_texture(height: int, width: int) -> Tensor:
    """Slow waves of colour (height, width, 3) in [0, 1]."""
    y = torch.linspace(0, 1, height, dtype=torch.float64)[:, None]
    x = torch.linspace(0, 1, width, dtype=torch.float64)[None, :]
    waves = torch.stack((7 * y + 3 * x, 8 * x - 2 * y, 5 * y + 9 * x + 1), dim=-1)
    return 0.5 + 0.5 * torch.sin(waves)
