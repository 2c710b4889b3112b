from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.reports.html import PagePicture, ReportedParameter, ResultPage, write_result_page
from toile.reports.playback import distance_to_points, playback


def positions() -> np.ndarray:
    rng = np.random.default_rng(0)
    v, u = np.meshgrid(np.linspace(0, 0.5, 5), np.linspace(0, 0.5, 6), indexing="ij")
    return np.stack((u, v, np.ones_like(u)), -1) + 0.01 * rng.normal(size=(3, 5, 6, 3))


@pytest.fixture
def page() -> ResultPage:
    chamfer = Metric(
        "chamfer", "Squared Chamfer distance", "×10⁻⁴ m²", "unaligned, Eq. 18", np.array([1, 2, 6.0])
    )
    depth = Metric("depth_error", "Depth error", "mm", "rendered", np.array([1.0, math.nan, 2.0]))
    return ResultPage(
        scene="R1 <draft>",
        positions=positions(),
        fps=25.0,
        evaluation=EvaluationResult(
            "R1", 3, 7, {"chamfer": chamfer, "depth_error": depth}, {"iou": "no renderer"}
        ),
        ground_truth=[x.reshape(-1, 3) for x in positions()],
        parameters=[ReportedParameter("stretching stiffness", 2961.2, "N/m", "fitted")],
        history=pd.DataFrame({"cycle": [0, 1], "loss": [1.0, 0.5], "Y": [1.0, 2.0]}),
        history_units={"Y": "N/m"},
        loss_columns=["loss"],
        pictures=[PagePicture("frame 0", np.zeros((4, 6, 3), dtype=np.uint8))],
        facts={"run time": "142 s"},
        config="scene: <R1>\n",
    )


def without_library(text: str) -> str:
    """The page without the inlined plotly.js, which mentions addresses of its own."""
    return re.sub(r"<head>.*?</head>", "", text, flags=re.DOTALL)


def test_opens_with_the_answer_and_its_protocol(page: ResultPage) -> None:
    body = without_library(page.render())
    header = body[: body.index("</header>")]
    assert "3 frames" in header
    assert "<strong>3.00 ×10⁻⁴ m²</strong> against ground truth" in header
    assert "Unaligned, Eq. 18" in header


def test_is_self_contained_and_holds_the_library_once(page: ResultPage) -> None:
    text = page.render()
    assert text.count("plotly.js v") == 1
    assert not re.search(r'(?:src|href)="(?!data:|#)', without_library(text))
    assert "data:image/png;base64," in text


def test_holds_every_part(page: ResultPage) -> None:
    body = without_library(page.render())
    for title in (
        "Motion in 3D",
        "Over the video",
        "Error per frame",
        "All metrics",
        "Parameters",
        "Optimisation",
    ):
        assert f"<h2>{title}</h2>" in body
    assert "not measured: no renderer" in body
    assert "2961" in body
    assert "142 s" in body
    assert "nan" not in re.sub(r"<script.*?</script>", "", body, flags=re.DOTALL).lower()


def test_text_is_escaped(page: ResultPage) -> None:
    body = without_library(page.render())
    assert "R1 &lt;draft&gt;" in body
    assert "<draft>" not in body
    assert "scene: &lt;R1&gt;" in body


def test_without_ground_truth_says_so() -> None:
    body = without_library(ResultPage("S", positions(), 25.0).render())
    assert "no error can be given" in body
    assert "All metrics" not in body
    assert "Motion in 3D" in body


def test_is_reproducible(page: ResultPage, tmp_path: Path) -> None:
    path = write_result_page(page, tmp_path / "index.html")
    assert path.read_text(encoding="utf-8") == dataclasses.replace(page).render()


def test_playback_has_one_frame_per_frame_in_fixed_axes() -> None:
    x = positions()
    truth = [frame.reshape(-1, 3) + np.array([0.0, 0.0, 0.01]) for frame in x]
    figure = playback(x, 25.0, truth)
    assert [f.name for f in figure.frames] == ["0", "1", "2"]
    surface = figure.frames[2].data[0]
    np.testing.assert_allclose(surface.x, x[2, ..., 0], rtol=1e-6)
    np.testing.assert_allclose(surface.y, x[2, ..., 2], rtol=1e-6)
    np.testing.assert_allclose(surface.z, -x[2, ..., 1], atol=1e-7)
    assert np.array(surface.surfacecolor).max() <= 10.0 + 1e-3
    assert figure.layout.scene.yaxis.range[1] > x[..., 2].max()
    assert figure.layout.updatemenus[0].buttons[0].args[1]["frame"]["duration"] == 40.0


def test_distance_to_points_is_per_vertex() -> None:
    x = np.zeros((1, 2, 2, 3))
    x[0, 1, 1, 0] = 3.0
    assert distance_to_points(x, [np.array([[0.0, 4.0, 0.0]])])[0].tolist() == [[4.0, 4.0], [4.0, 5.0]]
