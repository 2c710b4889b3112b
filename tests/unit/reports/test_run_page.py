from __future__ import annotations

import base64
import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.geometry.camera import Camera
from toile.reports.cloth_fields import ClothField
from toile.reports.page.run_page import PagePicture, ReportedParameter, ResultPage, write_result_page
from toile.reports.page.viewer import Video


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
        error=ClothField("error", "Error", "mm", "To the truth.", np.arange(90.0).reshape(3, 5, 6)),
        video=Video(Camera(10, 10, 3, 2, 4, 6), {"observed": [np.zeros((4, 6, 3), dtype=np.uint8)] * 3}),
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
    assert re.search(r"against ground truth: <strong[^>]*>3\.00\s×10⁻⁴ m²</strong>", header)
    assert "Unaligned, Eq. 18" in header


def test_is_self_contained_and_holds_the_library_once(page: ResultPage) -> None:
    text = page.render()
    assert text.count("plotly.js v") == 1
    assert not re.search(r'(?:src|href)="(?!data:|#)', without_library(text))
    assert "data:image/webp;base64," in text


def test_holds_every_part(page: ResultPage) -> None:
    body = without_library(page.render())
    for title in (
        "Error on the cloth",
        "Metrics over time",
        "Stiffness and forces",
        "All metrics",
        "Frames side by side",
        "How it was made",
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
    assert 'id="playback"' in body
    assert "Error on the cloth" not in body


def test_is_reproducible(page: ResultPage, tmp_path: Path) -> None:
    path = write_result_page(page, tmp_path / "index.html")
    assert path.read_text(encoding="utf-8") == dataclasses.replace(page).render()


def viewer_data(page: ResultPage) -> dict:
    found = re.search(r'id="viewer-data">(.*?)</script>', page.render(), flags=re.DOTALL)
    assert found
    return json.loads(found[1])


def decoded(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype="<f4")


def test_viewer_holds_the_whole_motion_and_its_pictures(page: ResultPage) -> None:
    content = viewer_data(page)
    np.testing.assert_allclose(decoded(content["positions"]).reshape(3, 5, 6, 3), positions(), rtol=1e-6)
    assert content["cloud"]["starts"] == [0, 30, 60, 90]
    assert len(content["video"]["pictures"]["observed"]) == 3
    assert (content["frames"], content["rows"], content["columns"], content["fps"]) == (3, 5, 6, 25.0)


def test_text_cannot_leave_the_data_of_the_page(page: ResultPage) -> None:
    hostile = "</script><script>alert(1)</script>"
    assert page.error is not None
    error = dataclasses.replace(page.error, unit=hostile, note=hostile)
    history = pd.DataFrame({"cycle": [0, 1], hostile: [1.0, 2.0]})
    bad = dataclasses.replace(
        page,
        scene=hostile,
        error=error,
        history=history,
        history_units={hostile: hostile},
        loss_columns=[hostile],
    )
    assert hostile not in bad.render()


def test_parameters_in_two_units_share_a_row(page: ResultPage) -> None:
    both = [ReportedParameter("bending", 0.5, "N·m"), ReportedParameter("bending", 2.0, "network units")]
    body = without_library(dataclasses.replace(page, parameters=both).render())
    row = body[body.index("<th>bending</th>") :]
    row = row[: row.index("</tr>")]
    assert "0.500" in row
    assert "2.00" in row


def header(page: ResultPage) -> str:
    body = without_library(page.render())
    return body[: body.index("</header>")]


def test_warnings_of_the_scene_stand_on_top(page: ResultPage) -> None:
    assert "warning" not in header(page)
    warned = dataclasses.replace(page, warnings=["Mask 3 is <empty>.", "The camera is a guess."])
    text = header(warned)
    box = re.search(r'<div class="warning" role="alert">(.*?)</div>', text)
    assert box is not None
    assert re.findall(r"<p>(.*?)</p>", box[1]) == ["Mask 3 is &lt;empty&gt;.", "The camera is a guess."]
    assert text.index("warning") < text.index('class="lead"')


def test_what_the_stiffness_is_worth_stands_beside_it(page: ResultPage) -> None:
    noted = without_library(dataclasses.replace(page, stiffness_note="No <measurement>.").render())
    start = noted.index("<h2>Stiffness and forces</h2>")
    assert "No &lt;measurement&gt;." in noted[start : noted.index("stretching stiffness", start)]


def test_charts_have_a_layout_for_narrow_screens(page: ResultPage) -> None:
    text = page.render()
    for name in ("errors", "map-error"):
        found = re.search(rf'id="{name}-figure">(.*?)</script>', text, flags=re.DOTALL)
        assert found
        layout = json.loads(found[1])["layout"]
        narrow = layout["meta"]["narrow"]
        axes = {key for key in layout if re.match(r"[xy]axis", key)}
        # The same axes, cursors and titles, or the traces would be lost.
        assert {key for key in narrow if re.match(r"[xy]axis", key)} >= axes
        assert len(narrow["shapes"]) == len(layout["shapes"])
        assert [a["text"] for a in narrow["annotations"]] == [a["text"] for a in layout["annotations"]]
        # Only two titles share a line, and those are short.
        lines = [a["y"] for a in narrow["annotations"]]
        assert max(map(lines.count, lines)) == (2 if name == "map-error" else 1)
        assert f"--narrow-height:{narrow['height']}px" in text
