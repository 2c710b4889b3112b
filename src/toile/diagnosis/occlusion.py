"""What passes before the cloth and is taken for it: there the cloth's print is gone.

A mask that follows an outline does not know of a hand or a pole in front. No motion, no light and no camera
takes a print away where the cloth is seen: it moves by what tracking errs, becomes brighter or darker, and is
smeared. So every patch of the cloth is compared with that of the first frame, a little aside as well and
blurred as well, brightness left free: how much of that patch's print is there at least? What is in front must
be plain: something with a print of its own is like that of the cloth somewhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import binary_opening, median_filter, uniform_filter

from toile.diagnosis.masked_blur import blurred_at
from toile.limits import Count, CountOrZero, Fraction, Positive, TwoOrMore, Unit
from toile.reconstruction.image_terms.texture_points import grid_points, visible
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import Scene

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_INSIDE = 0.9
"""Share of the cloth within the blur around a point, from which on its colour counts."""

_SEEN = 0.5
"""Share of a patch that must be seen, now and in the first frame, for the patch to count."""

_WHOLE = 3
"""Points across the smallest thing that counts: single points are noise."""


@dataclass(frozen=True)
class OcclusionSettings:
    """How the print of a cloth is looked for.

    Attributes:
        points: along each side of the cloth, at which colours are read.
        patch: points across a patch.
        aside: points by which a patch may be beside its place.
        step: between the places that are tried.
        blurs: σ of the blurs of the first frame [px]; the first is that of every frame.
        contrast: root mean square of a patch's print in the first frame, of white, from which on it counts.
        lost: share of a patch's print below which it is gone.
        lasting: frames at 25 frames a second over half of which a share must be hidden.
    """

    points: TwoOrMore = 64
    patch: Count = 7
    aside: CountOrZero = 4
    step: Count = 2
    blurs: Annotated[tuple[Positive, ...], Field(min_length=1), Unit("px")] = (1.0, 3.0)
    contrast: Positive = 0.04
    lost: Fraction = 0.1
    lasting: Annotated[Positive, Unit("frames")] = 2.5


DEFAULT = OcclusionSettings()


def hidden_shares(
    reconstruction: Reconstruction, positions: Array, settings: OcclusionSettings = DEFAULT
) -> Array:
    """Share of what is seen of the cloth's print that is gone in every frame (F,).

    What has no print there is no part of it. Frames in which nothing of it is seen have 0.

    Args:
        reconstruction: its scene and renderer are used.
        positions: tracked, of the first frames (F, N, 3) [m].
        settings: see OcclusionSettings.
    """
    kept, known = print_kept(reconstruction, positions, settings)
    gone = known & (kept < settings.lost)
    whole = np.ones((_WHOLE, _WHOLE), bool)
    hidden = np.array([binary_opening(frame, whole).sum() for frame in gone])
    return np.asarray(hidden / np.maximum(known.sum((1, 2)), 1), np.float64)


def lasting(shares: Array, fps: float, settings: OcclusionSettings = DEFAULT) -> Array:
    """The same, without what is there for a frame or two: the median over frames side by side (F,)."""
    frames = max(1, 2 * (round(settings.lasting * fps / 25) // 2) + 1)
    return np.asarray(median_filter(shares, frames, mode="nearest"), np.float64)


def print_kept(
    reconstruction: Reconstruction, positions: Array, settings: OcclusionSettings = DEFAULT
) -> tuple[Array, Flags]:
    """How much of the print around every point is there, 1 for all of it (F, n, n), and where that is known.

    The contrast with which the patch of the first frame is found in the image, by least squares, its mean
    free: 0 where nothing is like it. The best of the places and blurs that are tried. Known where the patch
    is seen and has a print of its own in the first frame.
    """
    scene, n = reconstruction.scene, settings.points
    points = grid_points(scene.grid, n, 0.0, 0)
    pixels = scene.camera.project(torch.from_numpy(points.positions(positions))).numpy()
    shown = visible(reconstruction, points, positions) > 0.5
    now, inside = _colours(scene, pixels, settings.blurs[0])
    colours = now.reshape(-1, n, n, 3)
    seen = (shown & inside).reshape(-1, n, n)
    kept = np.full(seen.shape, -np.inf)
    known: Flags | None = None
    for blur in settings.blurs:
        blurred, inside = _colours(scene, pixels[:1], blur)
        print_, there = blurred[0].reshape(n, n, 3), inside[0].reshape(n, n) & seen[0]
        for aside, also in _aside(print_, there, settings):
            found, enough = _contrast(colours, seen, aside, also, settings)
            kept = np.maximum(kept, np.where(enough, found, -np.inf))
            # A print nearby is none of this place's own.
            known = enough & seen if known is None else known
    assert known is not None
    return kept, known


def _colours(scene: Scene, pixels: Array, blur: float) -> tuple[Array, Flags]:
    """Colours of the cloth at pixels (F, P, 2), blurred within the mask (F, P, 3), and which count (F, P)."""
    colours, inside = np.empty((*pixels.shape[:2], 3)), np.empty(pixels.shape[:2], bool)
    for f, at in enumerate(pixels):
        mask = scene.masks[f].numpy().astype(np.float64)
        frame = scene.frames[f].numpy().astype(np.float64)
        for k in range(3):
            colours[f, :, k], share = blurred_at(frame[..., k], mask, at, blur)
        inside[f] = share > _INSIDE
    return colours, inside


def _aside(print_: Array, there: Flags, settings: OcclusionSettings) -> Iterator[tuple[Array, Flags]]:
    """The print (n, n, 3) at all places that are tried, and where it is known there."""
    reach, n = settings.aside, len(print_)
    wide = np.pad(print_, ((reach, reach), (reach, reach), (0, 0)))
    known = np.pad(there, reach)
    # In its own place first: that one is always tried.
    offsets = sorted({0, *range(-reach, reach + 1, settings.step)}, key=abs)
    for i in offsets:
        for j in offsets:
            rows, columns = slice(reach + i, reach + i + n), slice(reach + j, reach + j + n)
            yield wide[rows, columns], known[rows, columns]


def _contrast(
    colours: Array, seen: Flags, print_: Array, there: Flags, settings: OcclusionSettings
) -> tuple[Array, Flags]:
    """Contrast with which a print is found in every frame (F, n, n), and where there is enough of it."""
    both = (seen & there).astype(np.float64)

    def mean(values: Array) -> Array:
        size = (0, settings.patch, settings.patch)
        return np.asarray(uniform_filter(values, size, mode="constant"), np.float64)

    share = mean(both)
    weight = np.maximum(share, 1e-9)
    along, of_print = np.zeros(seen.shape), np.zeros(seen.shape)
    for k in range(3):
        colour, own = both * colours[..., k], both * print_[..., k]
        of_patch = mean(own)
        along += mean(colour * print_[..., k]) - mean(colour) * of_patch / weight
        of_print += mean(own * print_[..., k]) - of_patch**2 / weight
    enough = (share > _SEEN) & (of_print / weight > settings.contrast**2)
    return along / np.maximum(of_print, 1e-12), enough
