"""Results of stages: the same bits when read back, and used only where they were made from the same."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from toile.diagnosis.continuity import Discrepancy
from toile.diagnosis.evidence import EvidenceSettings
from toile.diagnosis.fingerprint import code_fingerprint, fingerprint
from toile.diagnosis.outline_cue import OutlineSettings
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.shrinkage import PredictionSettings
from toile.diagnosis.stage_store import Result, StageStore
from toile.diagnosis.stage_times import StageTimes, read_times
from toile.diagnosis.stages import (
    ANSWER,
    BASE_MODEL,
    CONVERGED_BASE,
    FILES,
    HELD_OUT,
    IMAGES,
    REFITS,
    TRACKING,
    WINDOW_PREDICTIONS,
    settings_of,
)
from toile.diagnosis.stored_values import ValueStore
from toile.effects.catalogue import CATALOGUE


@dataclass(frozen=True)
class Thing:
    """Something that a stage may find."""

    numbers: np.ndarray
    parts: dict[str, Any]


@dataclass(frozen=True)
class Stranger:
    """Something that no stage knows."""

    number: float = 0.0


VALUES = ValueStore((Thing, Discrepancy), [CATALOGUE["gusts"]()])


def thing() -> Thing:
    gusts = CATALOGUE["gusts"]()
    gusts = gusts.with_values(torch.linspace(-1, 1, len(gusts.values), dtype=torch.float64) / 3)
    numbers = np.asfortranarray(np.random.default_rng(0).normal(size=(3, 4)))
    parts = {
        "of all kinds": [None, True, 7, 1 / 3, float("inf"), "text", (1, (2.5, "x")), []],
        "single": np.arange(3, dtype=np.float32),
        "whole": np.array([], int),
        "size": Discrepancy(np.float64(0.1), 0.2),
        "gusts": gusts,
        "tensor": torch.tensor([[1 / 3]], dtype=torch.float64),
    }
    return Thing(numbers, parts)


def store(folder: Path) -> StageStore:
    return StageStore(folder, VALUES, StageTimes.going_on(folder / "times.json"))


def found(folder: Path, inputs: dict[str, str], made: Callable[[], Thing] = thing) -> Result[Thing]:
    return store(folder).result("stage", "stages/stage.npz", Thing, inputs, made)


def never() -> Thing:
    raise AssertionError("computed again")


def same(a: Any, b: Any) -> None:
    assert fingerprint(a) == fingerprint(b)


def test_what_is_read_back_is_what_was_stored(tmp_path: Path) -> None:
    first = found(tmp_path, {"scene": "a"})
    again = found(tmp_path, {"scene": "a"}, never)
    for result in (first, again):
        same(result.value, thing())
        assert result.value.numbers.flags.f_contiguous
        assert isinstance(result.value.parts["size"], Discrepancy)
        assert type(result.value.parts["gusts"]) is type(CATALOGUE["gusts"]())
    assert first.digest == again.digest
    assert read_times(tmp_path / "times.json")["stage"].cached


@pytest.mark.parametrize(
    ("inputs", "named"),
    [
        ({"scene": "b", "settings.sides": "c"}, "other scene"),
        ({"scene": "a", "settings.sides": "d", "tracking": "e"}, "other settings.sides, tracking"),
        ({"scene": "a"}, "other settings.sides"),
    ],
)
def test_made_from_something_else_it_is_computed_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, inputs: dict[str, str], named: str
) -> None:
    found(tmp_path, {"scene": "a", "settings.sides": "c"})
    other = Thing(np.zeros(2), {})
    with caplog.at_level(logging.INFO):
        assert found(tmp_path, inputs, lambda: other).digest == VALUES.flat(other).digest
    (line,) = caplog.messages
    assert line.startswith("stage: computed again")
    assert line.endswith(named)
    found(tmp_path, inputs, never)


def test_a_file_that_cannot_be_read_is_computed_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "stages" / "stage.npz"
    digest = found(tmp_path, {}).digest
    whole = path.read_bytes()
    for spoilt in (whole[: len(whole) // 2], b"", np.lib.format.magic(1, 0)):
        path.write_bytes(spoilt)
        caplog.clear()
        with caplog.at_level(logging.INFO):
            assert found(tmp_path, {}).digest == digest
        assert "cannot be read" in caplog.messages[0]


def test_nothing_but_known_kinds_is_ever_made(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Neither pickles nor classes that a file names."""
    path = tmp_path / "stages" / "stage.npz"
    path.parent.mkdir()
    about = {"made_from": np.array("{}")}
    trees = (
        json.dumps({"kind": "Stranger", "fields": {}}),
        json.dumps({"kind": "Thing", "fields": {"numbers": 1}}),
        json.dumps({"kind": "effect", "name": "air_drag", "values": []}),
        json.dumps([1]),
    )
    for tree in trees:
        np.savez(path, tree=np.array(tree), **about)
        same(found(tmp_path, {}).value, thing())
    np.savez(path, tree=np.array([Stranger()], object), **about)
    caplog.clear()  # an earlier test may have left the logger at a level that records the above
    with caplog.at_level(logging.INFO):
        same(found(tmp_path, {}).value, thing())
    assert "Object arrays cannot be loaded" in caplog.messages[0]
    for stranger in (Stranger(), {"a": Stranger()}, np.array([None]), {1: 2}, CATALOGUE["air_drag"]()):
        with pytest.raises(TypeError, match=r"cannot be stored|none of the effects"):
            VALUES.flat(stranger)


def test_a_stage_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    found(tmp_path, {"scene": "a"})
    with pytest.raises(AssertionError, match="again"):
        found(tmp_path, {"scene": "b"}, never)
    found(tmp_path, {"scene": "a"}, never)
    assert [p.name for p in (tmp_path / "stages").iterdir()] == ["stage.npz"]


def test_digests_tell_contents_apart() -> None:
    numbers = np.arange(4.0)
    others = [
        Thing(numbers, {}),
        Thing(np.nextafter(numbers, 9), {}),
        Thing(numbers.reshape(2, 2), {}),
        Thing(numbers.astype(np.float32), {}),
        Thing(numbers, {"a": 1}),
    ]
    assert len({VALUES.flat(other).digest for other in others}) == len(others)


def outside(x: float) -> float:
    return x


def test_fingerprints_tell_contents_apart() -> None:
    values: list[Any] = [
        None,
        1,
        1.0,
        True,
        "1",
        [1],
        (1,),
        [1, [2]],
        [[1], 2],
        {"a": 1},
        {"b": 1},
        np.ones(2),
        np.ones((2, 1)),
        Stranger(),
        Stranger(1.0),
        CATALOGUE["gusts"](),
        CATALOGUE["air_drag"](),
        CATALOGUE["air_drag"]({"linear": 0.5}),
        outside,
        partial(outside, 1.0),
        partial(outside, 2.0),
        torch.nn.Linear(1, 1),
    ]
    assert len({fingerprint(value) for value in values}) == len(values)
    assert fingerprint("ab", "c") != fingerprint("a", "bc")
    assert fingerprint(DiagnosisSettings()) == fingerprint(DiagnosisSettings())
    for unknown in (lambda: None, object(), np.array([None])):
        with pytest.raises(TypeError, match="no fingerprint"):
            fingerprint(unknown)


def test_the_code_has_a_fingerprint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from toile import __version__
    from toile.diagnosis import fingerprint as module

    assert code_fingerprint().startswith(f"{__version__} ")

    def of(*files: str) -> str:
        for file in files:
            path = tmp_path / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"changed for {file}")
        return code_fingerprint.__wrapped__()

    monkeypatch.setattr(module, "files", lambda name: tmp_path)
    first = of("physics/cloth.py", "cli/main.py")
    assert of("cli/main.py", "cli/more.py", "physics/__pycache__/cloth.pyc", "__pycache__/a.py") == first
    second = of("workers.py")
    assert second != first
    assert of("physics/bending.py") not in (first, second)


def test_stages_depend_on_the_settings_that_they_ask_for() -> None:
    """And what nobody has put in its place counts for all of them."""

    @dataclass(frozen=True)
    class Later(DiagnosisSettings):
        new: int = 0

    def changed(stage: str, **other: Any) -> bool:
        return settings_of(stage, Later(**other)) != settings_of(stage, Later())

    assert changed(TRACKING, stiffness=(1.0, 1.0, 1.0))
    assert changed(TRACKING, new=1)
    assert changed(TRACKING, seed=1)
    assert not changed(IMAGES, longest_substep=0.01)
    assert changed(BASE_MODEL, longest_substep=0.01)
    assert not changed(BASE_MODEL, base_refits=1)
    assert changed(CONVERGED_BASE, base_refits=1)
    assert changed(HELD_OUT, base_refits=1)
    assert changed(TRACKING, least_overlap=0.5)
    assert not changed(TRACKING, outline=OutlineSettings(steps=50))
    assert changed(IMAGES, outline=OutlineSettings(steps=50))
    assert not changed(BASE_MODEL, evidence=EvidenceSettings(prior_inflation=2.0))
    assert changed(CONVERGED_BASE, evidence=EvidenceSettings(prior_inflation=2.0))
    assert not changed(REFITS, prediction=PredictionSettings(failed=-2.0))
    assert changed(WINDOW_PREDICTIONS, prediction=PredictionSettings(failed=-2.0))
    for after in ({"usual_cost": 1.0}, {"widened": 1.0}, {"calibration": "mine.json"}):
        assert not any(changed(stage, **after) for stage in FILES)
        assert changed(ANSWER, **after)
