"""Tables of the capture: columns as promised, spread over seeds, verdicts that follow from the numbers."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path

import pandas as pd
import pytest

from toile.capture.metrics.reconstruction import Measures
from toile.reports.capture_tables import Line, claims, read_published, table_of, write_capture_tables

TITLES = {"skinning": "skinning", "simulation": "simulation", "warm": "warm start", "physics": "physics"}
COLUMNS = (
    "row,domain,seed,out_of_balance_avg,out_of_balance_max,penetration_mean_mm,penetration_max_mm,iou_all,"
    "iou_reference,iou_single,mpjpe_mm,vertex_error_mm,vertex_error_visible_mm,before_resolution"
)


def measures(**values: float) -> Measures:
    plain = Measures(**{field.name: 0.5 for field in fields(Measures)})
    return replace(plain, **values)


def lines(**physics: float) -> list[Line]:
    found = []
    for seed in range(2):
        for row in TITLES:
            for before in (True, False):
                own = measures(vertex_error_mm=30.0, out_of_balance_avg=100.0 + 10 * seed)
                if row == "physics":
                    own = measures(
                        **{
                            "out_of_balance_avg": 40.0,
                            "penetration_share": 0.01,
                            "vertex_error_mm": 20.0,
                            "vertex_error_visible_mm": 0.4,
                            **physics,
                        }
                    )
                found.append(Line(row, "own", seed, before, own))
    return found


def test_columns_and_spread(tmp_path: Path) -> None:
    written = write_capture_tables(lines(iou_reference=math.nan), tmp_path / "capture", TITLES, "A note.")
    csv, md, tex = (path.read_text() for path in written)
    assert csv.splitlines()[0].startswith(COLUMNS)
    assert len(csv.splitlines()) == 1 + 16
    assert "105 ± 7.07" in md
    for text in (csv, md, tex):
        assert "nan" not in text.lower()
    assert "Li et al., other data" in md
    assert "DeepCap (other data)" in tex
    table = pd.read_csv(tmp_path / "capture.csv")
    assert table.before_resolution.dtype == bool


@pytest.mark.parametrize(
    ("change", "failing"),
    [
        ({}, ()),
        ({"out_of_balance_avg": 60.0}, ("out-of-balance",)),
        ({"penetration_share": 0.2}, ("penetration",)),
        ({"iou_all": 0.47}, ("overlap",)),
        ({"vertex_error_mm": 31.0}, ("warm start", "skinning")),
        ({"vertex_error_visible_mm": 0.6}, ("pure simulation",)),
    ],
)
def test_verdicts_follow_from_the_numbers(change: dict[str, float], failing: tuple[str, ...]) -> None:
    found = claims(table_of(lines(**change)), "own")
    for words, _, verdict in found:
        expected = "fails" if any(part in words.split("(")[0] for part in failing) else "holds"
        if failing == ("warm start", "skinning") and not words.startswith("garment"):
            expected = "holds"
        assert verdict == expected, words


def test_what_was_not_measured_has_no_verdict() -> None:
    only = [line for line in lines() if line.row != "simulation"]
    verdicts = [verdict for words, _, verdict in claims(table_of(only), "own") if "simulation" in words]
    assert verdicts == ["not measured"]


def test_published_rows_are_those_of_the_paper() -> None:
    published = read_published().set_index("method")
    assert published.loc["Li et al.", "penetration_mean_mm"] == 41.65
    assert published.loc["DeepCap", "iou_single"] == pytest.approx(0.8666)
    assert math.isnan(published.loc["HMR", "out_of_balance_avg"])
