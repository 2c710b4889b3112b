"""Sealed labels: nobody reads or changes them without the key."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from toile.blind.sealing import BlindSet, Sealed, SealKey, is_key_file, read_commitments
from toile.errors import InputError

LABEL = {"effect": "gusts", "magnitude": {"mean_last_third": 3.0}}


def sealed(seed: int = 0) -> Sealed:
    rng = np.random.default_rng(seed)
    vertices = rng.standard_normal((3, 4, 5, 3)).astype(np.float32)
    return Sealed(LABEL, vertices, vertices + np.float32(0.1))


@pytest.fixture
def blind(tmp_path: Path) -> BlindSet:
    return BlindSet(tmp_path / "set")


def test_round_trip_and_commitment(blind: BlindSet) -> None:
    key = SealKey.fresh()
    blind.seal(key, "a1", sealed())
    blind.commit(key, ("a1",))
    opened = blind.open(key, "a1")
    assert opened.label == LABEL
    np.testing.assert_array_equal(opened.vertices, sealed().vertices)
    np.testing.assert_array_equal(opened.twin, sealed().twin)
    label = json.dumps(LABEL, sort_keys=True).encode()
    expected = hashlib.sha256(label + key.derive("nonce a1")).hexdigest()
    assert read_commitments(blind.commitments) == {"a1": expected}


def test_nothing_is_readable_and_sizes_tell_nothing(blind: BlindSet) -> None:
    key = SealKey.fresh()
    same = Sealed({"effect": "none"}, sealed().vertices, sealed().vertices)
    blind.seal(key, "a1", sealed())
    blind.seal(key, "b2", same)
    first, second = (blind.sealed_file(name).read_bytes() for name in ("a1", "b2"))
    assert b"gusts" not in first
    assert len(first) == len(second)
    # A fresh nonce every time: equal contents leave no equal bytes.
    blind.seal(key, "a1", sealed())
    assert blind.sealed_file("a1").read_bytes()[32:96] != first[32:96]


def test_other_key_and_changed_file(blind: BlindSet) -> None:
    key = SealKey.fresh()
    path = blind.seal(key, "a1", sealed())
    blind.commit(key, ("a1",))
    with pytest.raises(InputError, match="cannot be opened"):
        blind.open(SealKey.fresh(), "a1")
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="cannot be opened"):
        blind.open(key, "a1")


def test_label_swapped_after_commitment(blind: BlindSet) -> None:
    key = SealKey.fresh()
    blind.seal(key, "a1", sealed())
    blind.commit(key, ("a1",))
    blind.seal(key, "a1", Sealed({"effect": "none"}, sealed().vertices, sealed().twin))
    with pytest.raises(InputError, match="committed"):
        blind.open(key, "a1")


def test_key_file(tmp_path: Path) -> None:
    key = SealKey.fresh()
    path = key.write(tmp_path / "a.blindkey")
    assert SealKey.read(path).fingerprint == key.fingerprint
    assert path.stat().st_mode & 0o077 == 0
    renamed = path.rename(tmp_path / "notes.txt")
    assert is_key_file(renamed)
    assert SealKey.of_seed(1).fingerprint == SealKey.of_seed(1).fingerprint != SealKey.of_seed(2).fingerprint
    with pytest.raises(InputError, match="key"):
        SealKey.read(tmp_path / "none")
