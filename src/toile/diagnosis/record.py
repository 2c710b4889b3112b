"""What a diagnosis answers: the contents of ``diagnosis.json``, read and written with every key checked.

Keys of the file:

- ``format``: 2. Files without it are of the first format, and are read as well. They may have ``oracle`` in
  ``shrink`` and ``gap`` in ``effects``, which no diagnosis has ever filled (they ask for the truth, and for a
  simulation that a diagnosis does not do); both are dropped.
- ``verdict``: ``effect`` (a catalogue name, ``none``, ``ambiguous`` or ``unknown``), ``candidates``,
  ``stage``, ``probability``, ``reason``, ``next_recording``
- ``where``: ``stages`` {name: share}, ``frames`` [score], ``vertices`` (path of an (H, W) array beside the
  file), ``regimes`` {name: score}
- ``effects``: [{``name``, ``stage``, ``probability``, ``parameters`` {name: {``estimate``, ``low``, ``high``,
  ``unit``}}, ``shrink`` {``metric``, ``held_out``, ``base``, ``with_effect``, ``estimate``, ``low``,
  ``high``, ``best_placebo``}}], most probable first
- ``alias``: ``names``, ``matrix``, ``detection_limits`` {name: number}
- ``protocol``: ``seed``, ``frames_used``, ``frames_held_out``, ``version``, ``naive``
- ``calibration``: ``calibrated``, ``file``, ``settings``, ``made_for``, ``differences`` [text]
- ``warnings``: [text], what is remarkable about the scene

Numbers that do not exist are null. Keys that are not listed are refused: a typing error must not pass for a
missing answer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.json_file import read_json_object

DIAGNOSIS_FILE = "diagnosis.json"

FORMAT = 2
"""Of what is written; older ones are read."""

NONE = "none"
"""Verdict: the base model explains the clip."""
AMBIGUOUS = "ambiguous"
"""Verdict: one of the candidates, and the clip cannot tell which."""
UNKNOWN = "unknown"
"""Verdict: something that is not in the catalogue."""


@dataclass(frozen=True)
class Estimate:
    """A number with its interval.

    Attributes:
        estimate, low, high: in the unit.
        unit: SI, "1" for pure numbers.
    """

    estimate: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Shrink:
    """How far the held-out error falls with an effect in the model.

    Attributes:
        metric: what is measured, with its unit, e.g. "position [mm]".
        held_out: what it was measured on, e.g. "frames 30 to 39".
        base: error of the refitted base model.
        with_effect: error with the effect.
        estimate, low, high: (base - with_effect) / base and its interval.
        best_placebo: the same share for the best placebo, None where none was run.
    """

    metric: str
    held_out: str
    base: float
    with_effect: float
    estimate: float
    low: float
    high: float
    best_placebo: float | None = None


@dataclass(frozen=True)
class EffectReport:
    """One candidate.

    Attributes:
        name: in the catalogue.
        stage: see effects.base.Stage.
        probability: that this effect is what the model lacks.
        parameters: estimates by name.
        shrink: None where the candidate was not refitted.
    """

    name: str
    stage: str
    probability: float
    parameters: dict[str, Estimate] = field(default_factory=dict)
    shrink: Shrink | None = None


@dataclass(frozen=True)
class Verdict:
    """The answer.

    Attributes:
        effect: a catalogue name, NONE, AMBIGUOUS or UNKNOWN.
        candidates: the 90 % confidence set of names, most probable first; may hold NONE and UNKNOWN. For two
            effects at once, see ``also``.
        stage: of the effect, or NONE or UNKNOWN.
        probability: of the answer.
        reason: one or two sentences for people.
        next_recording: what to record next if the clip cannot tell, "" otherwise.
        also: a second effect that acts beside ``effect``, or None.
    """

    effect: str
    candidates: tuple[str, ...]
    stage: str
    probability: float
    reason: str
    next_recording: str
    also: str | None = None


@dataclass(frozen=True)
class Where:
    """Where the gap lies.

    Attributes:
        stages: share of the gap by stage.
        frames: score of every frame, mean distance of base model and tracked motion over the clip's median.
        vertices: path, relative to the file, of an (H, W) array of scores (.npy), None if not written.
        regimes: score by regime, e.g. "slack".
    """

    stages: dict[str, float]
    frames: tuple[float, ...]
    vertices: str | None
    regimes: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Alias:
    """What the clip can tell apart.

    Attributes:
        names: of effects (and base parameters).
        matrix: |cosine| between the traces that base fits leave of each pair, names × names.
        detection_limits: smallest detectable strength by name, in the unit of the effect's first parameter;
            None where no strength within its bounds is.
    """

    names: tuple[str, ...] = ()
    matrix: tuple[tuple[float, ...], ...] = ()
    detection_limits: dict[str, float | None] = field(default_factory=dict)

    def classes(self, threshold: float) -> tuple[tuple[str, ...], ...]:
        """Names that hang together by entries of at least ``threshold``, as connected components."""
        import numpy as np  # reading an answer needs neither
        from scipy.sparse.csgraph import connected_components

        n = len(self.names)
        count, class_of = connected_components(np.reshape(self.matrix, (n, n)) >= threshold, directed=False)
        members = [np.flatnonzero(class_of == k) for k in range(count)]
        return tuple(tuple(self.names[i] for i in group) for group in members)


@dataclass(frozen=True)
class Protocol:
    """How the diagnosis was made.

    Attributes:
        seed: of everything random.
        frames_used: indices of the frames that were fitted.
        frames_held_out: indices of the frames that were not.
        version: of the package and the method.
        naive: the candidate with the largest drop of the training loss, the baseline to beat; "" if unknown.
    """

    seed: int
    frames_used: tuple[int, ...]
    frames_held_out: tuple[int, ...]
    version: str
    naive: str = ""


@dataclass(frozen=True)
class CalibrationUse:
    """Whether the probabilities are calibrated for the settings that the diagnosis was made with.

    Attributes:
        calibrated: whether the calibration belongs to these settings.
        file: that it comes from, "" for the package's own.
        settings: digest of the diagnosis' settings that matter, "" if they are not known.
        made_for: digest of those that the calibration belongs to, "" if it does not say so.
        differences: what is set otherwise, one line each.
    """

    calibrated: bool
    file: str
    settings: str
    made_for: str
    differences: tuple[str, ...] = ()


@dataclass(frozen=True)
class GapReport:
    """The whole of ``diagnosis.json``.

    Attributes:
        verdict, where, effects, alias, protocol: see there.
        calibration: None in files of before that do not say it.
        warnings: what is remarkable about the scene, one sentence each.
    """

    verdict: Verdict
    where: Where
    effects: tuple[EffectReport, ...]
    alias: Alias
    protocol: Protocol
    calibration: CalibrationUse | None = None
    warnings: tuple[str, ...] = ()

    def effect(self, name: str) -> EffectReport | None:
        """The report on one candidate, None if it is not listed."""
        return next((effect for effect in self.effects if effect.name == name), None)

    def to_json(self) -> dict[str, Any]:
        """JSON values; effects in order of falling probability."""
        values: dict[str, Any] = {"format": FORMAT, **json.loads(json.dumps(asdict(self)))}
        values["effects"].sort(key=lambda effect: -effect["probability"])
        return values

    @classmethod
    def from_json(cls, values: Any, where: str = DIAGNOSIS_FILE) -> GapReport:
        """The report from JSON values.

        Args:
            values: as ``json.load`` gives them.
            where: file, for messages.

        Raises:
            InputError: a key is missing, unknown or of the wrong kind, a number is not finite, a probability
                is not in [0, 1], an interval does not hold its estimate, the matrix does not fit, or the
                format is of a later version.
        """
        top = _Reader(values, where)
        kind = top.whole("format") if "format" in top else 1
        if not 1 <= kind <= FORMAT:
            raise _wrong(top.at("format"), f"a format up to {FORMAT}", kind)
        report = cls(
            verdict=_verdict(top.part("verdict")),
            where=_where(top.part("where")),
            effects=tuple(_effect(part, kind) for part in top.parts("effects")),
            alias=_alias(top.part("alias")),
            protocol=_protocol(top.part("protocol")),
            calibration=_calibration(top.optional_part("calibration")),
            warnings=top.texts("warnings") if "warnings" in top else (),
        )
        top.done()
        return report

    def write(self, path: Path) -> Path:
        """Write the file atomically; returns the path."""
        return write_text(path, json.dumps(self.to_json(), indent=1, allow_nan=False) + "\n")

    @classmethod
    def read(cls, path: Path) -> GapReport:
        """Read the file.

        Raises:
            InputError: there is none, it is no JSON, or see ``from_json``.
        """
        try:
            values = read_json_object(path)
        except (OSError, ValueError) as error:
            raise InputError(
                "No diagnosis can be read",
                where=str(path),
                expected="a diagnosis.json",
                got=f"{type(error).__name__}: {error}",
            ) from error
        return cls.from_json(values, str(path))


class _Reader:
    """One JSON object: gives its values, checked, and notices what nobody asked for."""

    def __init__(self, values: Any, where: str) -> None:
        if not isinstance(values, Mapping):
            raise _wrong(where, "an object", values)
        self._values = dict(values)
        self._where = where
        self._known: set[str] = set()

    def take(self, key: str, *, optional: bool = False) -> Any:
        self._known.add(key)
        if key not in self._values and not optional:
            raise InputError(
                f"Key '{key}' is missing",
                where=self._where,
                expected=f"'{key}'",
                got=f"keys {', '.join(self._values) or 'none'}",
            )
        return self._values.get(key)

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def at(self, key: str) -> str:
        return f"{self._where}: {key}"

    def part(self, key: str) -> _Reader:
        return _Reader(self.take(key), self.at(key))

    def optional_part(self, key: str) -> _Reader | None:
        value = self.take(key, optional=True)
        return None if value is None else _Reader(value, self.at(key))

    def parts(self, key: str) -> list[_Reader]:
        return [_Reader(v, f"{self.at(key)}[{i}]") for i, v in enumerate(self._list(key))]

    def text(self, key: str) -> str:
        value = self.take(key)
        if not isinstance(value, str):
            raise _wrong(self.at(key), "a text", value)
        return value

    def optional_text(self, key: str) -> str | None:
        return None if self.take(key, optional=True) is None else self.text(key)

    def number(self, key: str) -> float:
        return _number(self.take(key), self.at(key))

    def optional_number(self, key: str) -> float | None:
        return None if self.take(key, optional=True) is None else self.number(key)

    def probability(self, key: str) -> float:
        value = self.number(key)
        if not 0 <= value <= 1:
            raise _wrong(self.at(key), "a probability in [0, 1]", value)
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        values = self._list(key)
        if not all(isinstance(v, str) for v in values):
            raise _wrong(self.at(key), "a list of texts", values)
        return tuple(values)

    def numbers(self, key: str) -> tuple[float, ...]:
        return tuple(_number(v, self.at(key)) for v in self._list(key))

    def whole_numbers(self, key: str) -> tuple[int, ...]:
        return tuple(_whole(v, self.at(key)) for v in self._list(key))

    def whole(self, key: str) -> int:
        return _whole(self.take(key), self.at(key))

    def table(self, key: str, item: Callable[[Any, str], Any]) -> dict[str, Any]:
        value = self.take(key)
        if not isinstance(value, Mapping):
            raise _wrong(self.at(key), "an object", value)
        return {str(k): item(v, f"{self.at(key)}.{k}") for k, v in value.items()}

    def done(self) -> None:
        unknown = sorted(set(self._values) - self._known)
        if unknown:
            raise InputError(
                "Unknown keys",
                where=self._where,
                expected=", ".join(sorted(self._known)),
                got=", ".join(unknown),
            )

    def _list(self, key: str) -> list[Any]:
        value = self.take(key)
        if not isinstance(value, list):
            raise _wrong(self.at(key), "a list", value)
        return value


def _verdict(part: _Reader) -> Verdict:
    verdict = Verdict(
        effect=part.text("effect"),
        candidates=part.texts("candidates"),
        stage=part.text("stage"),
        probability=part.probability("probability"),
        reason=part.text("reason"),
        next_recording=part.text("next_recording"),
        also=part.optional_text("also"),
    )
    part.done()
    return verdict


def _where(part: _Reader) -> Where:
    where = Where(
        stages=part.table("stages", _number),
        frames=part.numbers("frames"),
        vertices=part.optional_text("vertices"),
        regimes=part.table("regimes", _number),
    )
    part.done()
    return where


def _effect(part: _Reader, kind: int) -> EffectReport:
    shrink = part.optional_part("shrink")
    if kind == 1:
        part.take("gap", optional=True)
    effect = EffectReport(
        name=part.text("name"),
        stage=part.text("stage"),
        probability=part.probability("probability"),
        parameters=part.table("parameters", lambda value, where: _estimate(_Reader(value, where))),
        shrink=None if shrink is None else _shrink(shrink, kind),
    )
    part.done()
    return effect


def _estimate(part: _Reader) -> Estimate:
    estimate = Estimate(part.number("estimate"), part.number("low"), part.number("high"), part.text("unit"))
    part.done()
    _check_interval(part.at("estimate"), estimate.low, estimate.estimate, estimate.high)
    return estimate


def _shrink(part: _Reader, kind: int) -> Shrink:
    if kind == 1:
        part.take("oracle", optional=True)
    shrink = Shrink(
        metric=part.text("metric"),
        held_out=part.text("held_out"),
        base=part.number("base"),
        with_effect=part.number("with_effect"),
        estimate=part.number("estimate"),
        low=part.number("low"),
        high=part.number("high"),
        best_placebo=part.optional_number("best_placebo"),
    )
    part.done()
    _check_interval(part.at("estimate"), shrink.low, shrink.estimate, shrink.high)
    return shrink


def _alias(part: _Reader) -> Alias:
    names = part.texts("names")
    rows = part.take("matrix")
    limits = part.table(
        "detection_limits", lambda value, where: None if value is None else _number(value, where)
    )
    part.done()
    square = isinstance(rows, list) and len(rows) == len(names)
    if not square or not all(isinstance(row, list) and len(row) == len(names) for row in rows):
        raise _wrong(part.at("matrix"), f"{len(names)} rows of {len(names)} numbers, as names says", rows)
    matrix = tuple(tuple(_number(v, part.at("matrix")) for v in row) for row in rows)
    return Alias(names, matrix, limits)


def _protocol(part: _Reader) -> Protocol:
    protocol = Protocol(
        seed=part.whole("seed"),
        frames_used=part.whole_numbers("frames_used"),
        frames_held_out=part.whole_numbers("frames_held_out"),
        version=part.text("version"),
        naive=part.optional_text("naive") or "",
    )
    part.done()
    return protocol


def _calibration(part: _Reader | None) -> CalibrationUse | None:
    if part is None:
        return None
    calibrated = part.take("calibrated")
    if not isinstance(calibrated, bool):
        raise _wrong(part.at("calibrated"), "true or false", calibrated)
    use = CalibrationUse(
        calibrated=calibrated,
        file=part.text("file"),
        settings=part.text("settings"),
        made_for=part.text("made_for"),
        differences=part.texts("differences"),
    )
    part.done()
    return use


def _check_interval(where: str, low: float, estimate: float, high: float) -> None:
    if not low <= estimate <= high:
        raise _wrong(where, "a number between low and high", f"{low}, {estimate}, {high}")


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(where, "a finite number", value)
    return float(value)


def _whole(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise _wrong(where, "a whole number", value)
    return value


def _wrong(where: str, expected: str, got: object) -> InputError:
    return InputError(
        "The diagnosis cannot be understood", where=where, expected=expected, got=str(got)[:100]
    )
