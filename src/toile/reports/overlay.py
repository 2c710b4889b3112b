"""Overlay video: observed | rendered | difference | wireframe on the observed frame."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import imageio_ffmpeg
import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from toile.atomic_file import written_atomically
from toile.geometry.camera import Camera

Picture = npt.NDArray[np.uint8]

DIFFERENCE_FULL_SCALE = 0.5
"""Mean colour difference that gets the brightest colour of the difference panel."""
SUPERSAMPLING = 2
CAPTION_HEIGHT = 26
BACKGROUND = (255, 255, 255)
CAPTION_COLOUR = (28, 36, 48)
WIRE_COLOUR = (0, 229, 255, 190)
_FULL = 64 * 1024  # bytes that are left of a disk that an encoder has filled


def wireframe(observed: Tensor, positions: Tensor, camera: Camera, height: int | None = None) -> Picture:
    """Draw the cloth grid over an observed frame.

    Args:
        observed: RGB frame (h, w, 3) in [0, 1].
        positions: grid positions (H, W, 3) [m], camera frame; lines to points behind the camera are left out.
        camera: camera of the frame.
        height: height of the result [px], default that of the frame.

    Returns:
        RGB picture (height, width, 3), uint8, in the proportions of the frame.
    """
    height = camera.height if height is None else height
    size = (round(camera.width * height / camera.height), height)
    scale = SUPERSAMPLING * height / camera.height
    x = positions.detach().cpu().double()
    pixel = (camera.project(x) * scale).numpy()
    visible = (x[..., 2] > 0).numpy()
    layer = Image.new("RGBA", (SUPERSAMPLING * size[0], SUPERSAMPLING * size[1]), (*WIRE_COLOUR[:3], 0))
    draw = ImageDraw.Draw(layer)
    for lines, seen in ((pixel, visible), (pixel.transpose(1, 0, 2), visible.T)):
        for line, keep in zip(lines, seen, strict=True):
            if keep.all():
                draw.line([tuple(p) for p in line.tolist()], fill=WIRE_COLOUR, width=SUPERSAMPLING)
    image = Image.fromarray(_to_uint8(observed)).resize(size, Image.Resampling.LANCZOS).convert("RGBA")
    image.alpha_composite(layer.resize(size, Image.Resampling.BOX))
    return np.asarray(image.convert("RGB"))


def difference(observed: Tensor, mask: Tensor, rendered: Tensor) -> Picture:
    """Colour difference between the masked observed frame and the rendered one (black outside the cloth).

    Args:
        observed: RGB frame (h, w, 3) in [0, 1].
        mask: observed mask (h, w) in [0, 1].
        rendered: rendered RGB image (h, w, 3) in [0, 1], black where there is no cloth.

    Returns:
        Mean absolute difference of the channels, as colours of the map "magma", (h, w, 3), uint8.
    """
    error = (observed * mask[..., None] - rendered).detach().abs().mean(-1).cpu().numpy()
    colours: Picture = mpl.colormaps["magma"](np.clip(error / DIFFERENCE_FULL_SCALE, 0.0, 1.0), bytes=True)
    return colours[..., :3]


def overlay_picture(
    observed: Tensor,
    mask: Tensor,
    rendered: Tensor,
    positions: Tensor,
    camera: Camera,
    *,
    panel_height: int = 360,
    caption: str = "",
) -> Picture:
    """The four panels of one frame side by side, captioned; sides are even, as video encoders want them.

    Args:
        observed: RGB frame (h, w, 3) in [0, 1].
        mask: observed mask (h, w) in [0, 1].
        rendered: rendered RGB image (h, w, 3) in [0, 1], black where there is no cloth.
        positions: grid positions (H, W, 3) [m], camera frame.
        camera: camera of the frame.
        panel_height: height of a panel [px].
        caption: shown behind the first panel's name, e.g. "frame 12".
    """
    size = (round(camera.width * panel_height / camera.height), panel_height)
    panels = {
        f"observed   {caption}".rstrip(): _to_uint8(observed),
        "rendered": _to_uint8(rendered),
        "difference": difference(observed, mask, rendered),
        "mesh": wireframe(observed, positions, camera, panel_height),
    }
    gap = 6
    width = len(panels) * size[0] + (len(panels) - 1) * gap
    height = panel_height + CAPTION_HEIGHT
    canvas = Image.new("RGB", (width + width % 2, height + height % 2), BACKGROUND)
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=14)
    for k, (name, panel) in enumerate(panels.items()):
        left = k * (size[0] + gap)
        canvas.paste(Image.fromarray(panel).resize(size, Image.Resampling.LANCZOS), (left, CAPTION_HEIGHT))
        draw.text((left + 2, 5), name, fill=CAPTION_COLOUR, font=font)
    return np.asarray(canvas)


def overlay_pictures(
    frames: Tensor,
    masks: Tensor,
    rendered: Iterable[Tensor],
    trajectory: Tensor,
    camera: Camera,
    *,
    panel_height: int = 360,
) -> Iterator[Picture]:
    """Overlay pictures of a whole video, made one at a time.

    Args:
        frames: RGB frames (F, h, w, 3) in [0, 1].
        masks: observed masks (F, h, w) in [0, 1].
        rendered: rendered RGB images (h, w, 3), one per frame; a tensor (F, h, w, 3) will do.
        trajectory: positions (F, H, W, 3) [m], camera frame.
        camera: camera of the frames.
        panel_height: height of a panel [px].
    """
    for f, image in enumerate(rendered):
        yield overlay_picture(
            frames[f],
            masks[f],
            image,
            trajectory[f],
            camera,
            panel_height=panel_height,
            caption=f"frame {f}",
        )


def write_video(pictures: Iterable[Picture], path: Path, fps: float) -> Path:
    """Write pictures (h, w, 3), uint8, as H.264 video; as a GIF beside it where no encoder is found.

    Args:
        pictures: pictures of one size with even sides.
        path: the .mp4 file to write.
        fps: frames per second.

    Raises:
        OSError: it cannot be written completely.

    Returns:
        The file that was written: ``path``, or ``path`` with the suffix .gif.
    """
    if has_video_encoder():
        # yuv420p and fast start: plays in every browser, and before it is loaded completely.
        options: dict[str, Any] = {
            "plugin": "FFMPEG",
            "fps": fps,
            "codec": "libx264",
            "quality": 8,
            "macro_block_size": 2,
            "output_params": ["-movflags", "+faststart"],
            "ffmpeg_log_level": "quiet",
        }
    else:
        path = path.with_suffix(".gif")
        # GIF counts in hundredths of a second.
        options = {"plugin": "pillow", "duration": max(20, 10 * round(100 / fps)), "loop": 0}
    with written_atomically(path) as temporary:
        stack = np.stack(list(pictures))
        iio.imwrite(temporary, stack, **options)
        if path.suffix == ".mp4":
            _check_complete(temporary, len(stack))
    return path


def _check_complete(video: Path, n_frames: int) -> None:
    """Nobody asks the encoder how it has ended; a full disk leaves a file that no player opens.

    Raises:
        OSError: the file does not hold so many frames.
    """
    try:
        found, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
    except RuntimeError:
        found = 0
    if found != n_frames:
        full = shutil.disk_usage(video.parent).free < _FULL
        raise OSError(errno.ENOSPC if full else errno.EIO, f"{found} of {n_frames} frames", str(video))


def has_video_encoder() -> bool:
    """Whether an ffmpeg executable is found."""
    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except (RuntimeError, OSError):
        return False
    return True


def _to_uint8(image: Tensor) -> Picture:
    picture: Picture = (image.detach().cpu().float().clamp(0, 1) * 255).round().byte().numpy()
    return picture
