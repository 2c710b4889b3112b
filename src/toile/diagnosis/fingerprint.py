"""What a result was made from, as short texts that are equal only where all of it is."""

from __future__ import annotations

import hashlib
import inspect
from abc import ABC
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, partial
from importlib.metadata import version
from importlib.resources import files
from types import CodeType
from typing import Any

import numpy as np
import torch

from toile.effects.base import Effect

# Parts of the package that have no say in what a diagnosis computes.
_WITHOUT_INFLUENCE = ("cli", "reports", "training", "generation")


def fingerprint(*values: object) -> str:
    """SHA-256 of plain values, arrays, tensors, settings and objects of this package, by their content.

    Raises:
        TypeError: a value whose content cannot be told, e.g. a function made inside another one.
    """
    digest = hashlib.sha256()
    for part in _parts(list(values)):
        # Lengths first: two parts must not pass for one.
        digest.update(f"{len(part)}:".encode())
        digest.update(part)
    return digest.hexdigest()


@cache
def code_fingerprint() -> str:
    """The package's version, and a hash of those of its sources that a diagnosis depends on."""
    digest = hashlib.sha256()
    root = files("toile")
    _add_sources(digest, root, _WITHOUT_INFLUENCE)
    return f"{version('toile')} {digest.hexdigest()}"


def _add_sources(digest: Any, folder: Any, without: Collection[str] = ()) -> None:
    for path in sorted(folder.iterdir(), key=lambda p: str(p.name)):
        if path.is_dir():
            if path.name in (*without, "__pycache__"):
                continue
            digest.update(path.name.encode())
            _add_sources(digest, path)
        elif path.name.endswith(".py"):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())


def _parts(value: object) -> Iterable[memoryview | bytes]:
    """Bytes that tell the value from others; kinds are named, so that 1 and "1" differ."""
    match value:
        case np.generic():  # first: np.float64 is a float as well
            yield from _parts(value.item())
        case None | bool() | int() | float() | str() | bytes():
            # repr gives every digit of a float.
            yield f"{type(value).__name__} {value!r}".encode()
        case Enum():
            yield f"{_name(type(value))}.{value.name}".encode()
        case torch.Tensor():
            yield from _parts(value.detach().cpu().numpy())
        case np.ndarray():
            if value.dtype.hasobject:
                raise TypeError("an array of objects has no fingerprint")
            yield f"array {value.dtype.str} {value.shape}".encode()
            yield np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
        case list() | tuple():
            yield f"{_name(type(value))} {len(value)}".encode()
            for item in value:
                yield from _parts(item)
        case Mapping():
            yield f"mapping {len(value)}".encode()
            for key, item in value.items():
                yield from _parts(key)
                yield from _parts(item)
        case partial():
            yield b"partial"
            yield from _parts([value.func, value.args, value.keywords])
        case type():
            yield f"class {_name(value)}".encode()
        case torch.nn.Module():
            yield f"module {_name(type(value))}".encode()
            yield from _parts(dict(value.state_dict()))
        case _ if inspect.isfunction(value):
            if value.__closure__ is not None or value.__name__ == "<lambda>":
                raise TypeError(f"{value.__qualname__} has no fingerprint")
            yield f"function {value.__module__}.{value.__qualname__}".encode()
        case _ if is_dataclass(value):
            yield f"settings {_name(type(value))}".encode()
            yield from _parts({f.name: getattr(value, f.name) for f in fields(value)})
        case _ if type(value).__module__.startswith("toile."):
            yield f"object {_name(type(value))}".encode()
            yield from _parts(dict(vars(value)))
        case Effect():  # from outside the package, where its hash of sources does not reach
            yield f"object {_name(type(value))}".encode()
            yield from _parts([_code_of(type(value)), type(value).PARAMETERS, type(value).STAGE])
            yield from _parts(dict(vars(value)))
        case _:
            raise TypeError(f"a {_name(type(value))} has no fingerprint")


def _code_of(kind: type) -> dict[str, object]:
    """What the methods of a class do, those of its bases outside the package among them.

    By their code: a class that was written in a notebook has no file with its source.
    """
    found: dict[str, object] = {}
    for base in kind.__mro__:
        if base.__module__.startswith("toile.") or base in (object, ABC):
            continue
        for name, member in vars(base).items():
            function = getattr(member, "fget", getattr(member, "__func__", member))
            if inspect.isfunction(function):
                found[f"{_name(base)}.{name}"] = _instructions(function.__code__)
    return found


def _instructions(code: CodeType) -> list[object]:
    constants: list[object] = []
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            constants.append(_instructions(constant))
        else:
            # The order of a set of texts is another one in every process.
            constants.append(
                sorted(map(repr, constant)) if isinstance(constant, frozenset) else repr(constant)
            )
    return [code.co_code, list(code.co_names), list(code.co_varnames), constants]


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
