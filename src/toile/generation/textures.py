"""Procedural textures with detail at every scale that never repeats."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from torch import Tensor

from toile.errors import InputError
from toile.limits import Count, Seed

_OVERSAMPLING = 2
_DARKEST, _BRIGHTEST = 0.12, 0.98  # never as dark as the black background, never clipped

Draw = ImageDraw.ImageDraw
Rng = np.random.Generator


def procedural_texture(height: Count, width: Count, seed: Seed) -> Tensor:
    """Smooth coloured noise under random shapes and glyphs, from a fifth of the side down to a few pixels.

    Rows of real prints repeat and give an image term false minima; here no two places look alike.

    Args:
        height: of the texture [px].
        width: of the texture [px].
        seed: the same seed gives the same texture, bit for bit.

    Returns:
        Texture (height, width, 3), float32 in [0, 1].

    Raises:
        InputError: a side is shorter than 8 px.
    """
    if min(height, width) < 8:
        raise InputError(
            "Texture is too small",
            where="procedural_texture",
            expected="a height and width of at least 8 px",
            got=f"{height} × {width} px",
        )
    rng = np.random.default_rng(seed)
    h, w = _OVERSAMPLING * height, _OVERSAMPLING * width
    canvas = _coloured_noise(h, w, rng)
    image = Image.fromarray((canvas * 255).round().astype(np.uint8))
    draw = ImageDraw.Draw(image)
    side = min(h, w)
    # Number times area stays about the same from layer to layer, so each covers a similar share.
    for fraction, count in ((0.22, 14), (0.12, 45), (0.06, 150), (0.033, 400)):
        radius = 0.5 * fraction * side
        for _ in range(max(1, round(count * h * w / side**2))):
            centre = rng.uniform((0.0, 0.0), (w, h))
            _draw_one(draw, centre, radius * rng.uniform(0.6, 1.3), _random_colour(rng), rng)
    image = image.resize((width, height), Image.Resampling.BOX)
    grain = 0.05 * _smooth_noise(height, width, max(2.0, 0.01 * min(height, width)), rng)[..., None]
    texture = np.asarray(image, np.float64) / 255 + grain
    return torch.from_numpy(texture.clip(_DARKEST, _BRIGHTEST).astype(np.float32))


def _coloured_noise(h: int, w: int, rng: Rng) -> NDArray[np.float64]:
    """Sum of smooth noise of four wavelengths per channel, (h, w, 3) in [0.2, 0.9]."""
    total = np.zeros((h, w, 3))
    for octave in range(4):
        wavelength = max(2.0, min(h, w) / (3 * 2**octave))
        for channel in range(3):
            total[..., channel] += _smooth_noise(h, w, wavelength, rng) / 1.6**octave
    return 0.55 + 0.35 * np.tanh(0.6 * total)


def _smooth_noise(h: int, w: int, wavelength: float, rng: Rng) -> NDArray[np.float64]:
    """Bicubically enlarged white noise (h, w), mean 0, about unit deviation."""
    coarse = rng.standard_normal((max(2, round(h / wavelength)) + 2, max(2, round(w / wavelength)) + 2))
    image = Image.fromarray(coarse.astype(np.float32)).resize((w, h), Image.Resampling.BICUBIC)
    return np.asarray(image, np.float64)


def _random_colour(rng: Rng) -> tuple[int, int, int]:
    r, g, b = rng.uniform(0.15, 0.97, 3) * 255
    return round(r), round(g), round(b)


def _draw_one(
    draw: Draw, centre: NDArray[np.float64], radius: float, colour: tuple[int, int, int], rng: Rng
) -> None:
    kinds = (_draw_polygon, _draw_ellipse, _draw_ring, _draw_glyph, _draw_glyph)
    kinds[int(rng.integers(len(kinds)))](draw, centre, radius, colour, rng)


def _draw_polygon(
    draw: Draw, centre: NDArray[np.float64], radius: float, colour: tuple[int, int, int], rng: Rng
) -> None:
    n = int(rng.integers(3, 7))
    angles = np.sort(rng.uniform(0, 2 * np.pi, n))
    radii = radius * rng.uniform(0.6, 1.2, n)
    points = centre + radii[:, None] * np.stack((np.cos(angles), np.sin(angles)), -1)
    draw.polygon([(float(x), float(y)) for x, y in points], fill=colour)


def _draw_ellipse(
    draw: Draw, centre: NDArray[np.float64], radius: float, colour: tuple[int, int, int], rng: Rng
) -> None:
    a, b = radius * rng.uniform(0.4, 1.1, 2)
    x, y = centre
    draw.ellipse((float(x - a), float(y - b), float(x + a), float(y + b)), fill=colour)


def _draw_ring(
    draw: Draw, centre: NDArray[np.float64], radius: float, colour: tuple[int, int, int], rng: Rng
) -> None:
    x, y = centre
    start, extent = rng.uniform(0, 360), rng.uniform(120, 360)
    box = (float(x - radius), float(y - radius), float(x + radius), float(y + radius))
    draw.arc(box, start, start + extent, fill=colour, width=max(1, round(0.35 * radius)))


def _draw_glyph(
    draw: Draw, centre: NDArray[np.float64], radius: float, colour: tuple[int, int, int], rng: Rng
) -> None:
    """A letter of an unknown alphabet: strokes between the points of a rotated 3×3 lattice."""
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    lattice = np.stack(np.meshgrid((-0.7, 0.0, 0.7), (-0.9, 0.0, 0.9)), -1).reshape(-1, 2)
    path = rng.permutation(9)[: int(rng.integers(3, 6))]
    points = centre + radius * lattice[path] @ turn.T
    line = [(float(x), float(y)) for x, y in points]
    draw.line(line, fill=colour, width=max(1, round(0.3 * radius)), joint="curve")
