from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from toile.errors import InputError
from toile.evaluation.evaluate import EvaluationResult, Metric
from toile.reports.ablation_table import (
    PROCESSOR_SECONDS,
    SECONDS,
    ablation_cells,
    caption,
    formatted,
    read_published,
    relative,
    write_tables,
)
from toile.reports.run_folder import create_run_folder, write_config, write_metrics
from toile.reports.sweep import Sweep, read_sweep

ORDER = ["none", "no_uv", "surrogate"]
ABLATIONS = {"none", "no_silhouette", "no_force_regularization", "no_turbulence", "no_uv", "no_successive"}


def make_run(
    root: Path,
    scene: str,
    ablation: str,
    seed: int,
    chamfer: float,
    seconds: float,
    processor: float | None = None,
    **settings,
):
    """A run; scenes that were made have exact vertices, and another protocol."""
    run = create_run_folder(root / scene / ablation / f"seed{seed}")
    write_config(
        run, yaml.safe_dump({"scene": {"name": scene}, "seed": seed, "ablation": ablation, **settings})
    )
    protocol = "unaligned, samples of the mesh" if scene == "made" else "unaligned"
    metrics = {
        "chamfer": Metric("chamfer", "Chamfer distance", "×10⁻⁴ m²", protocol, np.full(2, chamfer)),
        "iou": Metric("iou", "Overlap", "", "of masks", np.full(2, 1 - chamfer / 100), higher_is_better=True),
    }
    if scene == "made":
        metrics["vertices"] = Metric("vertices", "Vertex error", "mm", "of vertices", np.full(2, 1.0))
    numbers = EvaluationResult(scene, 2, 0, metrics, {}).to_dict()
    machine = {"processor": "A&B", "processors": 2, "threads": 1}
    times = {"seconds of the fit": seconds, "processor seconds of the fit": processor}
    write_metrics(run, {**numbers, "fit": times, "machine": machine})


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "sweep"
    for seed, chamfer in enumerate((1.0, 2.0, 3.0)):
        make_run(folder, "R3", "none", seed, chamfer, 60 + seed)
        make_run(folder, "R3", "surrogate", seed, chamfer / 4, 30 + seed)
    make_run(folder, "made", "none", 0, 0.05, 10)
    return folder


def cells_of(root: Path, *metrics: str) -> pd.DataFrame:
    return ablation_cells(read_sweep([root]), metrics, read_published())


def test_cells_are_means_and_deviations_over_seeds_with_their_runs(root: Path) -> None:
    cells = cells_of(root, "chamfer").set_index(["scene", "ablation"])
    none = cells.loc[("R3", "none")]
    assert (none["mean"], none["deviation"], none["seeds"]) == (2.0, 1.0, 3)
    assert none["runs"].split() == [f"R3/none/seed{k}" for k in range(3)]
    alone = cells.loc[("made", "none")]
    assert alone["mean"] == 0.05
    assert np.isnan(alone["deviation"])


def test_published_values_stand_beside_the_same_cell_only(root: Path) -> None:
    cells = cells_of(root, "chamfer", SECONDS).set_index(["metric", "scene", "ablation"])
    assert cells.loc[("chamfer", "R3", "none"), "published"] == 12.5
    assert cells.loc[(SECONDS, "R3", "none"), "published"] == pytest.approx(60 * 3.07, abs=0.1)
    assert cells.published.notna().sum() == 2
    assert "Stotko" in cells.loc[("chamfer", "R3", "none"), "source"]


def test_published_table_is_complete() -> None:
    published = read_published()
    chamfer = published[(published.metric == "chamfer") & (published.scene != "R1")]
    assert set(chamfer.ablation) == ABLATIONS
    assert len(chamfer) == 6 * len(ABLATIONS)
    assert not published.duplicated(["metric", "scene", "ablation"]).any()


def test_text_has_the_order_asked_for_bold_winners_and_dashes(root: Path) -> None:
    table = formatted(cells_of(root, "chamfer"), "chamfer", ORDER, "**{}**", " ± ")
    assert list(table.index) == ["none", "surrogate"]
    assert table.loc["none", "R3"] == "2.00 ± 1.00 (12.5)"
    assert table.loc["surrogate", "R3"] == "**0.500 ± 0.250**"
    assert table.loc["none", "made"] == "**0.0500**"
    assert table.loc["surrogate", "made"] == "–"


def test_where_more_is_better_the_largest_wins(root: Path) -> None:
    make_run(root, "made", "surrogate", 0, 50.0, 10)
    table = formatted(cells_of(root, "iou"), "iou", ORDER, "**{}**", " ± ")
    assert table.loc["none", "made"].startswith("**")
    assert not table.loc["surrogate", "made"].startswith("**")


def test_files(root: Path, tmp_path: Path) -> None:
    create_run_folder(root / "R3" / "no_uv" / "seed0")
    (root / "R3" / "no_uv" / "seed0" / "failure.txt").write_text("error: too bad\n")
    paths = write_tables(
        read_sweep([root]), ["chamfer", "vertices", SECONDS], ORDER, tmp_path / "out", "t", "By hand."
    )
    csv, markdown, latex = (path.read_text() for path in paths)
    assert len(csv.splitlines()) == 1 + 2 * 3 + 1
    assert markdown.startswith("By hand.")
    assert "Protocol (R3): unaligned." in markdown
    assert "Protocol (made): unaligned, samples of the mesh." in markdown
    assert "Protocol: of vertices." in markdown
    assert "A&B, 2 cores" in markdown
    assert "`R3/no_uv/seed0`: error: too bad" in markdown
    assert r"\textbf{0.500 $\pm$ 0.250}" in latex
    assert r"A\&B" in latex
    assert not set(latex) & set("±×⁻⁴½–²")
    assert latex.count(r"\begin{tabular}") == 3


def test_a_row_whose_runs_differ_otherwise_is_refused(root: Path) -> None:
    make_run(root, "R3", "none", 3, 1.0, 1.0, bending=7)
    with pytest.raises(InputError, match=r"differ in more than scene and seed(?s:.)*bending"):
        cells_of(root, "chamfer")


def test_two_runs_of_one_cell_are_refused(root: Path) -> None:
    make_run(root / "again", "R3", "none", 0, 1.0, 1.0)
    with pytest.raises(InputError, match="Two runs claim one cell"):
        cells_of(root, "chamfer")


def test_published_values_of_whole_clips_do_not_stand_beside_a_few_frames(tmp_path: Path) -> None:
    for ablation in ("none", "no_uv"):
        make_run(tmp_path, "R3", ablation, 0, 2.0, 1.0)
        make_run(tmp_path, "R4", ablation, 0, 2.0, 1.0)
        config = tmp_path / "R3" / ablation / "seed0" / "config.yaml"
        config.write_text(
            yaml.safe_dump(yaml.safe_load(config.read_text()) | {"scene": {"name": "R3", "n_frames": 20}})
        )
    cells = ablation_cells(read_sweep([tmp_path]), ["chamfer"], read_published(), ["R3", "R5"])
    table = formatted(cells, "chamfer", ORDER, "{}", " ± ")
    assert list(table.columns) == ["R3", "R4", "R5, published"]
    assert list(table.loc["no_uv"]) == ["2.00", "2.00 (24.1)", "14.5"]


def test_a_small_deviation_has_a_digit(measured_twice: Sweep) -> None:
    cells = ablation_cells(measured_twice, ["chamfer"], read_published())
    for deviation, text in ((0.0012, "4.000 ± 0.001"), (0.5, "4.00 ± 0.50"), (1e-12, "4.00")):
        table = formatted(cells.assign(deviation=deviation), "chamfer", ORDER, "{}", " ± ")
        assert table.loc["none", "R1"].startswith(text)
        assert ("±" in table.loc["none", "R1"]) == ("±" in text)


def test_what_no_scene_allows_has_no_table(measured_twice: Sweep, tmp_path: Path) -> None:
    reason = {"vertex_error": "the scene has no true vertices"}
    runs = [replace(r, evaluation=replace(r.evaluation, skipped=reason)) for r in measured_twice.runs]
    sweep = replace(measured_twice, runs=tuple(runs))
    _, markdown, _ = write_tables(
        sweep, ["chamfer", "vertex_error_percent", SECONDS], ORDER, tmp_path, "t", ""
    )
    titles = [line for line in markdown.read_text().splitlines() if line.startswith("## ")]
    assert titles == ["## Chamfer distance", "## Time of the fit", "## Runs"]
    with pytest.raises(InputError, match="No run has this metric"):
        ablation_cells(measured_twice, ["vertex_error_percent"], read_published())


def test_an_unknown_metric_names_the_known_ones(root: Path) -> None:
    with pytest.raises(InputError, match=r"chamfer, iou, seconds, vertices"):
        cells_of(root, "nonsense")


@pytest.fixture
def measured_twice(tmp_path: Path) -> Sweep:
    """One fit a cell, its motion measured with a second seed."""
    folder = tmp_path / "once"
    shared = {
        "optimization": {"_target_": "a.Adam", "cycles": 40},
        "simulator": {"build": {"_target_": "b.Network", "gradient": {"_target_": "c.Backprop"}}},
    }
    make_run(folder, "R1", "none", 0, 2.0, 30.0, 20.0, **shared)
    make_run(folder, "R1", "no_silhouette", 0, 4.0, 25.0, 21.0, **shared)
    sweep = read_sweep([folder])

    def again(run):
        chamfer = replace(run.evaluation.metrics["chamfer"], per_frame=np.full(2, 6.0))
        return replace(run, other_seeds=(replace(run.evaluation, seed=1, metrics={"chamfer": chamfer}),))

    return replace(sweep, runs=tuple(map(again, sweep.runs)))


def test_seeds_of_the_metric_are_the_spread_of_one_fit(measured_twice: Sweep) -> None:
    cells = ablation_cells(measured_twice, ["chamfer", "iou"], read_published())
    cells = cells.set_index(["metric", "ablation"])
    none = cells.loc[("chamfer", "none")]
    assert (none["mean"], none["seeds"], none["runs"]) == (4.0, 2, "R1/none/seed0")
    assert none["deviation"] == pytest.approx(np.std([2, 6], ddof=1))
    # What was not measured again is the fit's own number.
    assert cells.loc[("iou", "none"), "seeds"] == 1
    words = caption(measured_twice, cells.reset_index(), "chamfer")
    assert "one fit a cell, which draws no random numbers" in words
    assert "recipe Adam: 40 cycles, Network with Backprop." in words


def test_seeds_of_fits_and_of_the_metric_are_not_mixed(root: Path) -> None:
    sweep = read_sweep([root])
    runs = tuple(replace(run, other_seeds=(run.evaluation,)) for run in sweep.runs)
    with pytest.raises(InputError, match=r"one fit a cell(?s:.)*7 fits in 3 cells"):
        ablation_cells(replace(sweep, runs=runs), ["chamfer"], read_published())


def test_time_of_the_processor_stands_beside_that_of_the_clock(measured_twice: Sweep) -> None:
    cells = ablation_cells(measured_twice, [SECONDS], read_published())
    assert list(dict.fromkeys(cells.metric)) == [SECONDS, PROCESSOR_SECONDS]
    table = formatted(cells, SECONDS, ORDER, "**{}**", " ± ")
    assert table.loc["none", "R1"] == "**30.0 / 20.0**"
    assert table.loc["no_silhouette", "R1"] == "25.0 / 21.0", "the processor's time decides"
    assert "on the clock / of the processor" in caption(measured_twice, cells, SECONDS)


def test_published_scenes_have_columns_and_rows_of_their_own(measured_twice: Sweep) -> None:
    cells = ablation_cells(measured_twice, ["chamfer"], read_published(), ["R4", "R3", "R1"])
    table = formatted(cells, "chamfer", ORDER, "**{}**", " ± ")
    assert list(table.columns) == ["R1", "R4, published", "R3, published"]
    assert list(table.index)[:3] == ["none", "no_uv", "no_silhouette"]
    assert set(table.index) == ABLATIONS
    assert list(table["R3, published"])[:3] == ["12.5", "13.3", "13.8"]
    assert table.loc["no_uv", "R1"] == "–"
    assert table.loc["none", "R1"] == "**4.00 ± 2.83** (6.05)"
    ratios = relative(cells, "chamfer", ORDER)
    assert list(ratios.loc["no_turbulence"]) == ["–", "3.17", "1.68"]
    assert list(ratios.loc["no_silhouette"]) == ["1.25", "1.01", "1.1"]


def test_files_with_published_columns_have_no_gaps(measured_twice: Sweep, tmp_path: Path) -> None:
    paths = write_tables(
        measured_twice, ["chamfer", SECONDS], ORDER, tmp_path, "t", "", ["R3", "R4", "R5", "R7", "R8", "R9"]
    )
    csv, markdown, latex = (path.read_text() for path in paths)
    assert len(csv.splitlines()) == 1 + 2 * 3 + 6 * 6 + 6
    for text in (csv, markdown, latex):
        assert not re.search(r"\bnan\b", text, re.IGNORECASE)
    assert "relative to none" in markdown
    assert r"tab:t_chamfer_relative" in latex
    assert not set(latex) & set("±×⁻⁴½–²“”")
    assert markdown.count("R1/none/seed0") == 1


def test_names_are_escaped_and_zeros_are_written(tmp_path: Path) -> None:
    for seed in (0, 1):
        make_run(tmp_path, "R&D 50%_|#1", "none", seed, 0.0, 10)
    write_tables(read_sweep([tmp_path]), ["chamfer"], ORDER, tmp_path / "out", "table", "")
    latex = (tmp_path / "out" / "table.tex").read_text()
    assert r"R\&D 50\%\_\textbar{}\#1" in latex
    markdown = (tmp_path / "out" / "table.md").read_text()
    assert r"R&D 50%_\|#1" in markdown


def test_metrics_that_no_scene_allows_are_said(tmp_path: Path) -> None:
    run = create_run_folder(tmp_path / "R1")
    write_config(run, yaml.safe_dump({"scene": {"name": "R1"}, "seed": 0, "ablation": "none"}))
    metrics = {"iou": Metric("iou", "Overlap", "", "of masks", np.full(2, 0.9), higher_is_better=True)}
    numbers = EvaluationResult("R1", 2, 0, metrics, {"chamfer": "no ground truth"}).to_dict()
    write_metrics(run, {**numbers, "fit": {"seconds of the fit": 1.0}})
    with pytest.raises(InputError, match="No run has any of these metrics"):
        cells_of(tmp_path, "chamfer")
