"""The leak test finds what is there and nothing else."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pandas as pd
import pytest

from toile.blind.leak import PLANTED, file_statistics, leak, leaks, power
from toile.errors import InputError

CLASSES = ["none"] * 15 + ["effect"] * 45


def test_no_leak_in_noise() -> None:
    statistics = np.random.default_rng(3).standard_normal((60, 8))
    found = leak("effect or none", statistics, CLASSES, permutations=40)
    assert found.chance_low <= found.accuracy <= found.chance_high
    assert found.p_value > 0.025
    assert abs(0.5 * (found.chance_low + found.chance_high) - 0.5) < 0.1


def test_leak_is_found() -> None:
    statistics = np.random.default_rng(3).standard_normal((60, 8))
    statistics[15:, 2] += 3.0
    found = leak("effect or none", statistics, CLASSES, permutations=40)
    assert found.accuracy > 0.85 > found.chance_high
    assert found.p_value == pytest.approx(1 / 41)
    assert found == leak("effect or none", statistics, CLASSES, permutations=40)


def test_constant_statistics_are_chance() -> None:
    found = leak("effect or none", np.ones((60, 3)), CLASSES, permutations=4)
    assert found.accuracy == 0.5


def test_too_few_scenes() -> None:
    with pytest.raises(InputError, match="few"):
        leak("effect or none", np.ones((6, 3)), ["none"] + ["effect"] * 5)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Files of a scene, as far as their statistics go."""
    folder = tmp_path / "scene"
    rng = np.random.default_rng(0)
    for name in ("rgbs", "masks"):
        (folder / name).mkdir(parents=True)
    for frame in range(4):
        mask = np.zeros((16, 20), np.uint8)
        mask[4:12, 5 + frame : 15] = 255
        image = rng.integers(60, 120, (16, 20, 3), dtype=np.uint8) * (mask[..., None] > 0)
        iio.imwrite(folder / "rgbs" / f"rgb_{frame:03d}.png", image)
        iio.imwrite(folder / "masks" / f"mask_{frame:03d}.png", mask)
    (folder / "template.obj").write_text("v 0 0 0")
    values = {"fps": 25.0, "K": [[300.0, 0, 10], [0, 300.0, 8], [0, 0, 1]], "gravity": [0, 9.81, 0]}
    (folder / "scene.json").write_text(json.dumps(values))
    for path in folder.rglob("*"):
        os.utime(path, (1000, 1000))
    return folder


def changed(scene: Path, tmp_path: Path, what: str) -> set[str]:
    """Names of the statistics that differ after one change to the files."""
    other = tmp_path / "other"
    shutil.copytree(scene, other)
    if what == "key":
        values = json.loads((other / "scene.json").read_text())
        (other / "scene.json").write_text(json.dumps({**values, "files": {"a": 1}}))
        os.utime(other / "scene.json", (1000, 1000))
    elif what == "time":
        for path in other.rglob("*"):
            os.utime(path, (1001, 1001))
    elif what == "brightness":
        for path in (other / "rgbs").iterdir():
            iio.imwrite(path, (iio.imread(path) * 1.2).astype(np.uint8))
            os.utime(path, (1000, 1000))
    first, second = file_statistics(scene), file_statistics(other)
    return {name for name in first if first[name] != second[name]}


def test_statistics_of_the_files(scene: Path, tmp_path: Path) -> None:
    assert changed(scene, tmp_path, "nothing") == set()


def test_a_key_a_time_stamp_and_brightness_show(scene: Path, tmp_path: Path) -> None:
    assert changed(scene, tmp_path / "a", "key") == {"json_keys", "scene_json"}
    assert changed(scene, tmp_path / "b", "time") == {"time_stamp"}
    found = changed(scene, tmp_path / "c", "brightness")
    assert {"brightness", "contrast"} <= found
    assert "mask_area" not in found


def set_of(n: int = 40) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Statistics without a leak, and labels of two generators."""
    rng = np.random.default_rng(1)
    statistics = pd.DataFrame(
        {
            "files": np.full(n, 5.0),
            "json_keys": np.full(n, 20.0),
            "time_stamp": np.full(n, 1000.0),
            "brightness": rng.uniform(0.3, 0.6, n),
            "mask_area": rng.uniform(0.2, 0.4, n),
            "motion": rng.standard_normal(n),
        }
    )
    effects = ["none"] * 10 + ["air_drag", "gusts", "shading"] * ((n - 10) // 3)
    stages = {"none": "none", "air_drag": "mechanics", "gusts": "actuation", "shading": "appearance"}
    truth = pd.DataFrame(
        {"generator": ["toile"] * n, "effect": effects, "stage": [stages[e] for e in effects]}
    )
    return statistics, truth


def test_questions_by_generator() -> None:
    statistics, truth = set_of()
    found = leaks(statistics, truth, permutations=20).set_index("question")
    assert list(found.index) == ["effect or none", "stage", "effect"]
    assert (found["p_value"] > 0.05).all()
    statistics["time_stamp"] += 1.0 * (truth["stage"] == "actuation")
    assert leaks(statistics, truth, permutations=20).set_index("question").loc["stage", "p_value"] < 0.05
    # Three nulls of another generator are enough for as many folds, one is not.
    truth.loc[[0, 1, 2, *range(11, 20)], "generator"] = "blender"
    assert "effect or none" in set(
        leaks(statistics, truth, permutations=2).query("generator=='blender'").question
    )
    truth.loc[1:2, "generator"] = "toile"
    asked = set(leaks(statistics, truth, permutations=2).query("generator=='blender'").question)
    assert "effect or none" not in asked


def test_planted_leaks_are_found_and_shuffled_labels_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    key, nothing = "one more key in scene.json", "nothing (shuffled labels)"
    monkeypatch.setattr("toile.blind.leak.PLANTED", {name: PLANTED[name] for name in (key, nothing)})
    found = power(*set_of(), draws=10).set_index("planted")["found"]
    assert found[key] == 1.0
    assert found[nothing] <= 0.3
