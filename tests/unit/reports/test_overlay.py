from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from torch import Tensor

from toile.geometry.camera import Camera
from toile.reports import overlay

CAMERA = Camera(100.0, 100.0, 40.0, 30.0, 60, 80)


def square() -> Tensor:
    """A 2×2 grid whose sides project to x = 20 and 60 px, y = 10 and 50 px."""
    return torch.tensor([[[-0.2, -0.2, 1.0], [0.2, -0.2, 1.0]], [[-0.2, 0.2, 1.0], [0.2, 0.2, 1.0]]])


def test_wires_lie_on_the_projected_edges() -> None:
    picture = overlay.wireframe(torch.zeros(60, 80, 3), square(), CAMERA)
    assert picture.shape == (60, 80, 3)
    drawn = picture.max(axis=-1) > 0
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    assert abs(rows[[0, -1]] - [10, 50]).max() <= 1
    assert abs(columns[[0, -1]] - [20, 60]).max() <= 1
    assert not drawn[15:45, 25:55].any()


def test_wires_scale_with_the_picture() -> None:
    drawn = overlay.wireframe(torch.zeros(60, 80, 3), square(), CAMERA, height=120).max(axis=-1) > 0
    assert drawn.shape == (120, 160)
    assert abs(np.flatnonzero(drawn.any(0))[[0, -1]] - [40, 120]).max() <= 1


def test_lines_to_points_behind_the_camera_are_left_out() -> None:
    behind = square()
    behind[..., 2] = -1.0
    assert not overlay.wireframe(torch.zeros(60, 80, 3), behind, CAMERA).any()


def test_difference_is_dark_where_images_agree_and_ignores_the_background() -> None:
    observed, mask = torch.ones(4, 4, 3), torch.zeros(4, 4)
    mask[:2] = 1.0
    rendered = mask[..., None].expand(-1, -1, 3).clone()
    rendered[0, 0] = 0.0
    picture = overlay.difference(observed, mask, rendered).astype(int).sum(-1)
    assert picture[0, 0] > 600
    assert np.delete(picture.ravel(), 0).max() < 20


def test_four_panels_with_even_sides() -> None:
    frame = torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(0))
    picture = overlay.overlay_picture(frame, torch.ones(60, 80), frame, square(), CAMERA, panel_height=61)
    height, width, _ = picture.shape
    assert height % 2 == 0
    assert width % 2 == 0
    assert width >= 4 * 81


@pytest.mark.parametrize("encoder", [True, False], ids=["mp4", "gif"])
def test_video_has_all_frames(encoder: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not encoder:
        monkeypatch.setattr(overlay, "has_video_encoder", lambda: False)
    elif not overlay.has_video_encoder():
        pytest.skip("no ffmpeg executable")
    frames = torch.rand(3, 60, 80, 3, generator=torch.Generator().manual_seed(0))
    trajectory = square().expand(3, -1, -1, -1)
    pictures = overlay.overlay_pictures(
        frames, torch.ones(3, 60, 80), frames, trajectory, CAMERA, panel_height=60
    )
    path = overlay.write_video(pictures, tmp_path / "overlay.mp4", fps=25)
    assert path.suffix == (".mp4" if encoder else ".gif")
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    count = imageio_ffmpeg.count_frames_and_secs(str(path))[0] if encoder else len(iio.imread(path))
    assert count == 3
