"""Stages run once, are read where they were made from the same, and are told by what they were made from."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from toile.diagnosis.pipeline import Pipeline, PipelineStage
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import StageTimes
from toile.diagnosis.stored_values import ValueStore


@dataclass(frozen=True)
class Number:
    """What a stage of these tests finds."""

    value: float


class Sum:
    """A small method: two numbers, then their sum; counts what is computed."""

    def __init__(self, folder: Path) -> None:
        self.computed: list[str] = []
        self.said: list[tuple[str, float]] = []
        store = StageStore(folder, ValueStore((Number,)), StageTimes())
        self.pipeline = Pipeline(store, lambda what, share: self.said.append((what, share)))

    def given(self, name: str, value: float, setting: str = "a") -> PipelineStage[Number]:
        def compute() -> Number:
            self.computed.append(name)
            return Number(value)

        return PipelineStage(name, f"{name}.npz", f"finding {name}", 0.1, Number, compute, {"set": setting})

    def sum(self) -> PipelineStage[Number, Number, Number]:
        def compute(first: Number, second: Number) -> Number:
            self.computed.append("sum")
            return Number(first.value + second.value)

        return PipelineStage("sum", "sum.npz", "adding", 0.9, Number, compute)

    def run(self, first: float, setting: str = "a") -> float:
        found = self.pipeline.run(self.given("first", first, setting))
        other = self.pipeline.run(self.given("second", 2.0))
        return self.pipeline.run(self.sum(), found, other).value


def test_a_stage_is_computed_again_only_where_what_it_was_made_from_is_another(tmp_path: Path) -> None:
    first = Sum(tmp_path)
    assert first.run(1.0) == 3.0
    assert first.computed == ["first", "second", "sum"]
    assert first.said == [("finding first", 0.1), ("finding second", 0.1), ("adding", 0.9)]
    again = Sum(tmp_path)
    assert again.run(1.0) == 3.0
    assert again.computed == []
    assert again.said == first.said
    # Another setting with the same result: what comes after does not notice.
    same = Sum(tmp_path)
    assert same.run(1.0, "b") == 3.0
    assert same.computed == ["first"]
    other = Sum(tmp_path)
    assert other.run(5.0, "c") == 7.0
    assert other.computed == ["first", "sum"]


def test_a_result_says_which_results_it_was_made_from(tmp_path: Path) -> None:
    Sum(tmp_path).run(1.0)
    with np.load(tmp_path / "sum.npz") as stored:
        assert list(json.loads(str(stored["made_from"]))) == ["first", "second"]
    with np.load(tmp_path / "first.npz") as stored:
        assert json.loads(str(stored["made_from"])) == {"set": "a"}


def test_nothing_but_results_of_earlier_stages_goes_in(tmp_path: Path) -> None:
    sums = Sum(tmp_path)
    found = sums.pipeline.run(sums.given("first", 1.0))
    with pytest.raises(ValueError, match="sum: an input is no result of an earlier stage"):
        sums.pipeline.run(sums.sum(), found, Number(2.0))
    assert sums.computed == ["first"]
