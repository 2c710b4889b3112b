"""Compositions and plans of sets of sessions."""

from __future__ import annotations

import hashlib
from collections import Counter

from toile.effects.catalogue import STAGES
from toile.generation.out_of_family.catalogue import INSIDE, OUTSIDE
from toile.generation.out_of_family.making import SIZES
from toile.generation.out_of_family.session_set import (
    MOVING,
    PlannedSession,
    Sized,
    effects_sessions_composition,
    medium_sessions_composition,
    outside_sessions_composition,
    plan_sessions,
    sessions_composition,
    tiny_sessions_composition,
)


def secret(purpose: str) -> bytes:
    return hashlib.sha256(b"key" + purpose.encode()).digest()


def test_the_composition() -> None:
    composition = sessions_composition()
    assert composition.size == 60
    assert composition.nulls == 20
    assert {name for name, _ in composition.singles} == set(INSIDE)
    assert {name for name, _ in composition.outside} == set(OUTSIDE)
    sizes = Counter(size for name, size in composition.singles if name in MOVING)
    assert set(sizes) == set(SIZES)
    assert sizes[1.0] == sizes[7.0] == 6
    assert tiny_sessions_composition().size == 3
    medium = medium_sessions_composition()
    assert {name for name, _ in medium.singles} == set(MOVING)
    assert {size for _, size in medium.singles} == {3.0}
    assert medium.nulls >= len(MOVING) / 4
    effects = effects_sessions_composition()
    assert effects.singles == medium.singles
    assert effects.size == len(MOVING)
    asked = outside_sessions_composition()
    assert asked.size == 12
    assert asked.nulls == 4
    assert {name for name, _ in asked.singles} < set(MOVING)
    assert {name for name, _ in asked.outside} == set(OUTSIDE) - {"unmasked_occluder"}


def planned(can_make=lambda generator, effects: True) -> tuple[PlannedSession, ...]:
    return plan_sessions(sessions_composition(), secret, can_make=can_make)


def test_the_plan() -> None:
    sessions = planned()
    assert sessions == planned()
    assert len({s.name for s in sessions}) == len({s.seed for s in sessions}) == 60
    for sharing in (sessions, [s for s in sessions if not s.effects]):
        counts = Counter(s.generator for s in sharing)
        assert len(counts) == 3
        assert max(counts.values()) - min(counts.values()) <= 2
    pairs = [s.effects for s in sessions if len(s.effects) == 2]
    assert len(pairs) == 5
    assert sum(STAGES[a] is STAGES[b] for (a, _), (b, _) in pairs) == 2
    assert all(a != b for (a, _), (b, _) in pairs)


def test_what_an_engine_lacks_goes_to_another_one() -> None:
    def can_make(generator: str, effects: Sized) -> bool:
        return len(effects) < 2 and all(name != "contact" for name, _ in effects)

    for session in planned(can_make):
        if session.generator != "toile":
            assert can_make(session.generator, session.effects)
