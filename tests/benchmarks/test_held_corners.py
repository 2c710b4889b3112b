"""What a table of refined first clips says of corners that may wander."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from toile.diagnosis.session_weights import SessionWeights

ROOT = Path(__file__).parents[2]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which imports others beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("held_corners")


def session(cause: str, width: str, nats: dict[str, float], slip: float = -8.0) -> pd.DataFrame:
    common = {
        "session": f"{cause}_3_1",
        "cause": cause,
        "width": width,
        "revision": "0123456789",
        "usual": "internal_damping",
        "share": 0.001,
        "motion off by [% of the width]": 0.5,
        "corners off by [% of the width]": 0.3,
        "change of size [%]": 0.0,
        "slip [nats]": slip,
        "probability of none": 0.2,
        "probability of unknown": 0.1,
    }
    rows = [
        {**common, "effect": name, "nats": value, "probability": value / 100} for name, value in nats.items()
    ]
    return pd.DataFrame(rows)


NATS = {
    "air_drag": 30.0,
    "gusts": 20.0,
    "internal_damping": 90.0,
    "pressure": 50.0,
    "rest_length_drift": 40.0,
}


def test_the_right_answer_is_that_of_the_cause(program: ModuleType) -> None:
    threshold = SessionWeights.load().slip_threshold
    table = pd.concat(
        [
            session("air_drag", "2 mm", NATS),
            session("none", "2 mm", NATS),
            session("shrinking", "2 mm", NATS),
            session("anchor_slip", "2 mm", NATS, slip=threshold),
        ]
    )
    found = program.answers(table).set_index("session")
    right = found["right answer"]
    assert right["air_drag_3_1"] == pytest.approx(0.3)
    assert right["none_3_1"] == pytest.approx(0.2)
    assert right["shrinking_3_1"] == pytest.approx(0.1)
    assert right["anchor_slip_3_1"] == pytest.approx(0.5)
    # What the base model has of itself is no rival, and neither is a stand-in.
    assert found["best rival"].to_dict() == {
        "air_drag_3_1": "gusts",
        "none_3_1": "air_drag",
        "shrinking_3_1": "air_drag",
        "anchor_slip_3_1": "air_drag",
    }
    assert found["cause [nats]"]["air_drag_3_1"] == 30.0
    # The catalogue lacks the cause: its best stand-in speaks for it.
    assert found["cause [nats]"]["shrinking_3_1"] == 50.0
    assert pd.isna(found["cause [nats]"]["none_3_1"])
    page = program.page(table)
    assert "nan" not in page


def test_means_are_of_clips_with_both_widths(program: ModuleType) -> None:
    both = [session("none", width, NATS) for width in ("10 mm", "2 mm")]
    alone = session("air_drag", "2 mm", NATS).assign(**{"motion off by [% of the width]": 3.0})
    _, means = program.page(pd.concat([*both, alone])).split("Means")
    lines = [line.split("|")[1:-1] for line in means.splitlines() if line.startswith("| ")]
    assert [line[0].strip() for line in lines[1:]] == ["10 mm", "2 mm"]
    # The third clip is 3 % off.
    assert [(float(line[1]), int(line[-1])) for line in lines[1:]] == [(0.5, 1), (0.5, 1)]


def test_a_session_that_is_there_is_replaced(program: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"

    def update(*rows: pd.DataFrame) -> pd.DataFrame:
        program.update(
            path, pd.concat([pd.DataFrame(), *rows]), program._KEPT, lambda table: f"{len(table)}\n"
        )
        assert path.with_suffix(".md").read_text() == f"{len(pd.read_csv(path))}\n"
        return pd.read_csv(path)

    assert len(update(*(session("none", width, NATS) for width in ("2 mm", "10 mm")))) == 2 * len(NATS)
    after = update(session("none", "2 mm", {"gusts": 1.0}))
    assert list(after.groupby("width").size()[["10 mm", "2 mm"]]) == [len(NATS), 1]
    assert len(update()) == len(after)
