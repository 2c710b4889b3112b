"""Files of a scene's folder: in it, also after links, and numbered without a gap."""

from __future__ import annotations

from pathlib import Path

from toile.errors import InputError

_MOST_MISSING = 20  # images, until no more are looked for


def inside(folder: Path, name: str) -> Path:
    """The file of that name in a folder.

    Raises:
        InputError: it lies elsewhere. A scene may come from anybody, and what it shows ends up in pages.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(
            "A file of the scene lies outside its folder",
            where=str(path),
            expected="a file in the folder of scene.json, also after links in it; the folder may be a link",
            got=str(path.resolve()),
        )
    return path


def sequence(folder: Path, pattern: str, n: int) -> tuple[Path, ...]:
    """Files 0 ... n - 1; fewer if many of them are missing, since n may be anything."""
    paths: list[Path] = []
    missing = 0
    for k in range(n):
        paths.append(inside(folder, pattern % k))
        missing += not paths[-1].is_file()
        if missing == _MOST_MISSING:
            break
    return tuple(paths)
