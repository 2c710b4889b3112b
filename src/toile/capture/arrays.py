"""Archives of named arrays (.npz) that hold no code: written atomically, the same bytes every time."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from toile.atomic_file import written_atomically
from toile.errors import InputError

Array = npt.NDArray[Any]

# The earliest time a zip entry can have: a file does not depend on when it was written.
_EPOCH = (1980, 1, 1, 0, 0, 0)


def write_arrays(path: Path | str, arrays: Mapping[str, Array]) -> Path:
    """Write arrays to a compressed .npz; the same arrays give the same bytes.

    Args:
        path: file to write.
        arrays: by name; none of them of objects.
    """
    path = Path(path)
    with written_atomically(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content.getvalue(), compresslevel=9)
    return path


def read_arrays(path: Path | str, what: str, required: tuple[str, ...]) -> dict[str, Array]:
    """Read an .npz without pickle.

    Args:
        path: file to read.
        what: what it should hold, for messages, e.g. "Subject".
        required: names that must be there.

    Raises:
        InputError: missing, no such archive, or a name is missing.
    """
    path = Path(path)
    expected = f"an .npz with {', '.join(required)}"
    if not path.is_file():
        raise InputError(f"{what} is missing", where=str(path), expected=expected, got="no such file")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:
        raise InputError(
            f"{what} cannot be read",
            where=str(path),
            expected=expected,
            got=f"{type(error).__name__}: {error}",
        ) from error
    missing = [name for name in required if name not in arrays]
    if missing:
        raise InputError(
            f"{what} is incomplete", where=str(path), expected=expected, got=f"no {', '.join(missing)}"
        )
    return arrays
