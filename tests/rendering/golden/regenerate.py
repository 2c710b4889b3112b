"""Draw the golden image again: ``python tests/rendering/golden/regenerate.py``. Look at it, then commit."""

import sys
from pathlib import Path

import torch
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))

from wavy_cloth import CAMERA, smooth_texture, wavy_cloth

from toile.rendering import WarpRenderer

FILE = Path(__file__).with_name("wavy_cloth.png")


def draw() -> torch.Tensor:
    """Two folded cloths side by side: colour above, silhouette below; (h, w, 3), uint8."""
    vertices, faces, coordinates = wavy_cloth(2, n=12)
    images = WarpRenderer().render(vertices, faces, coordinates, smooth_texture(32, 32), CAMERA.scaled(1.5))
    above = torch.cat(list(images.rgb), dim=1)
    below = torch.cat(list(images.silhouette[..., None].expand_as(images.rgb)), dim=1)
    return (torch.cat((above, below)).clamp(0, 1) * 255).round().to(torch.uint8)


if __name__ == "__main__":
    Image.fromarray(draw().numpy()).save(FILE, optimize=True)
