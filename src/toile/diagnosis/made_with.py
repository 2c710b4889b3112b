"""Which settings evidence was made with: probabilities hold for diagnoses with the same ones alone."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from toile import former_names
from toile.atomic_file import write_text
from toile.errors import InputError

MADE_WITH_FILE = "made_with.json"
"""Settings that a diagnosis was made with, beside diagnosis.json."""

NO_EVIDENCE = (
    "diagnosis.calibration",
    "diagnosis.seed",
    "diagnosis.compared",
    "diagnosis.placebos",
    "diagnosis.widened",
    "diagnosis.prediction.block",
    "diagnosis.prediction.resamplings",
    "diagnosis.verdict",
    "simulator.largest_time_error",
)
"""Settings that come after the probabilities of a diagnosis, or beside them; its frames are evenly spaced."""

AFTER_MEASURING = ("diagnosis.weights", "diagnosis.usual_cost")
"""Settings by which evidence is made from what a run has measured; they can be chosen afterwards."""


@dataclass(frozen=True)
class MadeWith:
    """Settings that evidence depends on.

    Attributes:
        settings: numbers, texts and lists of them, by the names they have on the command line, sorted. A part
            that is built by a class has its name as ``..._target_``.
    """

    settings: Mapping[str, Any]

    @staticmethod
    def of(settings: Mapping[str, Any]) -> MadeWith:
        """What matters of a nested configuration."""
        flat = dict(_flat(settings, ""))
        return MadeWith({name: flat[name] for name in sorted(flat) if _matters(name)})

    @property
    def digest(self) -> str:
        """Twelve hexadecimal digits that stand for the settings; 10 and 10.0 are the same."""
        text = json.dumps({name: _canonical(value) for name, value in sorted(self.settings.items())})
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def measuring(self) -> MadeWith:
        """Those of them that matter for what a run has measured, see AFTER_MEASURING."""
        kept = {n: v for n, v in self.settings.items() if not _is_within(n, AFTER_MEASURING)}
        return MadeWith(kept)

    def differences(self, other: MadeWith, there: str = "calibrated with ") -> tuple[str, ...]:
        """What is set otherwise here, one line each, without the parts of what is missing on one side.

        Args:
            other: settings.
            there: said before a value of theirs.
        """
        lines = []
        for name in sorted({*self.settings, *other.settings}):
            ours, theirs = self._said(name), other._said(name)
            if ours != theirs and not (self._lacks_parent(name) or other._lacks_parent(name)):
                lines.append(f"{name}: {ours}, {there}{theirs}")
        return tuple(lines)

    def write(self, path: Path) -> Path:
        """Write the file atomically; returns the path."""
        values = {"digest": self.digest, "settings": dict(self.settings)}
        return write_text(path, json.dumps(values, indent=1) + "\n")

    @staticmethod
    def read(path: Path) -> MadeWith:
        """Read the file.

        Raises:
            InputError: there is none, or it is another one.
        """
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
            found = MadeWith(dict(values["settings"]))
            if values["digest"] != found.digest:
                raise ValueError("the digest is that of other settings")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                "Nothing says with which settings a run was diagnosed",
                where=str(path),
                expected=f"{MADE_WITH_FILE} of toile diagnose; diagnose the scene again",
                got=f"{type(error).__name__}: {error}",
            ) from error
        return found.with_present_names()

    def with_present_names(self) -> MadeWith:
        """The same where settings have had other names before."""
        return MadeWith(former_names.settings(self.settings))

    def _said(self, name: str) -> str:
        if name not in self.settings:
            return "given" if any(n.startswith(f"{name}.") for n in self.settings) else "not there"
        return json.dumps(_canonical(self.settings[name]), ensure_ascii=False).replace('"', "")

    def _lacks_parent(self, name: str) -> bool:
        """Whether a part that this setting belongs to is null here, which has a line of its own."""
        parts = name.split(".")
        above = (".".join(parts[:n]) for n in range(1, len(parts)))
        return any(a in self.settings and self.settings[a] is None for a in above)


def _flat(node: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        name = f"{path}.{key}".lstrip(".")
        if isinstance(value, Mapping):
            yield from _flat(value, name)
        elif key == "_target_":
            # Where a class is kept is no setting.
            yield name, str(value).rpartition(".")[2]
        elif key not in ("_partial_", "_convert_", "_recursive_"):
            yield name, list(value) if isinstance(value, list | tuple) else value


def _canonical(value: Any) -> Any:
    """Whole numbers as others, tuples as lists."""
    if isinstance(value, list | tuple):
        return [_canonical(v) for v in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return int(value) if float(value).is_integer() else float(value)
    return value


def _matters(name: str) -> bool:
    """Whether a setting changes evidence; every part of a diagnosis has one class, whatever its name is."""
    is_class = name.startswith("diagnosis.") and name.endswith("_target_")
    return not is_class and not _is_within(name, NO_EVIDENCE)


def _is_within(name: str, groups: tuple[str, ...]) -> bool:
    return any(name == group or name.startswith(f"{group}.") for group in groups)
