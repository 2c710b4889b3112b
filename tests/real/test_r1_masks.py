"""Masks of the real scene R1, whose frames show the cloth on black, against those it comes with.

The data is found in ``$TOILE_DATA`` (default ``./data``): phi_sft/.
"""

from __future__ import annotations

import pytest
import torch

from toile.preparation.segmentation.cleaning import Cleaning
from toile.preparation.segmentation.dark_background import DarkBackground
from toile.preparation.segmentation.grabcut import GrabCut
from toile.preparation.video import open_clip
from toile.scenes.images import read_mask
from toile.scenes.masks import drop_small_components
from toile.scenes.registry import data_folder

EVERY, N_FRAMES = 20, 3


@pytest.mark.parametrize(
    ("method", "least"),
    [
        (DarkBackground(Cleaning()), 0.97),
        # Around the cloth of frame 0, read from a picture with rulers.
        (GrabCut(Cleaning(), box=[400, 420, 880, 890]), 0.97),
    ],
    ids=["dark_background", "grabcut"],
)
def test_masks_of_the_cloth(method, least) -> None:
    folder = data_folder() / "phi_sft" / "R1"
    if not (folder / "rgbs").is_dir():
        pytest.skip(f"scene R1 is not in {data_folder()} (set TOILE_DATA)")
    # GrabCut follows from frame to frame, so it gets neighbours.
    every = EVERY if isinstance(method, DarkBackground) else 1
    clip = open_clip(folder / "rgbs", every=every, n_frames=N_FRAMES, fps=50)
    for number, (_, found) in enumerate(method.masks(clip.frames())):
        true = read_mask(folder / "masks" / f"mask_{every * number:03d}.png")
        # The two feet below the cloth are in the published masks too.
        cloth = drop_small_components(true, 0.1)[0] > 0
        mask = torch.from_numpy(found)
        assert float((mask & cloth).sum() / (mask | cloth).sum()) > least, number
    assert number == N_FRAMES - 1
