from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.reports.page.charts import DotPanel, dots
from toile.reports.page.sweep_page import Spread, SweepPage, write_sweep_page
from toile.reports.run_folder import (
    create_run_folder,
    write_config,
    write_metrics,
    write_overrides,
    write_trajectory,
)
from toile.reports.run_settings import differences, read_settings
from toile.reports.sweep import outcomes, read_sweep


def make_run(
    folder: Path, chamfer: float, *, seed: int = 0, scene: str = "R1", page: bool = True, **settings
):
    run = create_run_folder(folder)
    write_config(run, yaml.safe_dump({"scene": {"name": scene}, "seed": seed, **settings}))
    metric = Metric("chamfer", "Squared Chamfer distance", "×10⁻⁴ m²", "unaligned", np.full(3, chamfer))
    numbers = EvaluationResult(scene, 3, 0, {"chamfer": metric}, {}).to_dict()
    write_metrics(run, {**numbers, "fit": {"seconds of the fit": 10.0 + seed}})
    write_trajectory(run, np.ones((3, 2, 2, 3)), fps=50, parameters={"bending [N·m]": chamfer / 1000})
    run.page.write_text("page")
    return run


def body(text: str) -> str:
    return re.sub(r"<head>.*?</head>|<script.*?</script>", "", text, flags=re.DOTALL)


@pytest.fixture
def sweep_folder(tmp_path: Path) -> Path:
    root = tmp_path / "my sweep"
    for seed in (0, 1):
        make_run(root / "R1" / "none" / f"seed{seed}", 0.5 + 0.1 * seed, seed=seed, turbulence=10.0)
        make_run(root / "R1" / "weak" / f"seed{seed}", 2.0 + 0.2 * seed, seed=seed, turbulence=1.0)
    (root / "R1" / "none" / "seed0" / ".hydra").mkdir()
    return root


def test_runs_are_found_at_any_depth_and_grouped_by_what_differs(sweep_folder: Path) -> None:
    sweep = read_sweep([sweep_folder])
    assert [r.name for r in sweep.runs] == [f"R1/{g}/seed{s}" for g in ("none", "weak") for s in (0, 1)]
    assert [(d.name, d.values) for d in sweep.differences] == [("turbulence", ("10", "10", "1", "1"))]
    assert [(g.label, len(g.runs)) for g in sweep.groups] == [("turbulence = 10", 2), ("turbulence = 1", 2)]


def test_what_goes_with_a_scene_is_no_choice(tmp_path: Path) -> None:
    for ablation, frames in (("none", 25), ("weak", 25)):
        settings = {"ablation": ablation}
        make_run(tmp_path / "R1" / ablation, 0.5, **settings)
        run = make_run(tmp_path / "made" / ablation, 90.0, scene="made", **settings)
        scene = {"name": "made", "n_frames": frames}
        write_config(run, yaml.safe_dump({"scene": scene, "seed": 0, **settings}))
    sweep = read_sweep([tmp_path])
    assert [d.name for d in sweep.differences] == ["ablation"]
    assert [len(g.runs) for g in sweep.groups] == [2, 2]
    scene = {"name": "made", "n_frames": 5}
    other = make_run(tmp_path / "made" / "short", 0.5, scene="made", ablation="none")
    write_config(other, yaml.safe_dump({"scene": scene, "seed": 0, "ablation": "none"}))
    longer = read_sweep([tmp_path])
    assert [d.name for d in longer.differences] == ["ablation", "n_frames"]
    # The scene's own number of frames does not tell its runs from those of R1; another one does.
    assert sorted(len(g.runs) for g in longer.groups) == [1, 2, 2]


def test_dots_that_span_decades_have_a_logarithmic_axis() -> None:
    def types(*values: float) -> list[str | None]:
        chart = dots(["a", "b"], [["r"], ["s"]], [DotPanel("t", "mm", [[values[0]], [values[1]]])])
        return [chart.layout.xaxis.type]

    assert types(0.5, 500.0) == ["log"]
    assert types(0.5, 0.6) == [None]
    assert types(0.0, 500.0) == [None]


def test_overrides_name_the_groups(sweep_folder: Path) -> None:
    for path in sweep_folder.rglob("seed?"):
        record = [f"ablation={path.parent.name}", f"seed={path.name[-1]}", "scene=R1", "cycles=3"]
        (path / ".hydra").mkdir(exist_ok=True)
        (path / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(record))
    assert [g.label for g in read_sweep([sweep_folder]).groups] == ["ablation=none", "ablation=weak"]


def test_page_opens_with_the_best_setting_and_its_spread(sweep_folder: Path) -> None:
    text = body(SweepPage(read_sweep([sweep_folder]), sweep_folder / "report.html").render())
    header = text[: text.index("</header>")]
    assert "4 runs of R1 in 2 settings" in header
    lead = re.sub(r"<[^>]*>", "", header).replace("\u202f", " ")
    assert "squared Chamfer distance: 0.550 ± 0.071 ×10⁻⁴ m² over 2 runs with turbulence = 10" in lead
    assert "2.10 ×10⁻⁴ m² with turbulence = 1" in lead


def test_best_run_is_marked_and_linked_relative_to_the_page(sweep_folder: Path, tmp_path: Path) -> None:
    path = write_sweep_page(SweepPage(read_sweep([sweep_folder]), tmp_path / "elsewhere" / "page.html"))
    text = body(path.read_text(encoding="utf-8"))
    (marked,) = re.findall(r'<tr class="best">.*?</tr>', text)
    assert 'href="../my%20sweep/R1/none/seed0/index.html"' in marked
    (path.parent / "../my sweep/R1/none/seed0/index.html").resolve(strict=True)


def test_higher_is_better_turns_the_order_round(tmp_path: Path) -> None:
    for name, value in (("a", 0.7), ("b", 0.9)):
        run = make_run(tmp_path / name, 1.0, kind=name)
        metric = Metric("silhouette_iou", "Silhouette IoU", "", "overlap", np.full(3, value), True)
        write_metrics(run, EvaluationResult("R1", 3, 0, {"silhouette_iou": metric}, {}).to_dict())
    text = body(SweepPage(read_sweep([tmp_path]), tmp_path / "report.html").render())
    assert "<strong>kind = b</strong>; 0.700 with kind = a" in text


def test_runs_without_a_result_are_listed_with_their_reason(sweep_folder: Path) -> None:
    failed = make_run(sweep_folder / "R1" / "bad" / "seed0", 0.1)
    (failed.path / "failure.txt").write_text("error: frame 3 <did> not converge")
    crashed = make_run(sweep_folder / "R1" / "bad" / "seed1", 0.1)
    (crashed.path / "failure.txt").write_text("Traceback (most recent call last):\n  f\nValueError: oops\n")
    running = make_run(sweep_folder / "R1" / "bad" / "seed2", 0.1)
    running.metrics.unlink()
    broken = make_run(sweep_folder / "R1" / "bad" / "seed3", 0.1)
    broken.metrics.write_text("{")
    sweep = read_sweep([sweep_folder])
    assert len(sweep.runs) == 4
    reasons = [u.reason for u in sweep.unfinished]
    assert reasons[0] == "error: frame 3 <did> not converge"
    assert reasons[1] == "ValueError: oops"
    assert "interrupted" in reasons[2]
    assert "metrics.json" in reasons[3]
    text = body(SweepPage(sweep, sweep_folder / "report.html").render())
    assert "4 runs have no result" in text
    assert "frame 3 &lt;did&gt; not converge" in text
    assert "<did>" not in text


def unfinished_table(text: str) -> str:
    return text[text.index("<h2>Without a result</h2>") :]


def test_failed_runs_show_their_settings(sweep_folder: Path) -> None:
    failed = make_run(sweep_folder / "R1" / "bad" / "seed4", 0.1, seed=4, turbulence=10.0, steps=1)
    (failed.path / "failure.txt").write_text("error: did not converge")
    # Failed before its configuration was stored.
    early = create_run_folder(sweep_folder / "R1" / "early")
    (early.path / "failure.txt").write_text("error: bending is negative")
    (early.path / ".hydra").mkdir()
    asked = ["scene=R1", "parameters.bending=<-1>", "report.video=false"]
    (early.path / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(asked))
    sweep = read_sweep([sweep_folder])
    # Finished runs are grouped by what they differ in among themselves.
    assert [d.name for d in sweep.differences] == ["turbulence"]
    assert {d.name: d.values for d in sweep.all_differences} == {
        "steps": ("–", "–", "–", "–", "1", ""),
        "turbulence": ("10", "10", "1", "1", "10", ""),
    }
    text = body(SweepPage(sweep, sweep_folder / "report.html").render())
    row, other = re.findall(r"<tr><th>R1/(?:bad/seed4|early)</th>(.*?)</tr>", unfinished_table(text))
    assert re.findall(r'data-label="(.*?)">(.*?)</td>', row) == [
        ("steps", "1"),
        ("turbulence", "10"),
        ("asked for", ""),
        ("seed", "4"),
    ]
    assert 'data-label="asked for">bending=&lt;-1&gt;' in other
    assert "bending is negative" in other
    # What only the failed run has is a column of the others, too.
    assert ">steps</button>" in text


def test_every_setting_of_a_sweep_is_an_axis(tmp_path: Path) -> None:
    """However many settings come along with what was asked for, and however long the labels are."""
    names = ("stretching", "shearing", "bending")
    along = [f"setting_with_a_long_name_{k}" for k in range(8)]
    for k in range(3):
        values = {name: float(10 * k + j) for j, name in enumerate(names)}
        run = make_run(tmp_path / str(k), 1.0 + k, parameters=values, along=dict.fromkeys(along, k))
        (run.path / ".hydra").mkdir()
        asked = [f"parameters.{name}={value}" for name, value in values.items()]
        asked.append(f"+experiment=one_with_a_long_name_{k}")
        (run.path / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(asked))
    page = SweepPage(read_sweep([tmp_path]), tmp_path / "report.html")
    text = body(page.render())
    table = text[text.index("<h2>Runs</h2>") : text.index("</table>", text.index("<h2>Runs</h2>"))]
    for name in names:
        assert f">{name}</button>" in table
    charts = re.findall(r'id="(?:dots-0|parameters)-figure">(.*?)</script>', page.render(), flags=re.DOTALL)
    assert charts
    for chart in charts:
        labels = json.loads(chart)["layout"]["yaxis"]["ticktext"]
        for label in labels:
            assert all(name in label for name in (*names, "one_with_a_long_name"))
            # In lines, so that the dots keep their room.
            assert max(map(len, label.split("<br>"))) <= 46


def test_the_same_small_value_of_all_runs_can_be_read() -> None:
    chart = dots(["a", "b"], [["r"], ["s"]], [DotPanel("t", "N·m", [[3.5e-4], [3.5e-4]])])
    low, high = chart.layout.xaxis.range
    assert 0 < low < 3.5e-4 < high < 1e-3
    assert chart.layout.xaxis.ticktext == ("0.00035",)


def test_the_stiffness_says_what_it_is_worth(sweep_folder: Path) -> None:
    stages = {"track": {"priors": {"turbulence": 10.0, "stiffness": 0.05}}}
    recipe = {"_target_": "toile.reconstruction.gauss_newton.recipe.TrackingRecipe", "stages": stages}
    make_run(sweep_folder / "R1" / "other", 1.0, optimization=recipe)
    text = body(SweepPage(read_sweep([sweep_folder]), sweep_folder / "report.html").render())
    assert "no measurement" in text[text.index("<h2>Stiffness found</h2>") :]


def test_several_scenes_each_have_their_best(tmp_path: Path) -> None:
    make_run(tmp_path / "1", 1.0, scene="R1", kind="a")
    make_run(tmp_path / "2", 2.0, scene="R1", kind="b")
    make_run(tmp_path / "3", 9.0, scene="R2", kind="a")
    make_run(tmp_path / "4", 8.0, scene="R2", kind="b")
    text = body(SweepPage(read_sweep([tmp_path]), tmp_path / "report.html").render())
    header = re.sub(r"<[^>]*>", "", text[: text.index("</header>")]).replace("\u202f", " ")
    assert "distance on R1: 1.00 ×10⁻⁴ m² with kind = a" in header
    assert "distance on R2: 8.00 ×10⁻⁴ m² with kind = b" in header


def test_other_lengths_are_not_compared_in_silence(tmp_path: Path) -> None:
    make_run(tmp_path / "1", 1.0, kind="a")
    run = make_run(tmp_path / "2", 2.0, kind="b")
    metric = Metric("chamfer", "Squared Chamfer distance", "×10⁻⁴ m²", "unaligned", np.full(5, 1.0))
    write_metrics(run, EvaluationResult("R1", 5, 0, {"chamfer": metric}, {}).to_dict())
    text = SweepPage(read_sweep([tmp_path]), tmp_path / "report.html").render()
    assert "different lengths (3, 5 frames)" in text


def test_hostile_run_is_only_text(tmp_path: Path) -> None:
    hostile = "</script><script>alert(1)</script>"
    make_run(tmp_path / "1", 1.0, kind=hostile, scene=hostile)
    make_run(tmp_path / "2", 2.0, kind="b")
    assert hostile not in SweepPage(read_sweep([tmp_path]), tmp_path / "report.html").render()


def test_folder_without_runs(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no fit below"):
        read_sweep([tmp_path / "empty"])


def test_outcomes_count_what_is_no_fit_as_well(tmp_path: Path) -> None:
    """Two finished diagnoses were "0 of 2 runs", two finished trainings could not be read."""
    for kind, result in (("training", "metrics.json"), ("diagnosis", "diagnosis.json")):
        for k in range(2):
            run = create_run_folder(tmp_path / kind / str(k))
            write_config(run, yaml.safe_dump({kind: {}, "scene": {"name": "R1"}}))
        (tmp_path / kind / "0" / result).write_text("{}")
    make_run(tmp_path / "fit", 1.0)
    finished, unfinished = outcomes(tmp_path)
    assert finished == 3
    reasons = {run.name: run.reason for run in unfinished}
    assert set(reasons) == {"training/1", "diagnosis/1"}
    assert "no diagnosis.json" in reasons["diagnosis/1"]
    assert [run.name for run in read_sweep([tmp_path]).runs] == ["fit"]
    assert not read_sweep([tmp_path]).unfinished


def test_a_run_is_called_by_what_it_was_started_with(tmp_path: Path) -> None:
    """Hydra's record may be of a later call, that was refused."""
    run = make_run(tmp_path / "0", 1.0)
    (run.path / ".hydra").mkdir()
    (run.path / ".hydra" / "overrides.yaml").write_text("[parameters.bending=9]")
    write_overrides(run, ["parameters.stretching=2"])
    assert read_sweep([tmp_path]).runs[0].overrides == ("parameters.stretching=2",)


def test_where_all_runs_have_lost_the_cloth_there_is_a_page(tmp_path: Path) -> None:
    for k, kind in enumerate("ab"):
        make_run(tmp_path / str(k), 0.0, kind=kind)
    assert "2 runs" in SweepPage(read_sweep([tmp_path]), tmp_path / "report.html").render()


def test_parts_that_only_some_have_are_one_difference() -> None:
    first = {
        "stage": {"_target_": "m.Stage", "windows": {"lag": 3}, "n": 1},
        "simulator": {"_target_": "a.Solver"},
    }
    second = {"stage": None, "simulator": {"_target_": "b.Net", "passes": 2}}
    found = {d.name: d.values for d in differences([first, second])}
    assert found == {"stage": ("Stage", "none"), "simulator": ("Solver", "Net")}


def test_settings_that_agree_are_shown_once_and_ambiguous_names_in_full() -> None:
    def settings(weight: float, other: float) -> dict:
        return {
            "a": {"weight": weight},
            "b": {"weight": weight},
            "c": {"weight": other},
            "paths": {"x": other},
        }

    found = differences([settings(1.0, 1.0), settings(0.0, 2.0)])
    assert {d.name: d.paths for d in found} == {
        "a.weight": ("a.weight", "b.weight"),
        "c.weight": ("c.weight",),
    }


@pytest.mark.parametrize(
    "text", ["a: [", "- 1", "a: &x [1]\nb: [*x, *x]", "a: " + "x" * 300_000, "&a {b: *a}"]
)
def test_configuration_that_is_none(text: str) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_settings(text, "config.yaml")


def test_spread_leaves_out_what_is_unknown() -> None:
    spread = Spread.of([1.0, float("nan"), 3.0])
    assert (spread.mean, spread.n) == (2.0, 2)
    assert spread.deviation == pytest.approx(2**0.5)
    assert Spread.of([]).n == 0
