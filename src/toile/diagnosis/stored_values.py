"""Results of a stage as arrays and plain text: what NPZ and JSON hold, and nothing that runs when it is read.

A value becomes a tree of JSON with the places of its arrays. Dataclasses are named in it, and only those that
the reader knows are ever made.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toile.effects.base import Effect

# The key of a node that is more than a plain value.
_KIND = "kind"


@dataclass(frozen=True)
class Flat:
    """A value taken apart.

    Attributes:
        tree: JSON text.
        arrays: by the place they have in it, e.g. "fit.windows.0.positions".
    """

    tree: str
    arrays: Mapping[str, NDArray[Any]]

    @property
    def digest(self) -> str:
        """SHA-256 of all of it."""
        digest = hashlib.sha256(self.tree.encode())
        for name in sorted(self.arrays):
            array = self.arrays[name]
            digest.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode())
            digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
        return digest.hexdigest()


class ValueStore:
    """Takes values apart and puts them together again, to the last bit.

    Args:
        kinds: dataclasses (and named tuples) that may occur.
        effects: that may occur, with whatever coefficients; they are stored by name, values and place.
    """

    def __init__(self, kinds: Iterable[type], effects: Iterable[Effect] = ()) -> None:
        self._kinds = {kind.__name__: kind for kind in kinds}
        self._effects = {effect.NAME: effect for effect in effects}

    def flat(self, value: object) -> Flat:
        """The value taken apart.

        Raises:
            TypeError: there is something in it that cannot be stored.
        """
        arrays: dict[str, NDArray[Any]] = {}
        tree = self._taken_apart(value, "", arrays)
        return Flat(json.dumps(tree), arrays)

    def value(self, flat: Flat) -> Any:
        """The value again.

        Raises:
            ValueError, KeyError, TypeError: it is none that ``flat`` has made.
        """
        return self._together(json.loads(flat.tree), flat.arrays)

    def _taken_apart(self, value: object, at: str, arrays: dict[str, NDArray[Any]]) -> Any:
        def inside(name: object, part: object) -> Any:
            return self._taken_apart(part, f"{at}.{name}" if at else str(name), arrays)

        node: Any
        match value:
            case None | bool() | str():
                node = value
            case int() | float():
                # np.float64 is a float as well, and json would not know the others.
                node = float(value) if isinstance(value, float) else int(value)
            case torch.Tensor():
                arrays[at] = value.detach().cpu().numpy()
                node = {_KIND: "tensor", "at": at}
            case np.ndarray():
                if value.dtype.kind not in "biufU":
                    raise TypeError(f"{at}: an array of {value.dtype} cannot be stored")
                arrays[at] = value
                node = {_KIND: "array", "at": at}
            case Effect():
                if value.NAME not in self._effects:
                    raise TypeError(f"{at}: {value.NAME} is none of the effects that may occur")
                node = {_KIND: "effect", "name": value.NAME, "values": inside("values", value.values)}
                if place := value.place():
                    node["place"] = inside("place", place)
            case list():
                node = [inside(k, part) for k, part in enumerate(value)]
            case dict():
                if not all(isinstance(key, str) for key in value):
                    raise TypeError(f"{at}: keys that are no texts cannot be stored")
                node = {_KIND: "dict", "items": {key: inside(key, part) for key, part in value.items()}}
            case tuple() if type(value) is tuple:
                node = {_KIND: "tuple", "items": [inside(k, part) for k, part in enumerate(value)]}
            case _:
                name = type(value).__name__
                if self._kinds.get(name) is not type(value):
                    raise TypeError(f"{at}: a {name} cannot be stored")
                parts = {f: inside(f, getattr(value, f)) for f in _fields(type(value))}
                node = {_KIND: name, "fields": parts}
        return node

    def _together(self, node: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
        if isinstance(node, list):
            return [self._together(part, arrays) for part in node]
        if not isinstance(node, dict):
            return node
        kind = node[_KIND]
        value: Any
        match kind:
            case "array":
                value = arrays[node["at"]]
            case "tensor":
                value = torch.from_numpy(arrays[node["at"]])
            case "effect":
                value = self._effects[node["name"]].with_values(self._together(node["values"], arrays))
                if "place" in node:
                    value = value.placed(self._together(node["place"], arrays))
            case "dict":
                value = {key: self._together(part, arrays) for key, part in node["items"].items()}
            case "tuple":
                value = tuple(self._together(part, arrays) for part in node["items"])
            case _:
                parts = {f: self._together(part, arrays) for f, part in node["fields"].items()}
                value = self._kinds[kind](**parts)
        return value


def _fields(kind: type) -> tuple[str, ...]:
    if is_dataclass(kind):
        return tuple(f.name for f in fields(kind))
    names: tuple[str, ...] = getattr(kind, "_fields", ())
    return names
