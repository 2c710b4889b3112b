"""Data sets: layout, resuming, determinism, images that agree with the truth. The truth is a stand-in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from toile.capture.data.clips import TRUTH_FILE, Domain, PlannedClip, Truth
from toile.capture.data.filming import CameraRing, LandmarkNoise, Looks, detected, film
from toile.capture.data.making import clips_of, make_data
from toile.capture.data.own import CaptureSettings, OwnDomain
from toile.capture.garments.own_mesh import OwnMesh
from toile.errors import InputError
from toile.evaluation.view_silhouettes import overlap_in_views
from toile.rendering.warp.renderer import WarpRenderer
from toile.scenes.multi_view import load_multi_view
from toile.scenes.views import MultiView
from toile.workers import Workers

RING = CameraRing(views=3, side=48, distance=2.5, height=1.0, target=0.5, field_of_view=40.0)
PILLAR = trimesh.creation.cylinder(radius=0.2, height=1.0, sections=12)


class StandIn(Domain):
    """A pillar that sways, in a wider tube."""

    def __init__(self, seed: int = 0, killed_at: int | None = None) -> None:
        self.seed = seed
        self.killed_at = killed_at

    def describe(self) -> Mapping[str, Any]:
        return {"domain": "stand-in", "seed": self.seed, "size": (1, 2)}

    def plans(self) -> Sequence[PlannedClip]:
        return [PlannedClip(k, name, self.seed) for k, name in enumerate(("walk", "turn", "walk"))]

    def share(self, folder: Path) -> None:
        (folder / "subject.npz").write_bytes(b"")

    def truth(self, plan: PlannedClip) -> Truth:
        at = np.asarray(PILLAR.vertices)[:, [0, 2, 1]] + [0, 0.5, 0]
        faces = np.asarray(PILLAR.faces, dtype=np.int64)[:, ::-1]
        side = np.array([[0.0, 0, 0], [plan.stream(0).uniform(0.05, 0.1), 0, 0]])
        body = at[None] + side[:, None]
        wide = (at - [0, 0.5, 0]) * [1.5, 0.5, 1.5] + [0, 0.5, 0]
        keep = ~(np.abs(np.asarray(PILLAR.face_normals)[:, 2]) > 0.9)
        marks = np.stack((body.mean(1), body.max(1)), 1)
        return Truth(body, faces, wide[None] + side[:, None], faces[keep], 25.0, marks, ("middle", "corner"))

    def film(self, plan: PlannedClip, truth: Truth, folder: Path) -> MultiView:
        rng = plan.stream(1)
        looks = Looks.random(rng, 32)
        recording = film(
            truth, RING.cameras(), looks, LandmarkNoise(0.0, 0.0), rng, WarpRenderer(), folder, plan.folder
        )
        if plan.number == self.killed_at:
            raise KeyboardInterrupt
        return recording


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_data(StandIn(), tmp_path_factory.mktemp("data") / "complete")


def test_the_same_settings_give_the_same_bytes_and_another_seed_others(
    complete: Path, tmp_path: Path
) -> None:
    assert contents(make_data(StandIn(), tmp_path / "again")) == contents(complete)
    other = contents(make_data(StandIn(1), tmp_path / "other"))
    assert other["000-walk/truth.npz"] != contents(complete)["000-walk/truth.npz"]


def test_clips_made_beside_each_other_have_the_same_bytes(complete: Path, tmp_path: Path) -> None:
    with Workers(2) as workers:
        assert contents(make_data(StandIn(), tmp_path / "both", workers=workers)) == contents(complete)


def test_a_killed_generation_is_completed_with_the_same_bytes(complete: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        make_data(StandIn(killed_at=1), folder)
    assert [path.name for path in clips_of(folder)] == ["000-walk"]
    # What a process that had no time to tidy up leaves behind.
    scrap = folder / ".001-turn.abcd" / "new" / "views"
    scrap.mkdir(parents=True)
    before = (folder / "000-walk" / TRUTH_FILE).stat().st_mtime_ns
    make_data(StandIn(), folder)
    assert (folder / "000-walk" / TRUTH_FILE).stat().st_mtime_ns == before
    assert contents(folder) == contents(complete)


def test_a_folder_of_something_else_is_not_touched(complete: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another data set"):
        make_data(StandIn(2), complete)
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(InputError, match="not empty"):
        make_data(StandIn(), tmp_path)
    with pytest.raises(InputError, match="no data set"):
        clips_of(tmp_path)


def test_the_truth_has_the_agreed_keys_and_comes_back(complete: Path) -> None:
    path = complete / "002-walk" / TRUTH_FILE
    with np.load(path) as arrays:
        assert {"body_positions", "body_faces", "garment_positions", "garment_faces"} <= set(arrays)
        assert {"fps", "K", "R", "t", "landmarks"} <= set(arrays)
        assert arrays["body_positions"].shape == (2, len(PILLAR.vertices), 3)
    loaded, made = Truth.load(path), StandIn().truth(PlannedClip(2, "walk", 0))
    assert loaded.garment_positions == pytest.approx(made.garment_positions, abs=1e-7)
    assert loaded.fps == 25.0


def test_images_masks_and_landmarks_agree_with_the_truth(complete: Path) -> None:
    clip = complete / "000-walk"
    truth, recording = Truth.load(clip / TRUTH_FILE), load_multi_view(clip)
    assert len(recording.views) == 3
    body, garment = torch.from_numpy(truth.body_positions), torch.from_numpy(truth.garment_positions)
    faces = torch.from_numpy(np.concatenate((truth.body_faces, truth.garment_faces + body.shape[1])))
    masks = [torch.stack([view.mask(f) for f in range(2)]) for view in recording.views]
    everything = torch.cat((body, garment), 1)
    assert overlap_in_views(WarpRenderer(), recording.cameras, masks, everything, faces).values.min() > 0.99
    for view in recording.views:
        cloth, person = view.garment_mask(1) > 0.5, view.mask(1) > 0.5
        assert 0.3 < float((cloth & person).sum() / person.sum()) < 0.9
        # The middle of the picture is the garment's, and drawn in other colours than what is around it.
        middle = tuple(view.camera.project(garment[1].mean(0)).long().tolist())[::-1]
        assert cloth[middle]
        assert (view.frame(0) - view.frame(1)).abs()[~person].max() < 0.5
    marks = recording.landmarks(["middle"])
    exact = torch.stack([c.project(torch.from_numpy(truth.landmarks[:, :1])) for c in recording.cameras])
    torch.testing.assert_close(marks[..., :2], exact.float(), atol=1e-3, rtol=0)


def test_landmark_noise_has_the_deviation_that_was_asked_for() -> None:
    points = np.tile([0.0, 0.5, 0.0], (2000, 1, 1))
    camera = RING.cameras()[0]
    found = detected(points, camera, LandmarkNoise(20.0, 0.25), np.random.default_rng(0))
    seen = found[found[..., 2] > 0]
    assert len(seen) == pytest.approx(1500, abs=60)
    assert seen[:, 0].std() == pytest.approx(0.02 * 48, rel=0.06)
    assert not found[found[..., 2] == 0].any()


def test_truth_that_does_not_fit_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Truth is missing"):
        Truth.load(tmp_path / "none.npz")
    np.savez(
        tmp_path / "bad.npz",
        body_positions=np.zeros((2, 3, 3)),
        body_faces=np.array([[0, 1, 5]]),
        garment_positions=np.zeros((2, 3, 3)),
        garment_faces=np.array([[0, 1, 2]]),
    )
    with pytest.raises(InputError, match="body"):
        Truth.load(tmp_path / "bad.npz")


def test_another_mesh_of_the_same_name_is_another_data_set(tmp_path: Path) -> None:
    """What was begun with one garment was completed with another."""
    file, renderer = tmp_path / "skirt.obj", WarpRenderer()
    domain = OwnDomain(CaptureSettings(), OwnMesh(str(file)), renderer)
    found = []
    for content in ("v 0 0 0", "v 0 0 1", "v 0 0 0"):
        file.write_text(content)
        found.append(domain._digests())
    assert found[0] == found[2] != found[1]
    assert set(found[0]) == {"garment_file"}
