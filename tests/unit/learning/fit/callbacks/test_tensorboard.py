"""What a fit sends to TensorBoard, read back."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout

from toile.learning.fit.callbacks.chamfer import ChamferLogger
from toile.learning.fit.callbacks.layout import DashboardLayout
from toile.learning.fit.callbacks.tensorboard import PICTURES, PictureLogger, silhouettes
from toile.learning.fit.module import CyclesOfFit, FitModule
from toile.reconstruction.adam import SuccessiveFramesAdam
from toile.reconstruction.problem import Reconstruction

MakeProblem = Callable[[], Reconstruction]
MakeAdam = Callable[..., SuccessiveFramesAdam]


def events(problem: Reconstruction, recipe: SuccessiveFramesAdam, folder: Path) -> EventAccumulator:
    """Fit with everything that logs, and read the events."""
    module = FitModule(problem, recipe, 0)
    callbacks: list[Any] = [
        ChamferLogger(folder / "chamfer.csv", every=2, frames=None, seed=0),
        PictureLogger(every=2, frames=2, error_scale=10.0),
        DashboardLayout(),
    ]
    trainer = Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=1,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        logger=TensorBoardLogger(folder, name="", version=""),
        log_every_n_steps=1,
        callbacks=callbacks,
    )
    trainer.fit(module, datamodule=CyclesOfFit(module), weights_only=True)
    found = EventAccumulator(str(folder), size_guidance={"tensors": 0, "images": 0})
    found.Reload()
    return found


def layout(found: EventAccumulator) -> Layout:
    tensor = found.Tensors("custom_scalars__config__")[0].tensor_proto
    return Layout.FromString(tensor.string_val[0])


def test_every_curve_of_the_layout_exists(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    found = events(problem(), adam(cycles=3), tmp_path)
    charts = {c.title: list(c.multiline.tag) for group in layout(found).category for c in group.chart}
    scalars = found.Tags()["scalars"]
    for title, patterns in charts.items():
        for pattern in patterns:
            # TensorBoard searches with re.match.
            assert len([tag for tag in scalars if re.match(pattern, tag)]) == 1, f"{title}: {pattern}"
    drawn = {tag for patterns in charts.values() for p in patterns for tag in scalars if re.match(p, tag)}
    assert drawn == set(scalars)
    titles = [group.title for group in layout(found).category]
    assert titles == ["fit", "stiffness, network units", "forces", "work"]
    assert len(charts["wind x, y, z [m/s²]"]) == 3
    assert [e.step for e in found.Scalars("accuracy/chamfer_x1e4_m2")] == [1, 2]


def test_pictures_and_meshes_of_the_frames_covered(
    problem: MakeProblem, adam: MakeAdam, tmp_path: Path
) -> None:
    found = events(problem(), adam(cycles=7), tmp_path)
    # Frame 4 is first covered in the last cycle.
    assert {tag: [e.step for e in found.Images(tag)] for tag in found.Tags()["images"]} == {
        f"{PICTURES}/frame 002": [1, 3, 5, 6],
        f"{PICTURES}/frame 004": [6],
    }
    image = found.Images(f"{PICTURES}/frame 004")[0]
    assert (image.height, image.width) == (64, 4 * 64)
    tensors = found.Tags()["tensors"]
    meshes = [tag for tag in tensors if re.fullmatch(r"mesh, .*10 mm.*/frame 002_(VERTEX|FACE|COLOR)", tag)]
    assert len(meshes) == 3
    assert len(found.Tensors(meshes[0])) == 4
    assert len(found.Tensors("ground truth/frame 002_VERTEX")) == 1


def test_without_ground_truth(problem: MakeProblem, adam: MakeAdam, tmp_path: Path) -> None:
    unknown = problem()
    unknown.scene = dataclasses.replace(unknown.scene, ground_truth=None)
    found = events(unknown, adam(cycles=2), tmp_path)
    assert not [c.title for group in layout(found).category for c in group.chart if "Chamfer" in c.title]
    assert not [tag for tag in found.Tags()["scalars"] if "chamfer" in tag]
    kinds = {tag.partition("/")[0] for tag in found.Tags()["tensors"]} - {"custom_scalars__config__"}
    assert kinds == {"mesh"}


def test_silhouettes_tell_observed_from_rendered() -> None:
    observed, rendered = torch.tensor([[1.0, 1.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 1.0, 0.0]])
    both, missed, added, neither = silhouettes(observed, rendered)[0]
    assert neither.tolist() == [1, 1, 1]
    assert both.tolist() == pytest.approx([0.8] * 3)
    assert missed[0] > missed[2]
    assert added[2] > added[0]
