"""The pages as a browser shows them; needs a Chromium."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from toile.evaluation.evaluate import evaluate
from toile.rendering.reference import ReferenceRenderer
from toile.reports.cloth_fields import TURBULENCE
from toile.reports.page.run_page import write_result_page
from toile.reports.page.sweep_page import SweepPage, write_sweep_page
from toile.reports.run_folder import (
    RunFolder,
    create_run_folder,
    write_config,
    write_history,
    write_metrics,
    write_trajectory,
)
from toile.reports.run_report import result_page
from toile.reports.sweep import read_sweep
from toile.scenes.scene import Scene

_SPEC = importlib.util.spec_from_file_location(
    "chromium", Path(__file__).parents[3] / "docs" / "images" / "chromium.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
chromium = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(chromium)

pytestmark = pytest.mark.skipif(chromium.executable() is None, reason="no Chromium found")

WIDTH, HEIGHT = 1000, 1500
# Notes every complaint of the page from its first script on.
WATCH = """<script>
window.trouble = [];
addEventListener("error", (e) => trouble.push("error: " + e.message));
addEventListener("unhandledrejection", (e) => trouble.push("rejected: " + e.reason));
addEventListener("securitypolicyviolation", (e) => trouble.push("blocked: " + e.blockedURI));
console.error = (...words) => trouble.push("console: " + words.join(" "));
</script>"""
# Once everything is drawn, says what the page is like, and what it does when it is used.
PROBE = """<script>
const used = (start) => {
  const find = (id) => document.getElementById(id);
  const [clock, slider, picture] = ["clock", "frame", "frame-picture"].map(find);
  const frame = () => Number(clock.textContent.match(/[0-9]+/)[0]);
  const press = (key) => {
    document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
    return frame();
  };
  const slide = (f) => {
    slider.value = f;
    slider.dispatchEvent(new Event("input", { bubbles: true }));
    return [frame(), picture.src, document.getElementById("playback").data[0].x[0][0]];
  };
  const choose = (view) => {
    document.querySelector(`input[value=${view}]`).click();
    return picture.src;
  };
  const done = {
    keys: [press("Home"), press("ArrowRight"), press("End"), press("ArrowLeft")],
    slid: [slide(1), slide(3)],
    views: ["rendered", "difference", "observed"].map(choose),
  };
  document.getElementById("map-error").emit("plotly_click", { points: [{ curveNumber: 2, x: 2 }] });
  done.clicked = frame();
  slide(start);
  return done;
};
const box = (id) => {
  const place = document.getElementById(id);
  if (!place) return null;
  const { left, top, right, bottom } = place.getBoundingClientRect();
  return [left, top, right, bottom].map(Math.round);
};
const waiting = setInterval(() => {
  if (!document.documentElement.dataset.ready) return;
  clearInterval(waiting);
  const found = {
    trouble,
    requests: performance.getEntriesByType("resource").map((r) => r.name)
      .filter((name) => !/^(data|blob):/.test(name)),
    overflow: document.documentElement.scrollWidth - innerWidth,
    boxes: { picture: box("frame-picture"), space: box("playback") },
    undrawn: [...document.querySelectorAll("[data-figure]")].filter((p) => !p.querySelector("svg")).length,
    clock: document.getElementById("clock")?.textContent,
  };
  if (found.clock) found.used = used(Number(found.clock.match(/[0-9]+/)[0]));
  // Titles and labels of every figure: which of them touch, and which leave the page.
  const seen = (e) => e.getBoundingClientRect();
  const before = (a, b) => a.right <= b.left + 1 || a.bottom <= b.top + 1;
  const apart = (a, b) => before(a, b) || before(b, a);
  found.overlaps = [...document.querySelectorAll(".plot")].flatMap((plot) => {
    const texts = [...plot.querySelectorAll(".annotation-text, .legendtext")];
    return texts.flatMap((a, k) => texts.slice(k + 1).filter((b) => !apart(seen(a), seen(b)))
      .map((b) => `${plot.id}: ${a.textContent} / ${b.textContent}`));
  });
  found.cut = [...document.querySelectorAll(".annotation-text, .legendtext")]
    .filter((e) => seen(e).right > innerWidth + 1 || seen(e).left < -1).map((e) => e.textContent);
  const note = document.createElement("pre");
  note.id = "probe";
  note.hidden = true;
  note.textContent = JSON.stringify(found);
  document.body.append(note);
  if (parent !== window) parent.postMessage(note.textContent, "*");
}, 20);
</script>"""


def make_run(scene: Scene, folder: Path, off: float) -> RunFolder:
    """A run that lies ``off`` metres behind the true motion."""
    assert scene.ground_truth is not None
    assert scene.ground_truth.vertices is not None
    positions = scene.ground_truth.vertices.clone()
    positions[..., 2] += off * positions[..., 0].abs() / 0.2
    run = create_run_folder(folder)
    turbulence = np.random.default_rng(0).normal(size=(scene.n_frames - 1, *scene.grid, 3))
    parameters = {"bending [N·m]": 1e-4, TURBULENCE: turbulence}
    write_trajectory(run, positions.numpy(), fps=scene.fps, parameters=parameters)
    write_metrics(run, evaluate(positions, scene).to_dict())
    write_history(run, pd.DataFrame({"cycle": [0, 1], "loss": [2.0, 1.0], "wind x [m/s²]": [0.0, 1.0]}))
    write_config(run, f"scene: {{name: {scene.name}}}\noff: {off}\n")
    return run


def look(page: Path, address: str = "", width: int = WIDTH) -> tuple[dict[str, Any], np.ndarray]:
    """What the page says about itself, and its picture (h, w, 3)."""
    text = page.read_text(encoding="utf-8")
    watched = page.with_name("watched.html")
    watched.write_text(
        text.replace("<title>", WATCH + "<title>", 1).replace("</body>", PROBE + "</body>"), encoding="utf-8"
    )
    picture = page.with_name("page.png")
    dom = chromium.show(watched.as_uri() + address, picture, width=width, height=HEIGHT)
    found = re.search(r'<pre id="probe"[^>]*>(.*?)</pre>', dom, flags=re.DOTALL)
    assert found, "the page was never ready"
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    return json.loads(found[1].replace("&amp;", "&")), pixels


def part(picture: np.ndarray, box: list[int]) -> np.ndarray:
    left, top, right, bottom = box
    return picture[max(top, 0) : bottom, left:right]


def test_page_of_a_run(tiny_scene: Scene, tmp_path: Path) -> None:
    run = make_run(tiny_scene, tmp_path / "run", 0.004)
    page = result_page(run, tiny_scene, ReferenceRenderer(), 2)
    write_result_page(dataclasses.replace(page, config="x" * 5000), run.page)
    (first, before), (last, after) = look(run.page, "#frame=0"), look(run.page, "#frame=3")
    for probe in (first, last):
        assert probe["trouble"] == []
        assert probe["requests"] == []
        assert probe["overflow"] == 0
        assert probe["undrawn"] == 0
        used = probe["used"]
        assert used["keys"] == [0, 1, 3, 2]
        (one, one_picture, one_x), (three, three_picture, three_x) = used["slid"]
        assert (one, three) == (1, 3)
        assert one_picture != three_picture
        assert one_x != three_x
        assert len(set(used["views"])) == 3
        assert used["clicked"] == 2
    assert first["clock"].startswith("frame 0 of 3")
    assert last["clock"].startswith("frame 3 of 3")
    for name in ("picture", "space"):
        assert first["boxes"][name] == last["boxes"][name]
        shown, later = part(before, first["boxes"][name]), part(after, last["boxes"][name])
        # Painted, with more than a background and some lines ...
        assert shown.std() > 8, name
        assert (shown.min(axis=-1) < 235).mean() > 0.05, name
        # ... and moved by the frame.
        assert (np.abs(shown - later).max(axis=-1) > 20).mean() > 0.005, name


def check_texts(probe: dict[str, Any]) -> None:
    assert probe["trouble"] == []
    assert probe["overflow"] == 0
    assert probe["undrawn"] == 0
    assert probe["overlaps"] == []
    assert probe["cut"] == []


@pytest.mark.parametrize("width", [chromium.PHONE, 1440])
def test_titles_of_a_run_stand_apart(width: int, tiny_scene: Scene, tmp_path: Path) -> None:
    run = make_run(tiny_scene, tmp_path / "run", 0.004)
    page = result_page(run, tiny_scene, ReferenceRenderer(), 2)
    write_result_page(dataclasses.replace(page, warnings=["The masks " + 30 * "flicker "]), run.page)
    probe, picture = look(run.page, width=width)
    check_texts(probe)
    assert picture.shape[1] == width
    # The cursors are there after the figures were arranged for the screen.
    assert probe["used"]["clicked"] == 2


@pytest.mark.parametrize("width", [chromium.PHONE, 1440])
def test_titles_of_a_sweep_stand_apart(width: int, tiny_scene: Scene, tmp_path: Path) -> None:
    for k, off in enumerate((0.001, 0.004)):
        run = make_run(tiny_scene, tmp_path / "sweep" / str(k), off)
        (run.path / ".hydra").mkdir()
        asked = [f"parameters.{name}={off}" for name in ("stretching", "shearing", "bending", "damping")]
        (run.path / ".hydra" / "overrides.yaml").write_text(json.dumps(asked))
    page = SweepPage(read_sweep([tmp_path / "sweep"]), tmp_path / "sweep" / "report.html")
    probe, _ = look(write_sweep_page(page), width=width)
    check_texts(probe)


def test_page_of_a_sweep(tiny_scene: Scene, tmp_path: Path) -> None:
    for k, off in enumerate((0.001, 0.004)):
        make_run(tiny_scene, tmp_path / "sweep" / str(k), off)
    path = write_sweep_page(SweepPage(read_sweep([tmp_path / "sweep"]), tmp_path / "sweep" / "report.html"))
    probe, picture = look(path)
    assert probe["trouble"] == []
    assert probe["requests"] == []
    assert probe["overflow"] == 0
    assert probe["undrawn"] == 0
    assert picture.std() > 8
