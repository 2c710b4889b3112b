"""Clips from video files and folders of images."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageFile

from toile.errors import InputError
from toile.preparation import video as video_module
from toile.preparation.video import open_clip
from toile.scenes.images import image_size

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


def test_a_photo_taken_upright_is_upright(tmp_path: Path) -> None:
    """Cameras store it on its side and say so; what calibrates them (OpenCV) turns it."""
    rows = np.arange(4 * 6, dtype=np.uint8).reshape(4, 6) * 10
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    for k in range(2):
        Image.fromarray(rows).save(tmp_path / f"{k}.png", exif=exif)
    clip = open_clip(tmp_path, fps=30.0)
    assert (clip.height, clip.width) == (6, 4)
    (frame, _) = (np.asarray(frame) for frame in clip.frames())
    np.testing.assert_array_equal(frame[..., 0], np.rot90(rows, -1))


def test_sizes_are_told_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every frame of a scene is asked for its own before anything runs."""
    for name in ("a.png", "b.jpg"):
        Image.fromarray(np.zeros((4, 6, 3), np.uint8)).save(tmp_path / name)

    def decoded(*_: object) -> None:
        raise AssertionError("the whole image was decoded")

    monkeypatch.setattr(ImageFile.ImageFile, "load", decoded)
    assert {image_size(tmp_path / name) for name in ("a.png", "b.jpg")} == {(4, 6)}


def test_a_given_rate_replaces_times_of_other_frames(tmp_path: Path) -> None:
    folder = tmp_path / "rgbs"
    folder.mkdir()
    for k in range(3):
        Image.fromarray(np.full((4, 6, 3), k, np.uint8)).save(folder / f"rgb_{k:03d}.png")
    (tmp_path / "video.json").write_text(json.dumps({"fps": 10.0, "times": [0.0, 0.1, 0.25, 0.3]}))
    with pytest.raises(InputError, match="4 times for 3 frames"):
        open_clip(folder)
    clip = open_clip(folder, fps=30.0)
    assert clip.fps == 30.0
    assert clip.times is None


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


def with_times(target: Path, expression: str, n_frames: int = 16) -> Path:
    """A clip of grey levels that rise by 10 whose frame N is at the time that the expression gives."""
    ffmpeg = (imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "lavfi")
    size = f"{WIDTH}x{HEIGHT}"
    level = f"geq=lum='16+10*N':cb=128:cr=128,settb=1/90000,setpts='({expression})/TB'"
    source = ("-i", f"color=black:size={size}:rate=50", "-frames:v", str(n_frames), "-vf", level)
    written = ("-fps_mode", "passthrough", "-enc_time_base", "1/90000", "-pix_fmt", "yuv420p", target)
    subprocess.run([*ffmpeg, *source, *written], check=True)
    return target


PHONE = "if(lt(N,8),0.02*N,0.16+0.08*(N-8))"


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """8 frames at 20 ms, then 8 at 80 ms."""
    return with_times(tmp_path_factory.mktemp("phone") / "phone.mp4", PHONE)


PHONE_TIMES = [*(0.02 * np.arange(8)), *(0.16 + 0.08 * np.arange(8))]


def test_frames_of_a_variable_rate_come_once_each_with_their_times(phone: Path) -> None:
    clip = open_clip(phone)
    np.testing.assert_allclose(clip.times, PHONE_TIMES, atol=1e-3)
    frames = [frame.mean() for frame in clip.frames()]
    assert len(frames) == clip.expected_frames == 16
    # Every one is another picture: none was repeated.
    assert (np.diff(frames) > 5).all()
    assert clip.fps == pytest.approx(15 / 0.72)
    assert any("unevenly spaced" in str(remark) for remark in clip.remarks)


def test_chosen_frames_bring_their_times(phone: Path) -> None:
    clip = open_clip(phone, start=6, every=3)
    np.testing.assert_allclose(clip.times, [0, 0.12, 0.36, 0.6], atol=1e-3)
    assert len(list(clip.frames())) == 4
    # Frames that happen to be evenly spaced have a rate and no times.
    first = open_clip(phone, n_frames=8)
    assert (first.times, first.remarks) == (None, ())
    assert first.fps == pytest.approx(50, rel=1e-4)
    assert len(list(first.frames())) == 8


def test_a_given_rate_replaces_the_times_and_says_so(phone: Path) -> None:
    clip = open_clip(phone, fps=25)
    assert (clip.fps, clip.times) == (25, None)
    assert [remark.what for remark in clip.remarks] == ["fps replaces uneven time stamps"]
    assert len(list(clip.frames())) == 16


def test_a_constant_rate_gives_no_times_however_the_container_rounds(tmp_path: Path) -> None:
    """Matroska counts milliseconds, so frames at 60 per second are 16 or 17 of them apart."""
    for name in ("even.mkv", "even.mp4"):
        clip = open_clip(with_times(tmp_path / name, "N/60", 30))
        assert (clip.times, clip.remarks) == (None, ()), name
        assert clip.fps == pytest.approx(60, rel=5e-3)


def test_a_dropped_frame_is_told_from_another_rate(phone: Path, tmp_path: Path) -> None:
    dropped = open_clip(with_times(tmp_path / "dropped.mp4", "(N+gte(N,6)+gte(N,11))/50"))
    found = {remark.what: remark for remark in dropped.remarks}
    assert "frames 5, 10" in found["Frames are missing"].where
    assert "2 frames were dropped" in found["Frames are missing"].got
    assert not any(remark.what == "Frames are missing" for remark in open_clip(phone).remarks)


@pytest.mark.parametrize(
    ("stamps", "got"), [([0.0, 0.02, 0.02, 0.06], "after 0.02 s"), ([0.0, None, 0.04], "1 of 3 missing")]
)
def test_broken_time_stamps(video: Path, monkeypatch: pytest.MonkeyPatch, stamps, got) -> None:
    monkeypatch.setattr(video_module, "_time_stamps", lambda path, stop: (stamps, 1e-3))
    with pytest.raises(InputError, match="broken") as caught:
        open_clip(video)
    assert got in caught.value.got
    assert "fps=" in caught.value.expected
    assert open_clip(video, fps=30).fps == 30


def test_evenly_spaced_frames_of_an_uneven_clip(phone: Path) -> None:
    clip = open_clip(phone).evenly_spaced(0.1)
    levels = [frame.mean() for frame in open_clip(phone).frames()]
    chosen = [frame.mean() for frame in clip.frames()]
    np.testing.assert_allclose(chosen, [levels[k] for k in (0, 4, *range(8, 16))])
    assert (clip.times, clip.fps) == (None, pytest.approx(12.5))
    assert "10 of 16 frames, 6 left out" in clip.remarks[0].got


def test_a_clip_filmed_upright_keeps_its_times(phone: Path, tmp_path: Path) -> None:
    turned = tmp_path / "upright.mp4"
    quiet = (imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-display_rotation", "90")
    subprocess.run([*quiet, "-i", phone, "-c", "copy", turned], check=True)
    clip = open_clip(turned)
    np.testing.assert_allclose(clip.times, PHONE_TIMES, atol=1e-3)
    assert next(clip.frames()).shape == (WIDTH, HEIGHT, 3)
