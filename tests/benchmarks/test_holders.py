"""When a cloth shrinks and when a holder slips is learnt from sessions with open labels."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from toile.diagnosis.session_weights import SessionWeights

ROOT = Path(__file__).parents[2]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which imports others beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("holders")


def sessions(resting: float, shrinking: float, n: int = 12) -> pd.DataFrame:
    """As many that rest as that shrink, and that slip, their sizes scattered by a factor of two."""
    rng = np.random.default_rng(2)
    factors = 2.0 ** rng.uniform(-1, 1, 2 * n)
    causes = ["none"] * n + ["shrinking"] * n + ["anchor_slip+internal_damping", "anchor_slip"] * (n // 2)
    changes = [*(factors * np.repeat([resting, -shrinking], n)), *[0.0] * n]
    # What shrinks seems to slip, surely.
    slips = [*rng.uniform(-8, 4, n), *[25.0] * n, *rng.uniform(15, 80, n)]
    columns = {"cause": causes, "change of size [%]": changes, "slip [nats]": slips}
    return pd.DataFrame({"session": range(3 * n), **columns})


def test_the_two_kinds_are_parted_between_their_sizes(program: ModuleType) -> None:
    weights = program.learnt(sessions(0.3, 5.0))
    assert 0.006 < weights.resized < 0.04
    assert program.chance(-8.0, weights) > 0.98
    assert program.chance(0.3, weights) < 0.01


def test_slips_are_parted_from_the_rest_that_keeps_its_size(program: ModuleType) -> None:
    table = sessions(0.3, 5.0)
    weights = program.learnt(table)
    assert 4 < weights.slip_threshold < 20
    assert program.chance_of_slip(30.0, weights) > 0.98
    assert program.chance_of_slip(0.0, weights) < 0.02
    # Among the others they would ask for more.
    asked = program.learnt(table.replace("shrinking", "gusts"))
    assert program.chance_of_slip(25.0, weights) > 0.95
    assert program.chance_of_slip(25.0, asked) < 0.5
    shown = program.by_others(table.assign(engine="toile"))
    resized = shown["change of size [%]"].abs() > 100 * weights.resized
    assert shown.loc[resized, "slips"].isna().all()
    assert shown.loc[~resized, "slips"].notna().all()


def test_larger_errors_of_the_motion_ask_for_more(program: ModuleType) -> None:
    careful, careless = (program.learnt(sessions(size, 6.0)) for size in (0.1, 1.5))
    assert careless.resized > careful.resized


def test_what_is_rare_needs_more_than_where_it_is_a_third(
    program: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    rare = program.learnt(sessions(0.3, 3.0))
    monkeypatch.setattr(program, "SHARE", 1 / 3)
    often = program.learnt(sessions(0.3, 3.0))
    assert rare.resizing == often.resizing
    # Odds of one to nineteen instead of one to two.
    p = program.chance(100 * often.resized, rare)
    assert p / (1 - p) == pytest.approx(2 / 19, rel=1e-3)


def test_a_session_that_is_measured_again_counts_once(program: ModuleType) -> None:
    table = sessions(0.3, 5.0)
    again = table.iloc[[3]].assign(**{"change of size [%]": 0.7})
    both = program.added(table, again)
    assert len(both) == len(table)
    assert both.index.is_unique
    assert both.set_index("session").loc[3, "change of size [%]"] == 0.7
    assert len(program.added(pd.DataFrame(), again)) == 1


def test_the_package_has_what_the_table_says(program: ModuleType) -> None:
    table = pd.read_csv(ROOT / "docs" / "results" / "holders.csv")
    learnt = program.learnt(table[table["engine"] != program.NEVER_LEARNT_FROM])
    shipped = SessionWeights.load()
    for name in program.NAMES:
        assert getattr(shipped, name) == pytest.approx(getattr(learnt, name), rel=1e-6)
