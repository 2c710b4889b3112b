"""What programs on sessions with open labels share."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from toile.diagnosis.session_stages import RefinedMotion

ROOT = Path(__file__).parents[2]


@pytest.fixture
def ladder(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which imports others beside it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("session_ladder")


def test_the_right_answer_is_its_name_none_or_unknown(ladder: ModuleType) -> None:
    said = {"gusts": 0.7, "unknown": 0.2, "none": 0.1}
    right = {cause: ladder.answer_columns(said, cause) for cause in ("gusts", "none", "shrinking", "contact")}
    assert {cause: row["right answer"] for cause, row in right.items()} == {
        "gusts": 0.7,
        "none": 0.1,
        "shrinking": 0.2,  # the catalogue lacks it
        "contact": 0.0,  # in the catalogue, and not among what was said
    }
    assert all(row["first"] == "gusts" and row["its probability"] == 0.7 for row in right.values())


def test_a_motion_is_off_by_shares_of_the_width_in_every_clip(ladder: ModuleType, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scene = SimpleNamespace(cloth_size=(0.5, 0.8))
    clips = [SimpleNamespace(n_frames=n, problem=SimpleNamespace(scene=scene)) for n in (3, 4)]
    true = [rng.standard_normal((clip.n_frames, 2, 5, 3)).astype(np.float32) for clip in clips]
    for k, one in enumerate(true):
        np.save(tmp_path / f"truth_{k}.npy", one)
    moved = [one.reshape(len(one), -1, 3).astype(np.float64) for one in true]
    moved[1] = moved[1] + np.array([0.0, 0.03, 0.04])
    first, second = ladder.off_by(tmp_path, clips, RefinedMotion(moved, None))
    assert first.shape == (3, 10)
    assert np.all(first == 0)
    np.testing.assert_allclose(second, 0.1)
