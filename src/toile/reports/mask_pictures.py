"""Masks over their frames, to judge them by."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from toile.reports.overlay import Picture

OUTLINE = (255, 0, 200)
OUTSIDE = 0.45
"""Brightness of what is not cloth."""
CAPTION = (255, 255, 255)


def rulers(frame: Picture) -> Picture:
    """The frame (h, w, 3) with lines at round numbers of pixels, to read coordinates from."""
    image = Image.fromarray(frame)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size=max(10, image.height // 60))
    step = next(s for s in (10, 20, 50, 100, 200, 500, 1000) if max(image.size) / s <= 20 or s == 1000)
    for x in range(0, image.width, step):
        draw.line([(x, 0), (x, image.height)], fill=OUTLINE)
        draw.text((x + 2, 1), str(x), fill=CAPTION, font=font, stroke_width=1, stroke_fill=(0, 0, 0))
    for y in range(step, image.height, step):
        draw.line([(0, y), (image.width, y)], fill=OUTLINE)
        draw.text((2, y + 1), str(y), fill=CAPTION, font=font, stroke_width=1, stroke_fill=(0, 0, 0))
    return np.asarray(image)


def mask_picture(frame: Picture, mask: npt.NDArray[np.bool_], height: int, caption: str = "") -> Picture:
    """The frame, darker outside the mask, with its outline; sides are even, as video encoders want them.

    Args:
        frame: RGB picture (h, w, 3), uint8.
        mask: (h, w).
        height: of the result [px] at most; a smaller frame is not enlarged.
        caption: shown in the upper left corner.
    """
    h, w = mask.shape
    scale = min(1.0, height / h)
    size = (max(2, 2 * round(w * scale / 2)), max(2, 2 * round(h * scale / 2)))
    picture = np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BOX)).copy()
    inside = np.asarray(Image.fromarray(mask).convert("L").resize(size, Image.Resampling.BOX)) > 127
    picture[~inside] = (OUTSIDE * picture[~inside]).astype(np.uint8)
    picture[ndimage.binary_dilation(inside) & ~ndimage.binary_erosion(inside)] = OUTLINE
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((6, 4), caption, fill=CAPTION, font=ImageFont.load_default(size=14))
    return np.asarray(image)
