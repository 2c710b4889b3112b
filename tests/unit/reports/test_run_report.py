"""What a run folder says on its page."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from toile.errors import InputError
from toile.evaluation.evaluate import evaluate
from toile.rendering.reference import ReferenceRenderer
from toile.reports.run_folder import (
    RunFolder,
    create_run_folder,
    write_config,
    write_history,
    write_metrics,
    write_trajectory,
)
from toile.reports.run_report import SCENE_WARNINGS, result_page
from toile.scenes.scene import Scene

TRACKING = """
optimization:
  _target_: toile.reconstruction.gauss_newton.recipe.TrackingRecipe
  stages: {track: {priors: {turbulence: 10.0, stiffness: 0.05}}}
"""


@pytest.fixture
def run(tiny_scene: Scene, tmp_path: Path) -> RunFolder:
    assert tiny_scene.ground_truth is not None
    assert tiny_scene.ground_truth.vertices is not None
    folder = create_run_folder(tmp_path / "run")
    write_trajectory(folder, tiny_scene.ground_truth.vertices.numpy(), fps=tiny_scene.fps)
    return folder


def numbers(scene: Scene, **more: object) -> dict:
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    return {**evaluate(scene.ground_truth.vertices, scene).to_dict(), **more}


def test_warnings_of_the_scene_are_those_of_metrics_json(run: RunFolder, tiny_scene: Scene) -> None:
    write_metrics(run, numbers(tiny_scene, **{SCENE_WARNINGS: ["Mask 2 <flickers>.", "No intrinsics."]}))
    text = result_page(run, tiny_scene, ReferenceRenderer(), 1).render()
    assert "<p>Mask 2 &lt;flickers&gt;.</p><p>No intrinsics.</p>" in text[: text.index("</header>")]
    write_metrics(run, numbers(tiny_scene))
    assert result_page(run, tiny_scene, ReferenceRenderer(), 1).warnings == []


def test_warnings_that_are_none(run: RunFolder, tiny_scene: Scene) -> None:
    write_metrics(run, numbers(tiny_scene, **{SCENE_WARNINGS: "one"}))
    with pytest.raises(InputError, match="list of sentences"):
        result_page(run, tiny_scene, ReferenceRenderer(), 1)


def test_stiffness_of_the_stored_recipe(run: RunFolder, tiny_scene: Scene) -> None:
    assert result_page(run, tiny_scene, ReferenceRenderer(), 1).stiffness_note == ""
    write_config(run, TRACKING)
    assert "no measurement" in result_page(run, tiny_scene, ReferenceRenderer(), 1).stiffness_note


def test_losses_are_drawn_per_frame_where_that_is_known(run: RunFolder, tiny_scene: Scene) -> None:
    history = pd.DataFrame({"cycle": [0, 1], "loss": [2.0, 9.0], "loss colour": [1.0, 1.0]})
    write_history(run, history)
    assert result_page(run, tiny_scene, ReferenceRenderer(), 1).loss_columns == ["loss", "loss colour"]
    write_history(run, history.assign(**{"loss per frame": [2.0, 1.5]}))
    drawn = result_page(run, tiny_scene, ReferenceRenderer(), 1).loss_columns
    assert sorted(drawn) == ["loss colour", "loss per frame"]
