"""Files that a command writes where the user says."""

from __future__ import annotations

from pathlib import Path

from toile.errors import InputError


def new_file(path: object, suffix: str, overwrite: bool) -> Path:
    """The path to write to, checked before anything is computed.

    Args:
        path: as the user gave it.
        suffix: that it must have, e.g. ".npz".
        overwrite: whether a file may be there already.

    Raises:
        InputError: another suffix, or a file that is there already.
    """
    file = Path(str(path))
    if file.suffix.lower() != suffix:
        raise InputError(
            "File has another suffix", where=str(file), expected=suffix, got=file.suffix or "none"
        )
    if file.exists() and not overwrite:
        raise InputError(
            "File is there already", where=str(file), expected="a new name, or overwrite=true", got="a file"
        )
    return file
