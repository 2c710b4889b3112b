from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, Metric, evaluate
from toile.evaluation.out_of_balance import out_of_balance_force
from toile.geometry.mesh import grid_faces, sample_surface
from toile.rendering.base import Renderer
from toile.scenes.scene import Scene

MakeScene = Callable[..., Scene]


def still(scene: Scene) -> Tensor:
    return scene.template.expand(scene.n_frames, -1, -1, -1).clone()


def clouds(scene: Scene, n: int = 1500) -> tuple[Tensor, ...]:
    vertices, faces = scene.template.reshape(-1, 3), grid_faces(*scene.grid)
    return tuple(
        sample_surface(vertices, faces, n + f, torch.Generator().manual_seed(100 + f)).float()
        for f in range(scene.n_frames)
    )


def test_cloud_scene_has_all_cloud_metrics(make_scene: MakeScene, box_renderer: Renderer) -> None:
    scene = make_scene(point_clouds=clouds(make_scene()))
    moved = still(scene)
    moved[2, ..., 2] += 0.02
    result = evaluate(moved, scene, box_renderer)
    assert list(result.metrics) == [
        "chamfer",
        "chamfer_l1",
        "point_to_surface",
        "normal_error",
        "depth_error",
        "depth_coverage",
        "silhouette_iou",
    ]
    chamfer = result.metrics["chamfer"].per_frame
    assert chamfer[2] - chamfer[0] == pytest.approx(1e4 * 2 * 0.02**2, rel=0.05)
    assert result.metrics["point_to_surface"].per_frame.tolist() == pytest.approx([0, 0, 20], abs=1e-3)
    assert result.metrics["depth_error"].per_frame.tolist() == pytest.approx([0, 0, 20], abs=1e-3)
    # 20 mm further away, the 40 px square shrinks to 40 / 1.02 px, which rounds to 39 or 40.
    assert result.metrics["silhouette_iou"].per_frame[:2].tolist() == [1.0, 1.0]
    assert result.mean("normal_error") == pytest.approx(0.0, abs=0.01)
    assert result.metrics["chamfer"].worst_frame == 2
    assert set(result.skipped) == {"vertex_error", "out_of_balance"}


def test_vertex_scene_has_vertex_metrics_and_chamfer_of_the_true_mesh(
    make_scene: MakeScene, box_renderer: Renderer
) -> None:
    scene = make_scene(vertices=still(make_scene()))
    moved = still(scene)
    moved[..., 2] += 0.01
    result = evaluate(moved, scene, box_renderer)
    assert result.mean("vertex_error") == pytest.approx(10.0)
    assert result.mean("vertex_error_percent") == pytest.approx(2.5)
    assert result.mean("depth_error") == pytest.approx(10.0, abs=1e-3)
    assert result.mean("normal_error") == pytest.approx(0.0, abs=1e-9)
    assert result.mean("chamfer") == pytest.approx(2.0, rel=0.05)
    assert "samples of the true mesh" in result.metrics["chamfer"].protocol


def test_the_width_is_the_upper_side(make_scene: MakeScene) -> None:
    """Axis 0 runs along it, also where the cloth is not square."""
    square = make_scene(vertices=still(make_scene()))
    scene = replace(square, cloth_size=(0.9, 0.3))
    moved = still(scene)
    moved[..., 2] += 0.000771
    result = evaluate(moved, scene)
    assert result.mean("vertex_error") == pytest.approx(0.771)
    assert result.mean("vertex_error_percent") == pytest.approx(100 * 0.000771 / 0.9)
    assert "axis 0" in result.metrics["vertex_error_percent"].protocol


def test_samples_of_truth_and_reconstruction_are_independent(make_scene: MakeScene) -> None:
    scene = make_scene(vertices=still(make_scene()))
    assert evaluate(still(scene), scene).mean("chamfer") > 0.0


def test_without_ground_truth_only_the_silhouette_remains(
    make_scene: MakeScene, box_renderer: Renderer
) -> None:
    scene = make_scene()
    result = evaluate(still(scene), scene, box_renderer)
    assert list(result.metrics) == ["silhouette_iou"]
    assert result.mean("silhouette_iou") == 1.0
    assert result.skipped["chamfer"] == "the scene has no ground truth"
    assert evaluate(still(scene), scene).metrics == {}


def test_same_seed_gives_the_same_numbers(make_scene: MakeScene) -> None:
    scene = make_scene(point_clouds=clouds(make_scene()))
    first, again = evaluate(still(scene), scene, seed=7), evaluate(still(scene), scene, seed=7)
    assert first.to_dict() == again.to_dict()
    assert evaluate(still(scene), scene, seed=8).mean("chamfer") != first.mean("chamfer")


def test_first_frames_only_is_said_in_the_protocol(make_scene: MakeScene) -> None:
    scene = make_scene(point_clouds=clouds(make_scene()))
    full, part = evaluate(still(scene), scene), evaluate(still(scene)[:2], scene, n_frames=2)
    assert part.n_frames == 2
    assert part.metrics["chamfer"].protocol.endswith("first 2 of 3 frames only")
    assert part.metrics["chamfer"].per_frame.tolist() == full.metrics["chamfer"].per_frame[:2].tolist()


def test_out_of_balance_force_is_reported(make_scene: MakeScene) -> None:
    scene = make_scene()
    masses = torch.full(scene.grid, 1e-3, dtype=torch.float64)
    force = out_of_balance_force(
        still(scene),
        masses=masses,
        internal_forces=torch.zeros_like,
        external_forces=masses[..., None] * scene.gravity,
        frame_time=1 / scene.fps,
        gravity=scene.gravity,
    )
    result = evaluate(still(scene), scene, out_of_balance=force)
    assert result.mean("out_of_balance") == pytest.approx(1.0)
    assert "Newton" not in result.skipped.get("out_of_balance", "")
    with pytest.raises(InputError, match="another trajectory"):
        evaluate(still(scene)[:2], scene, n_frames=2, out_of_balance=force)


def test_dictionary_survives_json_with_nan(make_scene: MakeScene) -> None:
    metric = Metric("depth_error", "Depth error", "mm", "protocol", np.array([1.0, math.nan, 3.0]))
    nothing = Metric("empty", "Empty", "", "protocol", np.array([math.nan] * 3), higher_is_better=True)
    result = EvaluationResult("s", 3, 4, {"depth_error": metric, "empty": nothing}, {"chamfer": "why"})
    text = json.dumps(result.to_dict(), allow_nan=False)
    back = EvaluationResult.from_dict(json.loads(text))
    assert back.to_dict() == result.to_dict()
    assert back.mean("depth_error") == 2.0
    assert back.metrics["depth_error"].worst_frame == 2
    assert back.metrics["empty"].worst_frame is None
    assert json.loads(text)["metrics"]["empty"]["mean"] is None
    with pytest.raises(InputError, match="KeyError"):
        EvaluationResult.from_dict({"metrics": {}})


def test_tables_carry_units_protocol_and_mean(make_scene: MakeScene) -> None:
    scene = make_scene(point_clouds=clouds(make_scene()))
    result = evaluate(still(scene), scene)
    table = result.per_frame_table()
    assert list(table.index) == ["0", "1", "2", "mean"]
    assert table.loc["mean", "chamfer [×10⁻⁴ m²]"] == pytest.approx(result.mean("chamfer"))
    summary = result.summary_table()
    assert "Eq. 18" in summary.loc["chamfer", "protocol"]
    assert summary.loc["point_to_surface", "unit"] == "mm"


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x[:2],
        lambda x: x.reshape(3, 64, 3),
        lambda x: x[:, :4],
        lambda x: torch.where(x > 0.1, float("nan"), x),
    ],
    ids=["frames", "flat", "grid", "nan"],
)
def test_trajectory_that_does_not_fit_raises(
    make_scene: MakeScene, change: Callable[[Tensor], Tensor]
) -> None:
    scene = make_scene()
    with pytest.raises(InputError, match="trajectory"):
        evaluate(change(still(scene)), scene)


def test_too_short_ground_truth_raises(make_scene: MakeScene) -> None:
    scene = make_scene(point_clouds=clouds(make_scene())[:2])
    with pytest.raises(InputError, match="too few frames"):
        evaluate(still(scene), scene)
