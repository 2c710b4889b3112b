"""JSON files from anywhere: everything that can be wrong with one is a ValueError of one line.

Who reads a file says what was expected of it; here it is only found out what was got. A byte-order mark,
which some editors write, is no mistake.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def read_json_object(path: Path) -> dict[str, Any]:
    """The values of a JSON file that must hold an object at the top.

    Raises:
        OSError: it cannot be read.
        ValueError: see parse_json_object.
    """
    return parse_json_object(path.read_bytes())


def parse_json_object(data: bytes) -> dict[str, Any]:
    """The values of a JSON text.

    Raises:
        ValueError: it is no UTF-8 text, no JSON, nested more deeply than Python can follow, or no object.
    """
    try:
        values = json.loads(data.decode("utf-8-sig"))
    except RecursionError:
        # Not chained: its traceback is a thousand lines of the same.
        raise ValueError("lists or objects nested too deeply") from None
    if not isinstance(values, dict):
        raise ValueError(f"a {type(values).__name__} at the top level")
    return values


def place(location: Sequence[str | int]) -> str:
    """Keys and indices from the top to a value, as "effects[0].shrink"; "" for the top itself."""
    steps = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in location)
    return "".join(steps).removeprefix(".")
