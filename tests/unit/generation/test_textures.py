from __future__ import annotations

import pytest
import torch

from toile.errors import InputError
from toile.generation.textures import procedural_texture


def test_size_range_and_determinism() -> None:
    texture = procedural_texture(60, 90, 4)
    assert texture.shape == (60, 90, 3)
    assert texture.dtype == torch.float32
    assert float(texture.min()) > 0.1  # distinct from the black background
    assert float(texture.max()) <= 1
    assert torch.equal(texture, procedural_texture(60, 90, 4))
    assert not torch.equal(texture, procedural_texture(60, 90, 5))


def test_detail_at_every_scale() -> None:
    """The texture keeps varying when it is averaged over blocks of 1, 4 and 16 px."""
    texture = procedural_texture(192, 192, 0).permute(2, 0, 1)[None]
    for block in (1, 4, 16):
        blocks = torch.nn.functional.avg_pool2d(texture, block)
        assert float(blocks.diff(dim=-1).abs().mean()) > 0.02, block


def test_no_two_places_look_alike() -> None:
    """Patches match nothing elsewhere nearly as well as themselves."""
    texture = procedural_texture(128, 128, 0)
    patches = texture.unfold(0, 16, 16).unfold(1, 16, 16).reshape(64, -1)
    distance = torch.cdist(patches, patches) / patches.shape[1] ** 0.5
    distance.fill_diagonal_(1)
    assert float(distance.min()) > 0.05


def test_too_small_is_refused() -> None:
    with pytest.raises(InputError, match="too small"):
        procedural_texture(4, 100, 0)
