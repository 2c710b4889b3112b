"""Results of a diagnosis' stages in its folder, each with what it was made from.

A result is used again only where all of that is the same: the scene's data, the settings that have a say in
it, the results that it was computed from, and the code. Files hold arrays and plain text (see stored_values).
"""

from __future__ import annotations

import json
import logging
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from toile.atomic_file import written_atomically
from toile.diagnosis.stage_times import TIMES_FILE, StageTimes
from toile.diagnosis.stored_values import Flat, ValueStore

log = logging.getLogger(__name__)

T = TypeVar("T")

# Names of what stands beside the arrays of a result.
_TREE, _INPUTS = "tree", "made_from"


@dataclass(frozen=True)
class Result(Generic[T]):
    """What a stage has found.

    Attributes:
        stage: name.
        value: of the stage.
        digest: of its content; what is computed from it is made from this.
    """

    stage: str
    value: T
    digest: str


class StageStore:
    """Results in one folder.

    Args:
        folder: of the run.
        values: how they are stored.
        times: of the stages; written after each.
    """

    def __init__(self, folder: Path, values: ValueStore, times: StageTimes) -> None:
        self._folder = folder
        self._values = values
        self._times = times

    def result(
        self, stage: str, file: str, kind: type[T], inputs: Mapping[str, str], compute: Callable[[], T]
    ) -> Result[T]:
        """The stage's result: the stored one if it was made from the same, a new one otherwise.

        A new one is read back as well, so that an answer hangs on what is stored, whoever has stored it.

        Args:
            stage: name, for times and log.
            file: path within the folder.
            kind: class of the result.
            inputs: fingerprints of all that the result is made from, by name.
            compute: makes it.
        """
        path = self._folder / file
        found = self._read(stage, path, kind, inputs)
        try:
            if isinstance(found, Result):
                log.info("%s: taken from %s", stage, path)
                self._times.from_cache(stage)
                return found
            if found:
                log.info("%s: computed again, %s %s", stage, path, found)
            with self._times.stage(stage):
                self._write(path, compute(), inputs)
                made = self._read(stage, path, kind, inputs)
        finally:
            self._times.write(self._folder / TIMES_FILE)
        if not isinstance(made, Result):
            raise RuntimeError(f"{stage}: what was just stored {made}")
        return made

    def _write(self, path: Path, value: object, inputs: Mapping[str, str]) -> None:
        flat = self._values.flat(value)
        about: dict[str, Any] = {_TREE: np.array(flat.tree), _INPUTS: np.array(json.dumps(dict(inputs)))}
        with written_atomically(path) as temporary:
            np.savez(temporary, allow_pickle=False, **about, **flat.arrays)

    def _read(self, stage: str, path: Path, kind: type[T], inputs: Mapping[str, str]) -> Result[T] | str:
        """The stored result, or why it cannot be used; "" where there is none."""
        if not path.is_file():
            return ""
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                if _INPUTS not in stored or _TREE not in stored:
                    return "does not say what it was made from"
                before = json.loads(str(stored[_INPUTS]))
                names = [*inputs, *(name for name in before if name not in inputs)]
                changed = [name for name in names if inputs.get(name) != before.get(name)]
                if changed:
                    return f"was made from other {', '.join(changed)}"
                flat = Flat(
                    str(stored[_TREE]),
                    {name: stored[name] for name in stored if name not in (_TREE, _INPUTS)},
                )
            value = self._values.value(flat)
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            EOFError,
            zipfile.BadZipFile,
        ) as error:
            return f"cannot be read ({type(error).__name__}: {error})"
        if not isinstance(value, kind):
            return f"holds a {type(value).__name__}"
        return Result(stage, value, flat.digest)
