"""How long each stage of a diagnosis takes: ``times.json``, beside a ``diagnosis.json`` without times."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.json_file import read_json_object

TIMES_FILE = "times.json"


@dataclass(frozen=True)
class StageTime:
    """What one stage took.

    Attributes:
        wall: [s]; None if it was read back, and nothing says how long it took when it was made.
        cpu: of this process, all its threads [s]; None likewise.
        cached: whether its result was made by an earlier run, which is when it took this long.
    """

    wall: float | None
    cpu: float | None
    cached: bool = False


class StageTimes:
    """Clock of the stages of one run; the same stage may come several times, and its times add up.

    Args:
        earlier: what stages took in an earlier run in the same folder.
    """

    def __init__(self, earlier: Mapping[str, StageTime] | None = None) -> None:
        self._earlier = dict(earlier or {})
        self._seconds: dict[str, tuple[float, float]] = {}
        self._cached: set[str] = set()

    @classmethod
    def going_on(cls, path: Path) -> StageTimes:
        """The clock of a run whose folder may hold the times of an interrupted one.

        Raises:
            InputError: the file that is there cannot be understood.
        """
        return cls(read_times(path) if path.is_file() else None)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what happens inside to a stage, even if it fails."""
        wall, cpu = time.perf_counter(), time.process_time()
        # Its place in the order is that of its first beginning.
        self._seconds.setdefault(name, (0.0, 0.0))
        try:
            yield
        finally:
            before = self._seconds[name]
            self._seconds[name] = (
                before[0] + time.perf_counter() - wall,
                before[1] + time.process_time() - cpu,
            )

    def from_cache(self, name: str) -> None:
        """Note that a stage's result was only read back: what counts is the time of making it."""
        self._seconds.setdefault(name, (0.0, 0.0))
        self._cached.add(name)

    def write(self, path: Path) -> Path:
        """Write all: for cached ones what they took when made, and what is known of those to come."""
        unknown = StageTime(None, None)
        stages = {}
        for name, (wall, cpu) in self._seconds.items():
            if name in self._cached:
                made = self._earlier.get(name, unknown)
                stages[name] = StageTime(made.wall, made.cpu, cached=True)
            else:
                stages[name] = StageTime(wall, cpu)
        # Another interruption must not lose them.
        stages.update({name: taken for name, taken in self._earlier.items() if name not in stages})
        values = {name: asdict(taken) for name, taken in stages.items()}
        return write_text(path, json.dumps({"stages": values}, indent=1) + "\n")


def read_times(path: Path) -> dict[str, StageTime]:
    """Times by stage.

    Raises:
        InputError: there is no such file, or another one.
    """
    try:
        values = read_json_object(path)["stages"]
        return {
            str(name): StageTime(_seconds(v["wall"]), _seconds(v["cpu"]), bool(v["cached"]))
            for name, v in values.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            "Times cannot be understood",
            where=str(path),
            expected=f"{TIMES_FILE} of toile diagnose",
            got=f"{type(error).__name__}: {error}",
        ) from error


def _seconds(value: float | None) -> float | None:
    return None if value is None else float(value)
