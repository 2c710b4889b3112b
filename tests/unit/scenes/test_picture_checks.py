"""Duplicates and a moving camera, on pictures that have the fault and on pictures that have not."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from toile.scenes.picture_checks import PictureChecks

N_FRAMES, SIZE = 14, (120, 160)
Frame = np.ndarray


def wall(seed: int = 0) -> Frame:
    """A background with shapes, larger than a picture."""
    noise = np.random.default_rng(seed).uniform(0, 1, (180, 220, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return 120 + 700 * (smooth - 0.5)


def clip(view: Callable[[int], np.ndarray] | None, *, noise: float = 2.0, sway: float = 9.0) -> list[Frame]:
    """A patterned square that swings before what a camera sees; black where ``view`` is None."""
    random = np.random.default_rng(1)
    cloth = wall(5)[:50, :50]
    frames = []
    for k in range(N_FRAMES):
        frame = np.zeros((*SIZE, 3)) if view is None else cv2.warpAffine(wall(), view(k), SIZE[::-1])
        left = 60 + round(sway * np.sin(0.6 * k))
        frame[40:90, left : left + 50] = cloth
        if view is not None:
            frame += noise * random.standard_normal(frame.shape)
        frames.append(np.clip(frame, 0, 255).astype(np.uint8))
    return frames


def mask(k: int, sway: float = 9.0) -> np.ndarray:
    inside = np.zeros(SIZE, dtype=bool)
    left = 60 + round(sway * np.sin(0.6 * k))
    inside[40:90, left : left + 50] = True
    return inside


def found(frames: list[Frame], n_frames: int | None = N_FRAMES) -> dict[str, str]:
    checks = PictureChecks(n_frames)
    for k, frame in enumerate(frames):
        checks.add(frame, mask(k))
    return {f.what: f"{f.where} {f.got}" for f in checks.findings("clip")}


def seen(x: float = 0.0, y: float = 0.0, zoom: float = 1.0, turn: float = 0.0) -> np.ndarray:
    """The middle of the wall, moved [px], magnified and turned [degrees] about the picture's centre."""
    matrix = cv2.getRotationMatrix2D((110.0, 90.0), turn, zoom)
    matrix[:, 2] += (x - 30, y - 30)
    return matrix


STILL: Callable[[int], np.ndarray] = lambda k: seen()  # noqa: E731


@pytest.mark.parametrize("view", [STILL, None], ids=["wall", "black"])
def test_a_tripod_is_passed_over_in_silence(view) -> None:
    assert found(clip(view)) == {}
    assert found(clip(view), None) == {}


def test_noise_without_shapes_says_nothing() -> None:
    random = np.random.default_rng(0)
    assert found([random.integers(0, 256, (*SIZE, 3), dtype=np.uint8) for _ in range(N_FRAMES)]) == {}


@pytest.mark.parametrize(
    "view",
    [
        lambda k: seen(x=0.4 * k),
        lambda k: seen(x=3 * np.sin(k), y=2 * np.cos(1.3 * k)),
        lambda k: seen(zoom=1 + 0.006 * k),
        lambda k: seen(turn=0.3 * k),
    ],
    ids=["pan", "hand", "zoom", "turn"],
)
def test_a_moving_camera(view) -> None:
    assert list(found(clip(view))) == ["The camera seems to move"]


def test_how_far_it_moved() -> None:
    said = found(clip(lambda k: seen(x=0.4 * k)))["The camera seems to move"]
    assert "frame 13" in said
    assert "5.2 px" in said


@pytest.mark.parametrize("view", [STILL, None], ids=["wall", "black"])
def test_duplicates(view) -> None:
    frames = clip(view)
    random = np.random.default_rng(3)
    # One exact copy, and one that was encoded again.
    frames[5] = frames[4]
    frames[9] = np.clip(frames[8] + (random.uniform(size=frames[8].shape) < 0.03), 0, 255).astype(np.uint8)
    said = found(frames)["Frames are duplicates of the frame before"]
    assert "frames 5, 9" in said
    assert "2 of 14" in said


def test_pictures_that_are_shown_three_times() -> None:
    frames = [frame for frame in clip(STILL)[:5] for _ in range(3)][:N_FRAMES]
    assert "frames 4, 5, 7, 8, 10, 11" in found(frames)["Frames are duplicates of the frame before"]


def test_a_cloth_that_starts_from_rest_or_comes_to_it_is_no_duplicate() -> None:
    """Without noise: nothing changes at all before it starts, and less and less before it stops."""
    still, moving = clip(None, sway=0.0), clip(None)
    assert "Frames are duplicates of the frame before" not in found(still[:4] + moving[:10])
    assert "Frames are duplicates of the frame before" not in found(moving[:10][::-1] + still[:4])
