"""Frames as networks see them, and networks on disk."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from toile.capture.losses.silhouette import distance_field
from toile.capture.prediction import predict
from toile.capture.training.frames import Augmentation, TrainingSet, camera_frames
from toile.capture.training.weights import Networks, load_networks
from toile.errors import InputError

from .conftest import SIDE


def test_crops_hold_the_person_and_nothing_else(training_set: TrainingSet) -> None:
    recording = training_set.clips[0].recording
    frames = camera_frames(recording, 1, training_set.subject.landmark_names, SIDE)
    assert frames.images.shape == (5, 4, SIDE, SIDE)
    assert frames.camera == recording.cameras[1]
    left, top, size = frames.boxes[2].tolist()
    rows, columns = (recording.views[1].mask(2) > 0.5).nonzero().T
    assert left <= int(columns.min())
    assert int(columns.max()) < left + size
    assert top <= int(rows.min())
    assert int(rows.max()) < top + size
    # The corners show no background, and the garment is a part of the person.
    assert float(frames.images[:, :3, 0, 0].max()) == 0
    assert 0.02 < float(frames.images[:, 3].mean()) < 0.5
    first = training_set.batch([training_set.draw(1, 1, np.random.default_rng(0))[0][0]])
    assert first.images.shape == (1, 4, SIDE, SIDE)


def test_distances_are_kept_as_they_are_computed(training_set: TrainingSet) -> None:
    view = training_set.clips[0].recording.views[0]
    kept = training_set.clips[0].distances(3)[0]
    assert torch.allclose(kept.double(), distance_field(view.mask(3) > 0.5), atol=1 / 60)


def test_other_images_are_read_again(set_folder: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(set_folder, tmp_path / "copy", ignore=shutil.ignore_patterns("frames"))
    before = TrainingSet.load(copy, SIDE).clips[0].crops.copy()
    image = next((copy / "000-squat" / "views" / "camera0").glob("rgb_000.png"))
    shutil.copyfile(image.with_name("rgb_004.png"), image)
    os.utime(image, ns=(0, 0))
    after = TrainingSet.load(copy, SIDE).clips[0].crops
    assert np.array_equal(before[0, 1:], after[0, 1:])
    assert not np.array_equal(before[0, 0], after[0, 0])


def test_windows_are_consecutive_and_within_their_clip(training_set: TrainingSet) -> None:
    windows = training_set.draw(60, 3, np.random.default_rng(0))
    for window in windows:
        assert [sample.frame - window[0].frame for sample in window] == [0, 1, 2]
        assert len({(sample.clip, sample.camera) for sample in window}) == 1
    assert {window[0].frame for window in windows} == {0, 1, 2}
    assert {window[0].camera for window in windows} == {0, 1}
    with pytest.raises(InputError, match="shorter than a window"):
        training_set.draw(1, 6, np.random.default_rng(0))


def test_one_camera_is_all_that_is_known_of_a_clip(training_set: TrainingSet) -> None:
    alone = training_set.only(1)
    samples = [window[0] for window in alone.draw(5, 1, np.random.default_rng(0))]
    assert {sample.camera for sample in samples} == {1}
    batch = alone.batch(samples)
    assert batch.detections.shape[:2] == (5, 1)
    assert torch.equal(batch.detections[:, 0], training_set.batch(samples).detections[:, 1])
    assert alone.distances(samples).shape[1] == 1
    assert len(alone.rays(samples[0])) == 1
    with pytest.raises(InputError, match="No such camera"):
        training_set.only(2)


def test_augmentation_can_be_the_same_for_a_window() -> None:
    images = torch.rand(1, 4, SIDE, SIDE).expand(3, -1, -1, -1)
    alike = Augmentation()(images, np.random.default_rng(0), alike=True)
    assert torch.equal(alike[0], alike[2])
    different = Augmentation()(images, np.random.default_rng(0))
    assert not torch.allclose(different[0], different[2], atol=1e-3)
    still = Augmentation(0.0, 0.0, 0.0)(images, np.random.default_rng(0))
    assert torch.allclose(still, images, atol=1e-5)


def test_a_person_is_placed_by_what_its_own_camera_saw(training_set: TrainingSet, networks: Networks) -> None:
    """Not by where it truly is: landmarks moved in the image move the person."""
    frames = camera_frames(training_set.clips[0].recording, 0, training_set.subject.landmark_names, SIDE)
    found = predict(networks.pose_net, None, frames, networks.deformation)
    moved = frames.detections + torch.tensor([4.0, 0.0])
    other = predict(
        networks.pose_net,
        None,
        type(frames)(**{**vars(frames), "detections": moved}),
        networks.deformation,
    )
    apart = other.translation - found.translation
    # 4 px at 3 m and a focal length of 88 px: 0.14 m to the camera's right.
    right = frames.camera.R[0]
    assert torch.allclose(apart @ right, torch.full((5,), 4 * 3.0 / frames.camera.fx).double(), rtol=0.25)
    assert torch.equal(other.angles, found.angles)


def test_weights_survive_the_disk(networks: Networks, training_set: TrainingSet, tmp_path: Path) -> None:
    images = torch.rand(2, 4, SIDE, SIDE)
    path = networks.save(tmp_path / "weights.pt", {"seed": "0"})
    back = load_networks(path)
    assert torch.equal(back.pose_net(images)[0], networks.pose_net(images)[0])
    assert back.settings == networks.settings
    assert back.description == {"seed": "0"}
    back.check_belongs(training_set.subject, training_set.garment, "here")
    assert networks.save(tmp_path / "again.pt", {"seed": "0"}).read_bytes() == path.read_bytes()
    small = networks.save(tmp_path / "half.pt", {}, half=True)
    assert networks.save(tmp_path / "half again.pt", {}, half=True).read_bytes() == small.read_bytes()
    assert small.stat().st_size < path.stat().st_size
    assert torch.allclose(load_networks(small).pose_net(images)[0], networks.pose_net(images)[0], atol=0.02)


def test_a_graph_may_have_a_node_for_every_vertex(networks: Networks, tmp_path: Path) -> None:
    settings = replace(networks.settings, nodes=None)
    fine = Networks.new(networks.subject, networks.garment, settings, 0, with_sim_net=True)
    n = len(networks.garment.rest_vertices)
    assert fine.sim_net is not None
    assert fine.sim_net.nodes == n
    back = load_networks(fine.save(tmp_path / "fine.pt", {}))
    assert back.settings.nodes is None
    graph = back.deformation.garment_mesh.graph
    assert graph is not None
    # Every vertex is a node, so that each can go wherever it should.
    assert graph.vertices.sort().values.tolist() == list(range(n))
    weights = torch.zeros(n, n, dtype=torch.float64).scatter_add(1, graph.indices, graph.weights)
    assert int(torch.linalg.matrix_rank(weights)) == n
    with pytest.raises(InputError, match="one piece has no number of nodes"):
        replace(settings, one_piece=True)


def test_weights_that_are_none_are_refused(networks: Networks, tmp_path: Path) -> None:
    path = networks.save(tmp_path / "weights.pt", {})
    content = torch.load(path, weights_only=True)
    weights = content["pose_net"]

    def stored(**changes: object) -> Path:
        place = tmp_path / f"{len(list(tmp_path.iterdir()))}.pt"
        torch.save({**content, **changes}, place)
        return place

    (tmp_path / "torn.pt").write_bytes(path.read_bytes()[:1000])
    cases = (
        (tmp_path / "nothing.pt", "No weights"),
        (tmp_path / "torn.pt", "cannot be used"),
        (stored(format="other"), "format other"),
        (stored(pose_net={k: v for k, v in weights.items() if "head" not in k}), "head"),
        (stored(pose_net={k: v * np.nan for k, v in weights.items()}), "not finite"),
        (stored(subject=torch.zeros(3, dtype=torch.uint8)), "cannot be used"),
        (stored(settings={"nodes": 8}), "cannot be used"),
    )
    for file, message in cases:
        with pytest.raises(InputError) as caught:
            load_networks(file)
        assert message in str(caught.value)
