"""Ways to make something wrong: each gives a function that does it in a case's folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Breaker = Callable[[Path], None]
Values = dict[str, Any]


def at_once(*breakers: Breaker) -> Breaker:
    def prepare(folder: Path) -> None:
        for breaker in breakers:
            breaker(folder)

    return prepare


def put(name: str, content: bytes | str) -> Breaker:
    def prepare(folder: Path) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return prepare


def remove(name: str) -> Breaker:
    def prepare(folder: Path) -> None:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()

    return prepare


def move(name: str, to: str) -> Breaker:
    def prepare(folder: Path) -> None:
        (folder / to).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).rename(folder / to)

    return prepare


def copy(name: str, to: str) -> Breaker:
    def prepare(folder: Path) -> None:
        target = folder / to
        target.parent.mkdir(parents=True, exist_ok=True)
        if (folder / name).is_dir():
            shutil.copytree(folder / name, target)
        else:
            shutil.copy(folder / name, target)

    return prepare


def link(name: str, to: str) -> Breaker:
    def prepare(folder: Path) -> None:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.symlink_to(folder / to)

    return prepare


def cut(name: str, share: float = 0.5) -> Breaker:
    """Lose the end of a file."""

    def prepare(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return prepare


def edit(name: str, change: Callable[[Values], Any]) -> Breaker:
    """Change the values of a JSON file in place."""

    def prepare(folder: Path) -> None:
        path = folder / name
        values = json.loads(path.read_text())
        change(values)
        path.write_text(json.dumps(values))

    return prepare


def values(name: str, **new: Any) -> Breaker:
    return edit(name, lambda old: old.update(new))


def without(name: str, key: str) -> Breaker:
    return edit(name, lambda old: old.pop(key))


def text(name: str, change: Callable[[str], str]) -> Breaker:
    def prepare(folder: Path) -> None:
        path = folder / name
        path.write_text(change(path.read_text()))

    return prepare


def image(pattern: str, change: Callable[[np.ndarray], np.ndarray]) -> Breaker:
    """Change the pixels of images."""

    def prepare(folder: Path) -> None:
        from PIL import Image

        found = sorted(folder.glob(pattern))
        if not found:
            raise RuntimeError(f"no {pattern}")
        for path in found:
            with Image.open(path) as opened:
                pixels = np.asarray(opened).copy()
            Image.fromarray(np.ascontiguousarray(change(pixels))).save(path)

    return prepare


def vertices(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Breaker:
    """Change the positions (N, 3) of an OBJ file, whose order and faces stay."""

    def prepare(folder: Path) -> None:
        path = folder / name
        lines = path.read_text().splitlines()
        rows = [k for k, line in enumerate(lines) if line.startswith("v ")]
        old = np.array([[float(x) for x in lines[k].split()[1:4]] for k in rows])
        for k, new in zip(rows, change(old), strict=True):
            lines[k] = "v " + " ".join(repr(float(x)) for x in new)
        path.write_text("\n".join(lines) + "\n")

    return prepare


def arrays(name: str, change: Callable[[dict[str, np.ndarray]], Any]) -> Breaker:
    """Change the arrays of an NPZ file."""

    def prepare(folder: Path) -> None:
        path = folder / name
        with np.load(path) as stored:
            found = {key: stored[key] for key in stored.files}
        change(found)
        with path.open("wb") as file:
            np.savez_compressed(file, **found)

    return prepare


DEEP = "[" * 100_000
