from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest

from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.reports import figures


@pytest.fixture
def result() -> EvaluationResult:
    chamfer = Metric("chamfer", "Squared Chamfer distance", "×10⁻⁴ m²", "p", np.array([1.0, 2.0, 6.0]))
    iou = Metric("silhouette_iou", "Silhouette IoU", "", "p", np.array([1.0, np.nan, 0.9]), True)
    empty = Metric("depth_error", "Depth error", "mm", "p", np.full(3, np.nan))
    return EvaluationResult("s", 3, 0, {m.key: m for m in (chamfer, iou, empty)})


@pytest.fixture
def history() -> pd.DataFrame:
    return pd.DataFrame(
        {"cycle": [0, 5, 10], "loss": [1.0, 0.1, 0.0], "loss/image": 0.5, "Y": [1e3, 2e3, 3e3]}
    )


def test_error_panels_show_values_mean_and_unit(result: EvaluationResult) -> None:
    axes = figures.error_over_frames(result).axes
    assert [a.get_title(loc="left") for a in axes] == ["Squared Chamfer distance", "Silhouette IoU"]
    assert axes[0].get_title(loc="right") == "mean 3 ×10⁻⁴ m²"
    assert axes[0].get_ylabel() == "×10⁻⁴ m²"
    assert axes[0].get_xlabel() == "frame"
    assert np.array_equal(axes[0].lines[0].get_ydata(), [1.0, 2.0, 6.0])
    assert axes[0].get_ylim()[0] == 0.0


def test_histories_are_drawn_over_the_cycles(history: pd.DataFrame) -> None:
    (axis,) = figures.parameter_histories(history, {"Y": "N/m"}).axes
    assert np.array_equal(axis.lines[0].get_xdata(), [0, 5, 10])
    assert axis.get_title(loc="right") == "last 3000 N/m"
    (axis,) = figures.loss_curves(history).axes
    assert axis.get_yscale() == "log"
    assert [line.get_label() for line in axis.lines] == ["loss", "loss/image"]


def test_stability_marks_the_usual_length() -> None:
    lengths, distances = np.array([0.5, 1.0, 40.0]), np.array([3.0, 2.0, 2.5])
    (axis,) = figures.stability_curves({"a recipe": (lengths, distances)}, "a scene").axes
    curve, mark = axis.lines
    assert np.array_equal(curve.get_xdata(), lengths)
    assert np.array_equal(curve.get_ydata(), distances)
    assert list(mark.get_xdata()) == [1, 1]
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    labels = dict(zip(axis.get_xticks(), [t.get_text() for t in axis.get_xticklabels()], strict=True))
    assert (labels[1], labels[40]) == ("usual length", "40×")
    with pytest.raises(InputError, match="at least one curve"):
        figures.stability_curves({}, "a scene")


def test_side_view_plots_depth_against_height() -> None:
    positions = np.zeros((2, 3, 3, 3))
    positions[..., 1], positions[..., 2] = 0.25, 1.5
    figure = figures.side_view(positions, [0, 1], [np.array([[9.0, 0.25, 1.5]])] * 2)
    axis = figure.axes[1]
    assert axis.get_title(loc="left") == "frame 1"
    assert np.array_equal(axis.lines[0].get_xdata(), [1.5] * 3)
    assert np.array_equal(axis.lines[0].get_ydata(), [-0.25] * 3)
    assert axis.collections[0].get_offsets().tolist() == [[1.5, -0.25]]


def test_figures_are_written_as_pictures(
    result: EvaluationResult, history: pd.DataFrame, tmp_path: Path
) -> None:
    drawn = {
        "errors": figures.error_over_frames(result),
        "parameters": figures.parameter_histories(history, {"Y": "N/m"}),
        "losses": figures.loss_curves(history),
        "side": figures.side_view(np.random.default_rng(0).normal(size=(2, 4, 4, 3)), [0, 1]),
    }
    for name, figure in drawn.items():
        picture = iio.imread(figures.save_figure(figure, tmp_path / f"{name}.png", dpi=50))
        assert picture.std() > 0
    assert sorted(p.stem for p in tmp_path.iterdir()) == sorted(drawn)


def test_what_cannot_be_drawn_is_named(result: EvaluationResult, history: pd.DataFrame) -> None:
    with pytest.raises(InputError, match="nonsense"):
        figures.error_over_frames(result, ["nonsense"])
    with pytest.raises(InputError, match="bending"):
        figures.parameter_histories(history, {"bending": ""})
    with pytest.raises(InputError, match="nothing to draw"):
        figures.loss_curves(history[["Y"]])
    with pytest.raises(InputError, match="frames from 0 to 1"):
        figures.side_view(np.zeros((2, 3, 3, 3)), [2])
