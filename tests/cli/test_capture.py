"""``toile capture``: a tiny data set of the real subject, its page and its export."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from toile.capture.body.subject import Subject
from toile.capture.garments import Garment
from toile.capture.networks.backbone import BackboneSettings
from toile.capture.prediction import Prediction
from toile.capture.training.weights import Networks, NetworkSettings
from toile.cli.configuration import CONF, register_resolvers
from toile.scenes.multi_view import load_multi_view

TINY = (
    "preset=demo",
    "folder=set",
    "garment.vertices=210",
    "settings.motions=[squat]",
    "settings.n_frames=3",
    "settings.world.vertices=1.1",
    "settings.world.substeps=2",
    "settings.ring.views=2",
    "settings.ring.side=32",
)


def test_data_page_and_export_of_the_default_subject(toile) -> None:
    made = toile("capture", "data", *TINY)
    assert made.status == 0, made.err
    assert made.out.strip().endswith("set")
    clip = Path("set/000-squat")
    with np.load(clip / "truth.npz") as truth:
        F, V, _ = truth["body_positions"].shape
        assert F == 3
        assert truth["body_faces"].max() < V
        assert truth["garment_positions"].shape[1] > truth["model_positions"].shape[1] > 180
        assert truth["converged"].all()
        # The model's vertices lie on the finer garment.
        assert abs(truth["model_positions"][0, :, 1].max() - truth["garment_positions"][0, :, 1].max()) < 0.01
    recording = load_multi_view(clip)
    assert recording.landmarks(["left_knee", "nose"]).shape == (2, 3, 2, 3)
    before = (clip / "truth.npz").stat().st_mtime_ns
    assert toile("capture", "data", *TINY).status == 0
    assert (clip / "truth.npz").stat().st_mtime_ns == before

    shown = toile("capture", "page", "run=set")
    assert shown.status == 0, shown.err
    assert "novel view" in (clip / "index.html").read_text()
    exported = toile("capture", "export", "run=set/000-squat")
    assert exported.status == 0, exported.err
    assert (clip / "motion.glb").read_bytes()[:4] == b"glTF"

    other = toile("capture", "data", *TINY, "settings.seed=1")
    assert other.status == 2
    assert "another settings" in other.err


def test_run_with_untrained_networks(toile) -> None:
    """Networks that know nothing leave the person at rest; files, measures and what is refused."""
    assert toile("capture", "data", *TINY).status == 0
    subject, garment = Subject.load("set/subject.npz"), Garment.load("set/garment.npz")
    settings = NetworkSettings(BackboneSettings(width=0.125, side=32, grid=1), nodes=8)
    networks = Networks.new(subject, garment, settings, seed=0, with_sim_net=True)
    networks.save("weights.pt", {"command": "none"})
    run = ("capture", "run", "run=set", "weights=weights.pt", "result=out", "view=1")
    made = toile(*run)
    assert made.status == 0, made.err
    place = Path("out/000-squat")
    found = Prediction.load(place / "prediction.npz")
    assert len(found) == 3
    assert found.camera == load_multi_view("set/000-squat").cameras[1]
    assert "reconstruction over it" in (place / "index.html").read_text()
    assert (place / "motion.glb").read_bytes()[:4] == b"glTF"
    measures = json.loads((place / "measures.json").read_text())
    assert (
        measures["after_resolution"]["penetration_max_mm"]
        <= measures["before_resolution"]["penetration_max_mm"]
    )
    assert 0 < measures["after_resolution"]["mpjpe_mm"] < 1000
    first = (place / "prediction.npz").read_bytes()
    assert toile(*run).status == 0
    assert (place / "prediction.npz").read_bytes() == first

    views = Path("set/000-squat/views/camera0")
    for name, stem in (("frames", "rgb"), ("masks/person", "mask"), ("masks/garment", "garment_mask")):
        Path(name).mkdir(parents=True)
        for file in views.glob(f"{stem}_*.png"):
            shutil.copy(file, Path(name) / file.name)
    own = ("capture", "run", "video=frames", "weights=weights.pt", "result=mine")
    refused = toile(*own)
    assert refused.status == 2
    assert "masks" in refused.err
    made = toile(*own, "fps=30", "masks=masks", f"landmarks={views / 'landmarks.npy'}")
    assert made.status == 0, made.err
    assert Path("mine/index.html").is_file()
    assert not Path("mine/measures.json").exists()


def test_bad_input_is_named(toile) -> None:
    for arguments, message in (
        (("capture", "dance"), "No such action"),
        (("capture", "data", "settings.ring.views=0"), "views"),
        (("capture", "data", "settings.motions=[moonwalk]", "folder=x"), "Unknown motion"),
        (("capture", "data", "settings.subject=nobody", "folder=y"), "No such subject"),
        (("capture", "page", "run=nowhere"), "no data set"),
        (("capture", "export", "run=nowhere"), "no data set"),
        (("capture", "run", "run=nowhere", "weights=nothing.pt"), "No weights"),
        (("capture", "run", "finish.smoothing.frames=4"), "odd"),
    ):
        outcome = toile(*arguments)
        assert outcome.status == 2, arguments
        assert message in outcome.err, arguments


def test_what_is_wrong_is_said_before_anything_is_written(toile) -> None:
    assert toile("capture", "data", "settings.subject=nobody", "folder=x").status == 2
    assert not Path("x").exists()


def test_presets_grow() -> None:
    register_resolvers()
    images = []
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for preset in ("demo", "standard", "paper"):
            s = compose("capture", [f"capture={preset}", "action=data"]).settings
            images.append(len(s.motions) * s.repetitions * s.n_frames * s.ring.views)
    assert images == sorted(set(images))
