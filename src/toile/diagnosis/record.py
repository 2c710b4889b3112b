"""What a diagnosis answers: the contents of ``diagnosis.json``, read and written with every key checked.

Keys of the file:

- ``format``: 2. Files without it are of the first format, and are read as well. They may have ``oracle`` in
  ``shrink`` and ``gap`` in ``effects``, which no diagnosis has ever filled (they ask for the truth, and for a
  simulation that a diagnosis does not do); both are dropped.
- ``verdict``: ``effect`` (a catalogue name, ``none``, ``ambiguous`` or ``unknown``), ``candidates``,
  ``stage``, ``probability``, ``reason``, ``next_recording``, ``also`` (a second effect)
- ``where``: ``stages`` {name: share}, ``frames`` [score], ``vertices`` (path of an (H, W) array beside the
  file), ``regimes`` {name: score}, ``acts_on`` (the same of where the effect acts)
- ``effects``: [{``name``, ``stage``, ``probability``, ``parameters`` {name: {``estimate``, ``low``, ``high``,
  ``unit``}}, ``shrink`` {``metric``, ``held_out``, ``base``, ``with_effect``, ``estimate``, ``low``,
  ``high``, ``best_placebo``}, ``amounts`` as ``parameters``}], most probable first
- ``alias``: ``names``, ``matrix``, ``detection_limits`` {name: number}
- ``protocol``: ``seed``, ``frames_used``, ``frames_held_out``, ``version``, ``naive``
- ``calibration``: ``calibrated``, ``file``, ``settings``, ``made_for``, ``differences`` [text]
- ``warnings``: [text], what is remarkable about the scene
- ``session``: null, or of several clips ``clips`` [name], ``frames`` [number], ``probabilities`` {name:
  number}, ``equivalence_classes`` [[name]], ``material`` {name: number}, ``left``, ``next_clip``,
  ``expected_information`` {motion: number}, ``obstacles`` {clip: {``point``, ``normal``
  or ``centre``, ``radius``}}, ``stand_ins`` {name: {``probability``, ``moves``, ``found`` {name: number}}},
  ``resized`` {clip: share}, ``covered`` {clip: {``share``, ``first``, ``last``}}, ``unseen`` [name],
  ``moved_by`` (name), ``moved`` [widths, by frame], ``beside`` {name: number} (probabilities beside
  ``first``), ``first``, ``second`` (names)

Numbers that do not exist are null. Keys that are not listed are refused: a typing error must not pass for a
missing answer.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.json_file import place, read_json_object
from toile.limits import Fraction

DIAGNOSIS_FILE = "diagnosis.json"

FORMAT = 2
"""Of what is written; older ones are read."""

NONE = "none"
"""Verdict: the base model explains the clip."""
AMBIGUOUS = "ambiguous"
"""Verdict: one of the candidates, and the clip cannot tell which."""
UNKNOWN = "unknown"
"""Verdict: something that is not in the catalogue."""
PIECES = "pieces"
"""Begin of what was held out where there is no clip that fits have not seen."""
LAST_CLIP = "the last clip"
"""What was held out where there are several."""
MOVED = 0.005
"""Mean distance from which on a frame is one in which an effect moves the cloth [widths]."""


_Interval = TypeVar("_Interval", "Estimate", "Shrink")


def _in_order(part: _Interval) -> _Interval:
    if not part.low <= part.estimate <= part.high:
        raise ValueError(f"an estimate between {part.low} and {part.high}")
    return part


def _square(alias: Alias) -> Alias:
    n = len(alias.names)
    if [len(row) for row in alias.matrix] != [n] * n:
        raise ValueError(f"{n} rows of {n} numbers in matrix, as names says")
    return alias


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
        amounts: what the parameters come to, by what it is, where they do not say so themselves.
    """

    name: str
    stage: str
    probability: Fraction
    parameters: dict[str, Annotated[Estimate, AfterValidator(_in_order)]] = field(default_factory=dict)
    shrink: Annotated[Shrink, AfterValidator(_in_order)] | None = None
    amounts: dict[str, Annotated[Estimate, AfterValidator(_in_order)]] = field(default_factory=dict)


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
    probability: Fraction
    reason: str
    next_recording: str
    also: str | None = None


@dataclass(frozen=True)
class Where:
    """Where the gap lies.

    Attributes:
        stages: share of the gap by stage; of a session how probable it is that the gap lies there.
        frames: score of every frame, mean distance of base model and tracked motion over the clip's median.
        vertices: path, relative to the file, of an (H, W) array of scores (.npy), None if not written.
        regimes: score by regime, e.g. "slack".
        acts_on: path of an (H, W) array of how strongly the effect that is named acts (.npy), 1 where most;
            None for effects that act everywhere alike.
    """

    stages: dict[str, float]
    frames: tuple[float, ...]
    vertices: str | None
    regimes: dict[str, float] = field(default_factory=dict)
    acts_on: str | None = None


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
class StandIn:
    """What stands in for a cause that the catalogue lacks.

    Attributes:
        probability: that it is what moves the cloth.
        moves: how far it moves the cloth in the last third of the first clip [widths]; None where it tears
            the cloth apart in the simulation.
        found: what it is like in the first clip, by name and unit, see catalogue.STAND_INS.
    """

    probability: Fraction
    moves: float | None
    found: dict[str, float]


@dataclass(frozen=True)
class Covered:
    """What seems to be before the cloth in a clip, and the mask takes for cloth.

    Attributes:
        share: of the print that is seen in other frames, hidden at most.
        first, last: frames in which as much is hidden as speaks for it.
    """

    share: Fraction
    first: int
    last: int


@dataclass(frozen=True)
class SessionAnswer:
    """What several clips of one cloth add to a report.

    Attributes:
        clips: names of their folders.
        frames: of each that were used.
        probabilities: of every hypothesis, NONE and UNKNOWN among them.
        equivalence_classes: what these clips cannot tell apart, NONE and ``unseen`` among it.
        material: of the base model, by name, SI.
        left: squared errors that the best hypothesis leaves, over those of a usual base model.
        next_clip: motion of the clip to record next, "" for none.
        expected_information: by motion, what one more clip would add to the answer [nats]; {} where the
            answer is clear.
        moved_by: the most probable of the effects that move the cloth, "" in files of before.
        moved: mean distance by which that effect moves the cloth in every frame of the first clip, all else
            equal [widths]; () where it is not known.
        beside: probabilities of every other effect that moves the cloth, NONE among them, once ``first``
            acts; {} where it was not asked, as nothing may be moving it.
        first: effect that ``beside`` is asked of, "" for ``moved_by``: another one that is level with it.
        second: effect that moves the cloth beside ``first`` and is believed, "" for none.
        obstacles: where contact is what may be missing: what is touched, by clip, in the camera's frame: of a
            plane a ``point`` [m] and its ``normal`` towards the cloth, of a ball its ``centre`` and
            ``radius`` [m].
        stand_ins: where UNKNOWN is what may be missing: what it looks like, by the name of the stand-in.
        resized: share by which the sides seem to change, by clip, where nobody moved what holds the cloth and
            it is more than tracking errs by; negative where they shrink.
        covered: what seems to be before the cloth, by clip, where something does.
        unseen: causes from outside that leave no trace of their own in these clips; one class with NONE.
        second_shrink: of the error on the clip that was left out, by the effect that leads beside ``first``,
            over ``first`` alone; where its whole interval is below zero ``second`` is "". None where it was
            not asked.
    """

    clips: tuple[str, ...]
    frames: tuple[int, ...]
    probabilities: dict[str, Fraction]
    equivalence_classes: tuple[tuple[str, ...], ...]
    material: dict[str, float]
    left: float
    next_clip: str = ""
    expected_information: dict[str, float] = field(default_factory=dict)
    moved_by: str = ""
    moved: tuple[float, ...] = ()
    beside: dict[str, Fraction] = field(default_factory=dict)
    first: str = ""
    second: str = ""
    obstacles: dict[str, dict[str, tuple[float, ...]]] = field(default_factory=dict)
    stand_ins: dict[str, StandIn] = field(default_factory=dict)
    resized: dict[str, float] = field(default_factory=dict)
    covered: dict[str, Covered] = field(default_factory=dict)
    unseen: tuple[str, ...] = ()
    second_shrink: Shrink | None = None


@dataclass(frozen=True)
class GapReport:
    """The whole of ``diagnosis.json``.

    Attributes:
        verdict, where, effects, alias, protocol: see there.
        calibration: None in files of before that do not say it.
        warnings: what is remarkable about the scene, one sentence each.
        session: of several clips; None for one clip alone.
    """

    # Of this and of every part: numbers are finite, nothing is converted, and no key is passed over.
    __pydantic_config__: ClassVar = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    verdict: Verdict
    where: Where
    effects: tuple[EffectReport, ...]
    alias: Annotated[Alias, AfterValidator(_square)]
    protocol: Protocol
    calibration: CalibrationUse | None = None
    warnings: tuple[str, ...] = ()
    session: SessionAnswer | None = None

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
        if not isinstance(values, dict):
            raise _wrong(where, "an object", values)
        kind = values.get("format", 1)
        if kind not in range(1, FORMAT + 1):
            raise _wrong(f"{where}: format", f"a format up to {FORMAT}", kind)
        dropped = _FIRST_FORMAT if kind == 1 else ()
        present = json.loads(
            json.dumps(values), object_hook=lambda part: {k: v for k, v in part.items() if k not in dropped}
        )
        present.pop("format", None)
        try:
            # As text, in which a list may be a tuple although nothing is converted.
            return _adapter().validate_json(json.dumps(present))
        except ValidationError as error:
            raise _mistake(error, where) from error

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


@cache
def _adapter() -> TypeAdapter[GapReport]:
    return TypeAdapter(GapReport)


_FIRST_FORMAT = ("gap", "oracle")
"""Keys that only the first format had."""
_PARTS = {
    "verdict": Verdict,
    "where": Where,
    "effects": EffectReport,
    "parameters": Estimate,
    "amounts": Estimate,
    "shrink": Shrink,
    "alias": Alias,
    "protocol": Protocol,
    "calibration": CalibrationUse,
    "session": SessionAnswer,
}
"""What stands below a key."""


def _mistake(error: ValidationError, where: str) -> InputError:
    """The first thing that is wrong."""
    first = error.errors(include_url=False)[0]
    *parents, last = location = first["loc"] or ("",)
    if first["type"] == "missing":
        got = f"keys {', '.join(first['input']) or 'none'}"
        return InputError(
            f"Key '{last}' is missing", where=_at(where, parents), expected=f"'{last}'", got=got
        )
    if first["type"] == "unexpected_keyword_argument":
        part = next((_PARTS[k] for k in reversed(parents) if k in _PARTS), GapReport)
        known = ", ".join(sorted(f.name for f in fields(part)))
        return InputError("Unknown key", where=_at(where, parents), expected=known, got=str(last))
    expected = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return _wrong(_at(where, location), expected, first["input"])


def _at(where: str, location: Sequence[str | int]) -> str:
    return f"{where}: {place(location)}" if place(location) else where


def _wrong(where: str, expected: str, got: object) -> InputError:
    return InputError(
        "The diagnosis cannot be understood", where=where, expected=expected, got=repr(got)[:100]
    )
