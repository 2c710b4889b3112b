"""Commands as a user calls them, in an empty folder with one tiny scene and one run."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from toile.cli.configuration import CONF, register_resolvers, resolved_yaml
from toile.cli.main import main
from toile.reports.run_folder import RunFolder, create_run_folder, write_config, write_trajectory
from toile.scenes.native import write_native
from toile.scenes.scene import Scene

N_FRAMES = 3


class Outcome(NamedTuple):
    """What a command left behind."""

    status: int
    out: str
    err: str


Toile = Callable[..., Outcome]


@pytest.fixture
def toile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterator[Toile]:
    """Run ``toile ...`` in ``tmp_path``, whose folder data/ is the data folder; never a traceback."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TOILE_DATA", raising=False)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    # Lines that a slow machine would get and a quick one not.
    monkeypatch.setattr("toile.progress.SECONDS_BETWEEN_LINES", math.inf)

    def call(*arguments: str) -> Outcome:
        capsys.readouterr()
        status = main(arguments)
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return Outcome(status, out, err)

    yield call
    for handler in logging.getLogger().handlers[:]:
        # Hydra's handlers write to this test's captured stderr.
        if type(handler) in (logging.StreamHandler, logging.FileHandler):
            logging.getLogger().removeHandler(handler)
            handler.close()


@pytest.fixture
def scene_folder(tiny_scene: Scene, tmp_path: Path) -> Path:
    """The scene "tiny" in the data folder."""
    return write_native(tiny_scene, tmp_path / "data" / "made" / "tiny")


@pytest.fixture
def run_folder(tiny_scene: Scene, scene_folder: Path, tmp_path: Path) -> RunFolder:
    """A run on the first frames of "tiny" that is 1 mm off in depth."""
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("fit", ["scene=native", "scene.name=tiny", f"scene.n_frames={N_FRAMES}"])
    assert tiny_scene.ground_truth is not None
    assert tiny_scene.ground_truth.vertices is not None
    run = create_run_folder(tmp_path / "run")
    positions = tiny_scene.ground_truth.vertices[:N_FRAMES].numpy().copy()
    positions[..., 2] += 0.001
    write_trajectory(run, positions, fps=25.0, parameters={"areal density [kg/m²]": 0.15})
    # Resolved on another machine, where the data was elsewhere.
    scene = resolved_yaml(OmegaConf.masked_copy(cfg, ["scene", "paths"]))
    write_config(run, scene.replace("data_dir: data", "data_dir: /elsewhere"))
    return run
