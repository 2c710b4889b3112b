"""What every method finds, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toile.errors import InputError
from toile.preparation.segmentation.cleaning import Cleaning
from toile.preparation.segmentation.dark_background import DarkBackground
from toile.preparation.segmentation.given import Given
from toile.preparation.segmentation.grabcut import GrabCut

BOX = [20, 10, 98, 82]


def overlaps(method, sheet) -> list[float]:
    """Intersection over union with the true mask, per frame."""
    found = [segmented.mask for segmented in method.masks(sheet.frames)]
    return [float((f & t).sum() / (f | t).sum()) for f, t in zip(found, sheet.masks, strict=True)]


def test_dark_background_finds_the_cloth(before_black) -> None:
    assert min(overlaps(DarkBackground(Cleaning()), before_black)) > 0.95


def test_another_uniform_background(before_black) -> None:
    green = [
        np.where(m[..., None], f, (0, 200, 0)).astype(np.uint8)
        for f, m in zip(*before_black[:2], strict=True)
    ]
    method = DarkBackground(Cleaning(), background=(0, 200, 0))
    assert min(overlaps(method, before_black._replace(frames=green))) > 0.99


def test_dark_spots_of_the_cloth_belong_to_it(before_black) -> None:
    frame = before_black.frames[0].copy()
    frame[40:48, 50:60] = 0
    spotted = before_black._replace(frames=[frame], masks=before_black.masks[:1])
    assert min(overlaps(DarkBackground(Cleaning()), spotted)) > 0.95
    assert not next(DarkBackground(Cleaning(largest_hole=0)).masks([frame])).mask[44, 55]


@pytest.mark.parametrize("start", ["box", "polygon"])
def test_grabcut_follows_the_moving_cloth(before_wall, start) -> None:
    # In frame 5 a sheet that stayed where it was would overlap by 0.6 only.
    marked = (
        {"box": BOX}
        if start == "box"
        else {"polygon": before_wall.corners + np.array([[-2, 1], [2, -1], [1, 2], [-1, 1]])}
    )
    assert min(overlaps(GrabCut(Cleaning(), **marked), before_wall)) > 0.95


def test_grabcut_without_a_margin_still_cuts(before_wall) -> None:
    """With no background in view it took the whole box for the cloth."""
    assert min(overlaps(GrabCut(Cleaning(), box=BOX, margin=0.0), before_wall)) > 0.8


def test_grabcut_finds_the_same_twice(before_wall) -> None:
    one, two = (
        [s.mask for s in GrabCut(Cleaning(), box=BOX).masks(before_wall.frames[:2])] for _ in range(2)
    )
    assert np.array_equal(one, two)


def test_grabcut_does_not_depend_on_resolution(before_wall) -> None:
    large = [
        np.asarray(Image.fromarray(f).resize((256, 192), Image.Resampling.BICUBIC))
        for f in before_wall.frames
    ]
    masks = [np.asarray(Image.fromarray(m).resize((256, 192))) for m in before_wall.masks]
    doubled = before_wall._replace(frames=large, masks=masks)
    assert min(overlaps(GrabCut(Cleaning(), polygon=2 * before_wall.corners), doubled)) > 0.95


@pytest.mark.parametrize(
    ("marked", "message"),
    [
        ({}, "not marked"),
        ({"box": BOX, "polygon": [[1, 1], [9, 1], [9, 9]]}, "marked twice"),
        ({"box": [1, 2, 3]}, "no box"),
        ({"box": [50, 10, 20, 80]}, "no box"),
        ({"box": [20, 10, 200, 80]}, "outside"),
        ({"box": [-1, 10, 90, 80]}, "outside"),
        ({"box": [0, 0, 128, 96]}, "no background"),
        ({"polygon": [[1, 1], [9, 9]]}, "no polygon"),
        ({"polygon": [[1, 1], [300, 1], [9, 90]]}, "outside"),
    ],
)
def test_grabcut_refuses_what_marks_no_cloth(before_wall, marked, message) -> None:
    with pytest.raises(InputError, match=message):
        list(GrabCut(Cleaning(), **marked).masks(before_wall.frames))


def test_a_cloth_that_disappears_is_named(before_black) -> None:
    frames = [*before_black.frames[:2], np.zeros_like(before_black.frames[0])]
    with pytest.raises(InputError, match="empty") as caught:
        list(DarkBackground(Cleaning()).masks(frames))
    assert caught.value.where == "frame 2"


@pytest.mark.parametrize("bad", [{"threshold": 256}, {"background": (0, 0)}, {"background": (0, 0, 256)}])
def test_dark_background_refuses_no_levels(bad) -> None:
    with pytest.raises(InputError):
        DarkBackground(Cleaning(), **bad)


def write_masks(folder: Path, masks) -> Path:
    folder.mkdir()
    for k, mask in enumerate(masks):
        # Not padded with zeros: mask 10 follows mask 9 all the same.
        Image.fromarray(np.where(mask, 200, 90).astype(np.uint8)).save(folder / f"m{k + 8}.png")
    return folder


def test_given_masks_are_taken_in_the_order_of_their_numbers(tmp_path: Path, before_wall) -> None:
    method = Given(Cleaning(), write_masks(tmp_path / "m", before_wall.masks))
    assert overlaps(method, before_wall) == [1.0] * len(before_wall.masks)


def test_given_masks_must_fit_the_frames(tmp_path: Path, before_wall) -> None:
    folder = write_masks(tmp_path / "m", before_wall.masks[:3])
    with pytest.raises(InputError, match="Number of masks"):
        list(Given(Cleaning(), folder).masks(before_wall.frames))
    with pytest.raises(InputError, match="Number of masks"):
        list(Given(Cleaning(), folder).masks(before_wall.frames[:2]))
    with pytest.raises(InputError, match="differ in size"):
        list(Given(Cleaning(), folder).masks([f[:50] for f in before_wall.frames[:3]]))
    with pytest.raises(InputError, match="missing"):
        Given(Cleaning(), tmp_path / "nothing")
