"""Clips from video files and folders of images."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from toile.errors import InputError
from toile.scenes.video import open_clip

# imageio-ffmpeg leaves the pipes of an ffmpeg that has ended to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
N_FRAMES, HEIGHT, WIDTH = 12, 32, 48


def pictures() -> np.ndarray:
    """Frame k is grey of level 20 k, left half black."""
    frames = np.zeros((N_FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    frames[:, :, WIDTH // 2 :] = 20 * np.arange(N_FRAMES, dtype=np.uint8)[:, None, None, None]
    return frames


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "clip.mp4"
    iio.imwrite(path, pictures(), plugin="FFMPEG", fps=30, macro_block_size=2)
    return path


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for k, picture in enumerate(pictures()):
        Image.fromarray(picture).save(folder / f"IMG_{k}.png")
    (folder / "notes.txt").write_text("no image")
    return folder


def numbers(clip) -> list[int]:
    """Which frames came, from their grey level."""
    return [round(float(frame[:, -WIDTH // 4 :].mean()) / 20) for frame in clip.frames()]


@pytest.mark.parametrize("kind", ["video", "images"])
@pytest.mark.parametrize(
    ("selection", "chosen", "fps"),
    [
        ({}, range(N_FRAMES), 30),
        ({"start": 5}, range(5, N_FRAMES), 30),
        ({"n_frames": 4}, range(4), 30),
        ({"every": 5}, (0, 5, 10), 6),
        ({"start": 1, "every": 2, "n_frames": 3}, (1, 3, 5), 15),
        ({"start": 10, "n_frames": 9}, (10, 11), 30),
        ({"fps": 60, "every": 6}, (0, 6), 10),
    ],
)
def test_chosen_frames(request, kind, selection, chosen, fps) -> None:
    path = request.getfixturevalue(kind)
    clip = open_clip(path, **({"fps": 30} if kind == "images" else {}) | selection)
    assert (clip.width, clip.height, clip.fps) == (WIDTH, HEIGHT, fps)
    assert numbers(clip) == list(chosen)
    assert clip.expected_frames == len(chosen)


def test_a_clip_filmed_upright_stays_upright(video: Path, tmp_path: Path, caplog) -> None:
    turned = tmp_path / "upright.mp4"
    ffmpeg = imageio_ffmpeg.get_ffmpeg_exe()
    quiet = (ffmpeg, "-loglevel", "error", "-display_rotation", "90")
    subprocess.run([*quiet, "-i", video, "-c", "copy", turned], check=True)
    clip = open_clip(turned)
    assert (clip.width, clip.height) == (HEIGHT, WIDTH)
    last = list(clip.frames())[-1]
    assert last.shape == (WIDTH, HEIGHT, 3)
    # Turned counterclockwise: what was right is above.
    assert last[: WIDTH // 3].mean() > 150
    assert last[-WIDTH // 3 :].mean() < 50
    assert caplog.text == ""


def test_frames_must_have_one_size(images: Path) -> None:
    Image.new("RGB", (WIDTH, 10)).save(images / "IMG_3.png")
    with pytest.raises(InputError, match="differ in size") as caught:
        list(open_clip(images, fps=30).frames())
    assert "frame 3" in caught.value.where


def test_a_folder_has_no_frame_rate(images: Path) -> None:
    with pytest.raises(InputError, match="Frame rate is unknown"):
        open_clip(images)


def test_what_cannot_be_read(video: Path, images: Path, tmp_path: Path) -> None:
    (tmp_path / "half.mp4").write_bytes(video.read_bytes()[:600])
    (tmp_path / "text.mp4").write_text("hello")
    (tmp_path / "empty").mkdir()
    for name, message in (
        ("half.mp4", "cannot be decoded"),
        ("text.mp4", "cannot be decoded"),
        ("empty", "No frames"),
        ("none.mp4", "Video is missing"),
    ):
        with pytest.raises(InputError, match=message):
            open_clip(tmp_path / name, fps=30)
    (images / "IMG_3.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="unreadable"):
        list(open_clip(images, fps=30).frames())


@pytest.mark.parametrize("kind", ["video", "images"])
def test_a_start_beyond_the_end(request, kind) -> None:
    with pytest.raises(InputError, match="No frames are left"):
        list(open_clip(request.getfixturevalue(kind), start=N_FRAMES, fps=30).frames())


@pytest.mark.parametrize("bad", [{"start": -1}, {"n_frames": 0}, {"every": 0}, {"fps": 0}, {"fps": -3}])
def test_settings_that_make_no_sense(video: Path, bad) -> None:
    with pytest.raises(InputError):
        open_clip(video, **bad)
