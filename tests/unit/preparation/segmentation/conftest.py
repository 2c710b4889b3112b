"""A textured sheet that moves in front of a textured wall; its true masks are known."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import pytest

HEIGHT, WIDTH, N_FRAMES = 96, 128, 6
CORNERS = np.array([[30.0, 16.0], [90.0, 20.0], [84.0, 76.0], [26.0, 70.0]])
STEP = np.array([3.0, 1.0])  # px per frame


class MovingSheet(NamedTuple):
    frames: list[npt.NDArray[np.uint8]]
    masks: list[npt.NDArray[np.bool_]]
    corners: npt.NDArray[np.float64]  # of frame 0, (4, 2) of (x, y) [px]


def noise(rng: np.random.Generator, h: int, w: int, grain: float) -> npt.NDArray[np.float64]:
    picture = cv2.GaussianBlur(rng.normal(size=(h, w, 3)), (0, 0), grain)
    return picture / picture.std()


def moving_sheet(wall: bool) -> MovingSheet:
    """A reddish sheet before a bluish wall, or before black."""
    rng = np.random.default_rng(0)
    background = (70, 90, 120) + 20 * noise(rng, HEIGHT, WIDTH, 3.0) if wall else np.zeros((HEIGHT, WIDTH, 3))
    side = 64
    sheet = ((170, 110, 80) + 25 * noise(rng, side, side, 2.0)).clip(40, 255)
    corners_of_sheet = np.array([[0, 0], [side, 0], [side, side], [0, side]], dtype=np.float32)
    frames, masks = [], []
    for t in range(N_FRAMES):
        corners = (CORNERS + t * STEP).astype(np.float32)
        turn = cv2.getPerspectiveTransform(corners_of_sheet, corners)
        inside = cv2.warpPerspective(np.ones((side, side)), turn, (WIDTH, HEIGHT))[..., None]
        picture = cv2.warpPerspective(sheet, turn, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
        frames.append((inside * picture + (1 - inside) * background).round().clip(0, 255).astype(np.uint8))
        masks.append(inside[..., 0] > 0.5)
    return MovingSheet(frames, masks, CORNERS)


@pytest.fixture(scope="session")
def before_wall() -> MovingSheet:
    return moving_sheet(wall=True)


@pytest.fixture(scope="session")
def before_black() -> MovingSheet:
    return moving_sheet(wall=False)
