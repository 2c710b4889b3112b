"""Every setting of a command is what its declaration says, before anything is loaded, built or written.

Bounds and units stand in the annotations of what a setting belongs to (toile.limits); the few settings that
belong to no class, because a command reads them itself, stand in COMMAND_SETTINGS.
"""

from __future__ import annotations

import inspect
import math
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from toile.errors import InputError
from toile.limits import Count, CountOrZero, Fraction, NonNegative, Positive, Seed, TwoOrMore, Unit

Frames = Annotated[Count, Unit("frames")]
Jobs = Annotated[Count, Unit("processes")] | Literal[-1]

COMMAND_SETTINGS: Mapping[str, Any] = {
    "checkpoint_every": Annotated[Count, Unit("steps")],
    "pictures_every": Annotated[Count, Unit("steps")],
    "seed": Seed | None,
    "objective": str | None,
    "report.pictures": Annotated[Count, Unit("frames")],
    "report.video": bool,
    "report.page": bool,
    "fixed_effects": tuple[str, ...] | None,
    "force": bool,
    "dry_run": bool,
    "simulator.substeps": Annotated[Count, Unit("per frame")] | None,
    "simulator.longest_substep": Annotated[Positive, Unit("s")],
    "simulator.largest_time_error": Annotated[Positive, Unit("s")],
    "workers": Jobs,
    "n_frames": Frames | None,
    "start": Annotated[CountOrZero, Unit("frames")],
    "every": Frames,
    "view": CountOrZero,
    "fps": Annotated[Positive, Unit("1/s")] | None,
    "times": Literal["recorded", "uniform"],
    "uniform_tolerance": Annotated[float, Field(ge=0, lt=0.5), Unit("of the interval")],
    "largest_jump": Annotated[Positive, Unit("times")],
    "preview_height": Annotated[Count, Unit("px")],
    "overwrite": bool,
    "grid": tuple[TwoOrMore, TwoOrMore],
    "minimum_iou": Fraction,
    "pictures": Annotated[CountOrZero, Unit("frames")],
    "keep_camera_frame": bool,
    "threads": Count | None,
    "max_minutes": Annotated[NonNegative, Unit("min")] | None,
    "jobs": Jobs,
    "one_clip": bool,
    "as_scene": bool,
    "extended": bool,
    "max_sessions": Count | None,
    "table": str | None,
    "part": CountOrZero,
    "parts": Count,
    "first": Count | None,
    "incomplete": bool,
    "blender": bool,
    "mujoco": bool,
    "clips": tuple[str, ...],
    "alias": Fraction,
    "tables.known": bool,
    "bootstrap": Count,
    "left_out": bool,
    "exact_steps": bool,
}
"""Settings that a command reads itself, by their place in its configuration."""

_STRICT = ConfigDict(strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)


def check_settings(cfg: DictConfig) -> None:
    """Check a whole configuration.

    Raises:
        InputError: the first setting whose value is not what its declaration allows; one that stands there,
            rather than one that refers to it.
    """
    node, written = (OmegaConf.to_container(cfg, resolve=resolve) for resolve in (True, False))
    own = (_failure(place, _at(node, place), kind) for place, kind in COMMAND_SETTINGS.items())
    failures = [failure for failure in (*own, *_failures(node, "")) if failure is not None]
    if failures:
        raise min(failures, key=lambda failure: "${" in str(_at(written, failure.where)))


def check_arguments(node: Any) -> None:
    """Check the arguments of every ``_target_`` of ours below a node of plain values.

    Args:
        node: dictionaries, lists and plain values, every reference resolved.

    Raises:
        InputError: the first argument whose value is not what the signature's annotation allows.
    """
    for failure in _failures(node, ""):
        raise failure


_ABSENT = object()


def _at(node: Any, place: str) -> Any:
    """What stands at "stages.track.blur", or _ABSENT."""
    for key in place.split("."):
        node = node.get(key, _ABSENT) if isinstance(node, dict) else _ABSENT
    return node


def _failures(node: Any, place: str) -> Iterator[InputError]:
    for at, target, arguments in _targets(node, place):
        if target.startswith("toile."):
            annotations = _annotations(target)
            for name in filter(annotations.__contains__, arguments):
                failure = _failure(f"{at}.{name}".lstrip("."), arguments[name], annotations[name])
                if failure is not None:
                    yield failure


def _targets(node: Any, place: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    if isinstance(node, dict):
        if isinstance(node.get("_target_"), str):
            given = {k: v for k, v in node.items() if not (isinstance(k, str) and k.startswith("_"))}
            yield place, node["_target_"], given
        for key, value in node.items():
            yield from _targets(value, f"{place}.{key}".lstrip("."))
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _targets(value, f"{place}[{index}]")


@cache
def _annotations(target: str) -> dict[str, Any]:
    """Annotations of what a target is called with, by argument."""
    called: Callable[..., Any] = get_object(target)
    # A named tuple has its fields' annotations on the class.
    function: Any = called
    if inspect.isclass(called) and not issubclass(called, tuple):
        function = called.__init__  # type: ignore[misc]
    # A dataclass's __init__ has the fields of the classes it is derived from, whose modules are others.
    names = {name: value for base in reversed(_bases(called)) for name, value in _module(base).items()}
    hints = typing.get_type_hints(function, names or None, include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}


def _bases(called: Callable[..., Any]) -> Sequence[type]:
    """Dataclasses that a dataclass is derived from, itself first; nothing for anything else."""
    if not (inspect.isclass(called) and is_dataclass(called)):
        return ()
    return [base for base in called.__mro__ if is_dataclass(base)]


def _module(kind: type) -> Mapping[str, Any]:
    """Names that its annotations may use."""
    return vars(sys.modules[kind.__module__])


def _failure(place: str, value: Any, kind: Any) -> InputError | None:
    """What is wrong with a value; nothing is said of what is built from a part of the configuration."""
    if value is _ABSENT or value == "???" or _is_built(value):
        return None
    try:
        _adapter(kind).validate_python(_as_tuples(value))
    except ValidationError:
        what = f"Setting {place} is not what it may be"
        return InputError(what, where=place, expected=describe(kind), got=_shown(value))
    return None


def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(_plain(kind), config=_STRICT)


def _plain(kind: Any) -> Any:
    """The annotation for values as YAML gives them, where a path is a text and no class has instances."""
    origin = get_origin(kind)
    plain: Any = _Built
    if origin is Annotated:
        base, *metadata = get_args(kind)
        plain = Annotated[(_plain(base), *metadata)]
    elif origin in (Union, types.UnionType):
        plain = Union[tuple(_plain(part) for part in get_args(kind))]  # noqa: UP007  # built at run time
    elif origin in (Sequence, tuple, list):
        plain = tuple[tuple(part if part is ... else _plain(part) for part in _items(kind))]  # type: ignore[misc]
    elif origin is Mapping:
        plain = dict[tuple(_plain(part) for part in get_args(kind))]  # type: ignore[misc]
    elif kind is Path:
        plain = str
    elif kind in _NAMES or origin is Literal:
        plain = kind
    elif inspect.isclass(kind) and issubclass(kind, Enum):
        plain = Literal[tuple(member.value for member in kind)]  # type: ignore[valid-type]
    return plain


class _Built:
    """Something that is built from a part of the configuration, never a plain value."""


def _items(kind: Any) -> tuple[Any, ...]:
    arguments = get_args(kind)
    return arguments if get_origin(kind) is tuple else (arguments[0], ...)


def _is_built(value: Any) -> bool:
    """Whether a part of the configuration builds something, or holds parts that do."""
    if isinstance(value, dict):
        return "_target_" in value or any(map(_is_built, value.values()))
    return isinstance(value, list) and any(map(_is_built, value))


def _as_tuples(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_as_tuples, value))
    return {key: _as_tuples(part) for key, part in value.items()} if isinstance(value, dict) else value


def _shown(value: Any) -> str:
    match value:
        case None:
            return "null"
        case bool():
            return str(value).lower()
        case str():
            return f"the text {value!r}"
        case float() if not math.isfinite(value):
            return str(value)
    return str(value)


_NAMES = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    Path: "a path",
    Any: "anything",
    type(None): "null",
    None: "null",
}


def describe(kind: Any) -> str:
    """What an annotation allows, in words: "a number > 0 [kg/m²], or null"."""
    origin = get_origin(kind)
    text = _NAMES.get(kind) or f"settings of {getattr(kind, '__name__', kind)}"
    if origin is Annotated:
        base, *metadata = get_args(kind)
        limits = [m for item in metadata for m in (item.metadata if isinstance(item, FieldInfo) else [item])]
        bounds = " and ".join(filter(None, map(_bound, limits)))
        units = [f"[{limit.name}]" for limit in limits if isinstance(limit, Unit)]
        text = " ".join(filter(None, (_of_length(describe(base), limits), bounds, *units)))
    elif origin in (Union, types.UnionType):
        text = ", or ".join(dict.fromkeys(map(describe, get_args(kind))))
    elif origin in (Sequence, tuple, list):
        items = _items(kind)
        each = items[-1] is ...
        text = (
            f"a list, each {describe(items[0])}"
            if each
            else f"a list of {len(items)}: " + "; ".join(map(describe, items))
        )
    elif origin is Mapping:
        text = f"names with values, each {describe(get_args(kind)[1])}"
    elif origin is Literal:
        text = ", ".join(map(str, get_args(kind)))
    elif inspect.isclass(kind) and issubclass(kind, Enum):
        text = ", ".join(str(member.value) for member in kind)
    return text


def _of_length(text: str, limits: Sequence[object]) -> str:
    """The words for a list with how long it must be."""
    least = next((limit.min_length for limit in limits if isinstance(limit, MinLen)), 0)
    most = next((limit.max_length for limit in limits if isinstance(limit, MaxLen)), None)
    if least == most:
        return text.replace("a list", f"a list of {least}", 1)
    return text.replace("a list", f"a list of at least {least}", 1) if least else text


def _bound(limit: object) -> str:
    match limit:
        case Gt():
            return f"> {limit.gt}"
        case Ge():
            return f">= {limit.ge}"
        case Lt():
            return "" if limit.lt == 2**63 else f"< {limit.lt}"
        case Le():
            return f"<= {limit.le}"
    return ""
