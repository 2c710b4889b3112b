"""A tiny data set: the person that comes with the package, five frames of a squat, two small cameras."""

from __future__ import annotations

from pathlib import Path

import pytest

from toile.capture.data.filming import CameraRing
from toile.capture.data.making import make_data
from toile.capture.data.own import CaptureSettings, OwnDomain, TrueWorld
from toile.capture.garments.patterns import SkirtPattern
from toile.capture.networks.backbone import BackboneSettings
from toile.capture.training.frames import TrainingSet
from toile.capture.training.weights import Networks, NetworkSettings
from toile.rendering.warp.renderer import WarpRenderer

SIDE = 32


@pytest.fixture(scope="session")
def set_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = CaptureSettings(
        motions=("squat",),
        n_frames=5,
        world=TrueWorld(vertices=1.1, substeps=1, least_converged=0.0),
        ring=CameraRing(views=2, side=64),
    )
    domain = OwnDomain(settings, SkirtPattern(vertices=210), WarpRenderer(1))
    return make_data(domain, tmp_path_factory.mktemp("capture") / "set")


@pytest.fixture(scope="session")
def training_set(set_folder: Path) -> TrainingSet:
    return TrainingSet.load(set_folder, SIDE)


@pytest.fixture
def networks(training_set: TrainingSet) -> Networks:
    settings = NetworkSettings(BackboneSettings(width=0.125, side=SIDE, grid=1), nodes=8)
    return Networks.new(training_set.subject, training_set.garment, settings, seed=0, with_sim_net=True)
