"""One variant is made anew, and the rows of the others stay."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def results(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """benchmarks/results.py."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import results

    yield results
    del sys.modules["results"]


def test_one_variant_is_run_and_the_others_are_kept(
    results: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names, chamfer = [n for n in results.VARIANTS if n not in results.OF_PAPER_RECIPE], 1.0
    asked: list[list[str]] = []

    def fit(scene: list[str], folder: Path, seed: int, *extra: str) -> dict[str, Any]:
        asked.append(list(extra))
        return {"metrics": {"chamfer": {"mean": chamfer}}, "fit": {"seconds of the fit": 5.0}}

    monkeypatch.setattr(results, "fit", fit)
    stored = tmp_path / "variants.csv"
    whole = results.variants_table(tmp_path, [], stored)
    assert list(whole.variant) == names
    whole.to_csv(stored, index=False)

    asked.clear()
    chamfer = 2.0
    changed = results.variants_table(tmp_path, [names[-1]], stored)
    assert asked == [results.VARIANTS[names[-1]]]
    assert list(changed.variant) == names
    assert list(changed["chamfer x1e4 [m²]"]) == [1.0] * (len(names) - 1) + [2.0]


def test_the_papers_recipe_is_the_fit_of_its_own_benchmark(results: ModuleType, tmp_path: Path) -> None:
    (name,) = results.OF_PAPER_RECIPE
    assert list(results.variants_table(tmp_path, [name], tmp_path / "variants.csv")) == []
    fits = pd.DataFrame(
        {
            "part": "fits",
            "case": ["solver, Eq. 17 as printed", "solver", "solver"],
            "seed": [0, 1, 0],
            "chamfer x1e4 [m²]": [13.0, 6.0, 5.0],
            "silhouette IoU": 0.9,
            "wall [s]": 20.0,
            "cpu [s]": 10.0,
        }
    )
    fits.to_csv(tmp_path / "paper_recipe.csv", index=False)
    (row,) = results.variants_table(tmp_path, [name], tmp_path / "variants.csv").to_dict("records")
    assert (row["chamfer x1e4 [m²]"], row["fit [s]"], row["processor [s]"]) == (5.0, 20.0, 10.0)
    assert row["overrides"] == "`experiment=paper`"


def test_every_row_of_the_documents_is_one_that_the_command_makes(results: ModuleType) -> None:
    docs = BENCHMARKS.parent / "docs" / "results"
    stored = pd.read_csv(docs / "variants.csv")
    assert set(stored.variant) <= set(results.VARIANTS)
    assert (docs / "variants.md").read_text().strip() == results.markdown(stored, ".3g").strip()
