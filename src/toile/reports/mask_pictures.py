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


def mask_picture(frame: Picture, mask: npt.NDArray[np.bool_], height: int, caption: str = "") -> Picture:
    """The frame, darker outside the mask, with its outline; sides are even, as video encoders want them.

    Args:
        frame: RGB picture (h, w, 3), uint8.
        mask: (h, w).
        height: of the result [px]; a smaller frame is not enlarged.
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
