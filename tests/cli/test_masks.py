"""``toile masks``: from a clip to frames and masks, and what it refuses."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from toile.scenes.images import read_mask, read_rgb
from toile.scenes.native import FILES, load_native

# imageio-ffmpeg leaves the pipes of an ffmpeg that has ended to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
N_FRAMES, HEIGHT, WIDTH = 5, 48, 64
TOP, LEFT, SIDE = 12, 14, 24


def pictures() -> np.ndarray:
    """An orange square before black that moves by 2 px per frame, with a dark spot."""
    frames = np.zeros((N_FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    for k in range(N_FRAMES):
        left = LEFT + 2 * k
        frames[k, TOP : TOP + SIDE, left : left + SIDE] = (220, 140, 60)
        frames[k, TOP + 10 : TOP + 14, left + 10 : left + 14] = 0
    return frames


def write_images(folder: Path, frames: np.ndarray) -> Path:
    folder.mkdir()
    for k, frame in enumerate(frames):
        Image.fromarray(frame).save(folder / f"{k}.png")
    return folder


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    path = tmp_path / "clip.mp4"
    iio.imwrite(path, pictures(), plugin="FFMPEG", fps=20, quality=9, macro_block_size=2)
    return path


def found(folder: Path, k: int) -> np.ndarray:
    return read_mask(folder / "masks" / f"mask_{k:03d}.png").numpy()


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_video_becomes_frames_and_masks(toile, clip: Path) -> None:
    status, out, err = toile("masks", "video=clip.mp4", "scene=made/mine", "method=dark_background")
    assert (status, err) == (0, "")
    assert out.count("[warning]") == out.count("Few frames") == 1
    folder = Path("made/mine")
    assert sorted(p.name for p in folder.iterdir()) == ["masks", "masks.mp4", "rgbs", "video.json"]
    description = json.loads((folder / "video.json").read_text())
    expected = {"fps": 20, "width": WIDTH, "height": HEIGHT, "frames": N_FRAMES, "source": "clip.mp4"}
    assert expected.items() <= description.items()
    assert description["method"] == "dark_background"
    assert description["settings"]["threshold"] == 16
    assert "_target_" not in str(description)
    for k, true in enumerate(pictures()):
        frame = read_rgb(folder / "rgbs" / f"rgb_{k:03d}.png").numpy().astype(int)
        assert np.abs(frame - true).mean() < 10
        mask = found(folder, k)
        assert set(np.unique(mask)) == {0, 255}
        assert SIDE**2 <= (mask > 0).sum() <= (SIDE + 4) ** 2
        assert mask[TOP + 12, LEFT + 2 * k + 12] == 255
    preview = iio.imread(folder / "masks.mp4", plugin="FFMPEG")
    # Cut to the cloth's way and a quarter of its size around.
    height, width = preview.shape[1:3]
    assert len(preview) == N_FRAMES
    assert SIDE < height < HEIGHT
    assert SIDE + 2 * (N_FRAMES - 1) < width < WIDTH
    # Nothing else is left behind.
    assert sorted(p.name for p in Path("made").iterdir()) == ["mine"]


def test_a_folder_of_images_is_kept_exactly(toile, tmp_path: Path) -> None:
    write_images(tmp_path / "images", pictures())
    selection = ("every=2", "fps=30", "method.box=[8,6,46,42]")
    status, _, err = toile("masks", "video=images", "scene=mine", *selection)
    assert (status, err) == (0, "")
    description = json.loads(Path("mine/video.json").read_text())
    assert (description["fps"], description["frames"], description["source"]) == (15, 3, "images")
    for k in range(3):
        frame = read_rgb(Path(f"mine/rgbs/rgb_{k:03d}.png")).numpy()
        assert np.array_equal(frame, pictures()[2 * k])
        left = LEFT + 4 * k
        true = np.zeros((HEIGHT, WIDTH), dtype=bool)
        true[TOP : TOP + SIDE, left : left + SIDE] = True
        assert np.array_equal(found(Path("mine"), k) > 0, true)


def test_a_still_to_read_coordinates_from(toile, clip: Path) -> None:
    status, out, _ = toile("masks", "video=clip.mp4", "start=2", "still=frame.png")
    assert (status, out.strip()) == (0, "frame.png")
    assert sorted(p.name for p in Path().iterdir()) == ["clip.mp4", "frame.png"]
    ruled, plain = read_rgb(Path("frame.png")).numpy().astype(int), pictures()[2]
    assert ruled.shape == plain.shape
    # Lines at multiples of 10 px, the frame between them.
    assert np.abs(ruled[15:19, 21:29] - plain[15:19, 21:29]).max() < 20
    assert np.abs(ruled[30, 15:19] - plain[30, 15:19]).max() > 50


def test_given_masks(toile, tmp_path: Path) -> None:
    write_images(tmp_path / "images", pictures())
    write_images(tmp_path / "elsewhere", pictures()[..., :1].repeat(3, -1))
    arguments = ("video=images", "fps=25", "scene=mine", "method=given", "method.folder=elsewhere")
    assert toile("masks", *arguments).status == 0
    assert found(Path("mine"), 0).sum() == 255 * SIDE**2
    status, _, err = toile("masks", *arguments, "n_frames=4", "overwrite=true")
    assert status == 2
    assert "5 masks, only 4 frames" in err


def test_suspicious_masks_are_named_and_written(toile, tmp_path: Path) -> None:
    frames = pictures()
    frames[3, : 2 * SIDE, : 2 * SIDE] = 200
    write_images(tmp_path / "images", frames)
    status, out, _ = toile("masks", "video=images", "fps=25", "scene=mine", "method=dark_background")
    assert status == 0
    assert "jumps in area" in out
    assert "frames 3, 4" in out
    assert "border" in out
    assert "frame 3)" in out
    assert len(list(Path("mine/masks").iterdir())) == N_FRAMES


def test_nothing_is_overwritten_unasked(toile, clip: Path) -> None:
    Path("mine").mkdir()
    Path("mine/camera.json").write_text("{}")
    arguments = ("video=clip.mp4", "scene=mine", "method=dark_background")
    assert toile("masks", *arguments).status == 0
    Path("mine/template.obj").write_text("v 0 0 1")
    before = tree(Path("mine"))
    status, _, err = toile("masks", *arguments, "n_frames=2")
    assert status == 2
    assert "overwrite=true" in err
    assert tree(Path("mine")) == before
    status, out, _ = toile("masks", *arguments, "n_frames=2", "overwrite=true")
    assert status == 0
    assert "Template was made from other frames" in out
    assert len(list(Path("mine/rgbs").iterdir())) == len(list(Path("mine/masks").iterdir())) == 2
    assert Path("mine/camera.json").read_text() == "{}"
    assert Path("mine/template.obj").is_file()


def test_an_interrupted_run_leaves_everything_as_it_was(toile, clip: Path, monkeypatch) -> None:
    arguments = ("video=clip.mp4", "scene=mine", "method=dark_background")
    assert toile("masks", *arguments).status == 0
    before = tree(Path())

    def break_off(*_: object) -> None:
        raise KeyboardInterrupt

    # After the frames have been written.
    monkeypatch.setattr("toile.cli.masks.write_video", break_off)
    assert toile("masks", *arguments, "overwrite=true", "every=2").status == 130
    assert tree(Path()) == before


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("scene=mine",), "video="),
        (("video=clip.mp4", "method=dark_background"), "scene="),
        (("video=nothing.mp4", "scene=mine", "method.box=[1,1,9,9]"), "nothing.mp4"),
        (("video=clip.mp4", "scene=mine"), "method.box=[x0,y0,x1,y1]"),
        (("video=clip.mp4", "scene=mine", "method.box=[1,1,99,9]"), "outside"),
        (("video=clip.mp4", "scene=mine", "method.box=[a,b,c,d]"), "method"),
        (("video=clip.mp4", "scene=mine", "method=dark_background", "start=9"), "start=9"),
        (("video=clip.mp4", "scene=mine", "method=dark_background", "method.threshold=250"), "frame 0"),
        (("video=clip.mp4", "scene=mine", "method=given"), "folder"),
        (("video=clip.mp4", "scene=clip.mp4", "method=dark_background"), "clip.mp4"),
        (("video=clip.mp4", "scene=mine", "method=magic"), "grabcut"),
    ],
)
def test_bad_input(toile, clip: Path, arguments, named) -> None:
    status, out, err = toile("masks", *arguments)
    assert (status, out) == (2, "")
    assert named in err
    assert [p.name for p in Path().iterdir()] == ["clip.mp4"]


@pytest.fixture
def uneven(tmp_path: Path) -> Path:
    """The square for 8 frames at 20 ms and 4 at 80 ms, its sixth picture shown once more."""
    folder = write_images(tmp_path / "source", [pictures()[k] for k in (0, 1, 2, 3, 4, 3, 3, 2, 1, 0, 1, 2)])
    path = tmp_path / "uneven.mp4"
    ffmpeg = (imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-framerate", "50")
    times = "settb=1/90000,setpts='if(lt(N,8),0.02*N,0.16+0.08*(N-8))/TB'"
    written = (
        "-fps_mode",
        "passthrough",
        "-enc_time_base",
        "1/90000",
        "-pix_fmt",
        "yuv420p",
        "-crf",
        "10",
        path,
    )
    subprocess.run([*ffmpeg, "-i", folder / "%d.png", "-vf", times, *written], check=True)
    return path


UNEVEN_TIMES = [*(0.02 * np.arange(8)), *(0.16 + 0.08 * np.arange(4))]


def test_a_phone_s_clip_keeps_its_times_up_to_the_scene(toile, uneven: Path) -> None:
    status, out, err = toile("masks", "video=uneven.mp4", "scene=mine", "method=dark_background")
    assert (status, err) == (0, "")
    said = " ".join(out.split())
    assert "Frames are unevenly spaced" in said
    assert "Frames are duplicates of the frame before" in said
    assert "frame 6" in said
    assert "camera" not in said
    assert "12 frames of 64 x 48 px, 27.5 per second on average" in said
    description = json.loads(Path("mine/video.json").read_text())
    assert description["frames"] == 12
    np.testing.assert_allclose(description["times"], UNEVEN_TIMES, atol=1e-3)
    # So do the frames of the scene, when masks made elsewhere are given for them.
    given = ("masks", "video=mine/rgbs", "scene=again", "method=given", "method.folder=mine/masks")
    assert toile(*given).status == 0
    assert json.loads(Path("again/video.json").read_text())["times"] == description["times"]
    assert "fps replaces" in " ".join(toile(*given, "fps=25", "overwrite=true").out.split())
    # The template takes them over.
    make = (
        "template",
        "scene=mine",
        "surface=sheet",
        "cloth_size=[0.4,0.4]",
        "camera.fx=80",
        "camera.fy=80",
        "camera.cx=32",
        "camera.cy=24",
        "grid=[5,5]",
    )
    status, out, err = toile(*make)
    assert (status, err) == (0, "")
    assert "Frames are unevenly spaced" in " ".join(out.split())
    scene = load_native(Path("mine"))
    assert scene.times is not None
    assert scene.times.tolist() == description["times"]
    assert scene.fps == pytest.approx(11 / 0.4)
    assert any("Frames are unevenly spaced" in note for note in scene.notes)
    status, out, _ = toile("doctor", "scene=mine")
    assert status == 0
    for name in ("unevenly", "duplicates"):
        assert name in out
    assert "camera seems" not in " ".join(out.split())
    # A rate given by hand replaces them, and that is said.
    status, out, _ = toile(*make, "scene.fps=25", "overwrite=true")
    assert status == 0
    assert "fps replaces" in " ".join(out.split())
    assert (load_native(Path("mine")).times, load_native(Path("mine")).fps) == (None, 25)
    # A description that fits other frames is not believed.
    for key in ("rgb", "mask"):
        (Path("mine") / (FILES[key] % 11)).unlink()
    status, _, err = toile(*make, "overwrite=true")
    assert status == 2
    assert "12 times for 11 frames" in err


def test_evenly_spaced_frames_on_request(toile, uneven: Path) -> None:
    arguments = ("masks", "video=uneven.mp4", "scene=mine", "method=dark_background")
    status, out, _ = toile(*arguments, "times=uniform")
    assert status == 0
    assert "6 of 12 frames, 6 left out; 12.5 per second" in " ".join(out.split())
    description = json.loads(Path("mine/video.json").read_text())
    assert "times" not in description
    assert (description["frames"], description["fps"]) == (6, pytest.approx(12.5, rel=1e-4))
    for wrong in ("times=even", "uniform_tolerance=0.5"):
        status, _, err = toile(*arguments, wrong, "overwrite=true")
        assert status == 2
        assert wrong.split("=")[0] in err
    assert json.loads(Path("mine/video.json").read_text()) == description


def test_how_far_it_is_stands_in_the_log(toile, clip: Path, monkeypatch) -> None:
    monkeypatch.setattr("toile.progress.SECONDS_BETWEEN_LINES", 0.0)
    _, out, err = toile("masks", "video=clip.mp4", "scene=mine", "method=dark_background")
    lines = err.splitlines()
    assert lines[0] == f"masks: 0 of {N_FRAMES}"
    assert lines[2].startswith(f"masks: 2 of {N_FRAMES}, about ")
    assert lines[-1].startswith(f"masks.mp4: {N_FRAMES} of {N_FRAMES}")
    assert "masks: " not in out
