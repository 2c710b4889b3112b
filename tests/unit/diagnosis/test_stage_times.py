"""Times of stages add up, survive a failure, and those of cached stages are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from toile.diagnosis import stage_times
from toile.diagnosis.stage_times import StageTimes, read_times
from toile.errors import InputError


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Seconds that pass, one entry for wall and half of it for the process."""
    now = [0.0]
    monkeypatch.setattr(stage_times.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(stage_times.time, "process_time", lambda: now[0] / 2)
    return now


def test_stages_add_up_in_their_order(clock: list[float], tmp_path: Path) -> None:
    times = StageTimes()
    for name, seconds in (("tracking", 8.0), ("maps", 1.0), ("tracking", 2.0)):
        with times.stage(name):
            clock[0] += seconds
    times.write(tmp_path / "times.json")
    found = read_times(tmp_path / "times.json")
    assert list(found) == ["tracking", "maps"]
    assert (found["tracking"].wall, found["tracking"].cpu) == (10.0, 5.0)
    assert not found["tracking"].cached


def test_time_of_a_stage_that_fails_counts(clock: list[float], tmp_path: Path) -> None:
    times = StageTimes()

    def fail() -> None:
        with times.stage("tracking"):
            clock[0] += 3.0
            raise ValueError("lost")

    with pytest.raises(ValueError, match="lost"):
        fail()
    times.write(tmp_path / "times.json")
    assert read_times(tmp_path / "times.json")["tracking"].wall == 3.0


def test_a_cached_stage_keeps_the_time_of_making_it(clock: list[float], tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    first = StageTimes()
    with first.stage("tracking"):
        clock[0] += 100.0
    first.write(path)
    for _ in range(2):
        second = StageTimes.going_on(path)
        with second.stage("tracking"):
            clock[0] += 0.5
        second.from_cache("tracking")
        with second.stage("maps"):
            clock[0] += 4.0
        second.write(path)
        found = read_times(path)
        assert found["tracking"].cached
        assert found["tracking"].wall == 100.0
        assert found["maps"].wall == 4.0
        assert not found["maps"].cached


def test_cached_without_an_earlier_file_is_marked(clock: list[float], tmp_path: Path) -> None:
    times = StageTimes()
    with times.stage("tracking"):
        clock[0] += 0.5
    times.from_cache("tracking")
    times.write(tmp_path / "times.json")
    found = read_times(tmp_path / "times.json")["tracking"]
    assert found.cached
    assert found.wall is None


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "times.json").write_text("[]")
    with pytest.raises(InputError, match="Times"):
        read_times(tmp_path / "times.json")
