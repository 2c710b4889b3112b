"""Compositions and plans of blind sets, and files that tell nothing."""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from toile.errors import InputError
from toile.generation.out_of_family.blind_set import (
    WRITTEN_AT,
    full_composition,
    plan,
    standard_composition,
    tiny_composition,
    write_opaque,
)
from toile.generation.out_of_family.catalogue import INSIDE, LEVELS, OUTSIDE
from toile.scenes.native import load_native
from toile.scenes.scene import GroundTruth, Scene


def secret(purpose: str) -> bytes:
    return hashlib.sha256(b"key" + purpose.encode()).digest()


def test_sizes() -> None:
    assert tiny_composition().size == 3
    assert standard_composition().size == 60
    assert full_composition().size == 430


@pytest.mark.parametrize("composition", [standard_composition(), full_composition()])
def test_every_effect_is_there(composition) -> None:
    counts = Counter(name for name, _ in composition.singles)
    assert set(counts) == set(INSIDE)
    assert min(counts.values()) >= 2
    assert {name for name, _ in composition.outside} == set(OUTSIDE)
    assert {level for _, level in (*composition.singles, *composition.outside)} <= set(LEVELS)


def test_plan_follows_from_the_key_only() -> None:
    first = plan(standard_composition(), secret)
    assert first == plan(standard_composition(), secret)
    other = plan(standard_composition(), lambda p: secret("other" + p))
    assert {s.name for s in first}.isdisjoint(s.name for s in other)
    assert len({s.name for s in first}) == len({s.seed for s in first}) == 60
    assert [s.name for s in first] == sorted(s.name for s in first)
    assert sum(s.generator == "blender" for s in first) == 20
    pairs = [s.effects for s in first if len(s.effects) == 2]
    assert len(pairs) == 6
    assert all(a[0] != b[0] for a, b in pairs)


def test_order_tells_nothing() -> None:
    kinds = [len(s.effects) == 0 for s in plan(full_composition(), secret)]
    nulls = [k for k, null in enumerate(kinds) if null]
    assert 150 < sum(nulls) / len(nulls) < 280


def test_opaque_files(tiny_scene: Scene, tmp_path: Path) -> None:
    scene = replace(tiny_scene, ground_truth=None)
    folder = write_opaque(scene, tmp_path / "a1")
    assert {int(p.stat().st_mtime) for p in (folder, *folder.rglob("*"))} == {WRITTEN_AT}
    assert not (folder / "ground_truth").exists()
    assert load_native(folder, crop_margin=None).n_frames == scene.n_frames
    with pytest.raises(InputError, match="truth"):
        write_opaque(replace(scene, ground_truth=GroundTruth()), tmp_path / "b2")
