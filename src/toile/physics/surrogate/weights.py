"""Weights of the surrogate on disk: loaded safely, checked before use."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

import torch

from toile.atomic_file import written_atomically
from toile.errors import InputError
from toile.physics.surrogate.surrogate import Surrogate

# Raised whenever inputs, outputs or units of the network change their meaning.
FORMAT = "toile-surrogate-1"
UNITS = "edge 1, interior mass 1, effective step 1"
_PACKAGED = "surrogate.pt"


def packaged_weights() -> Path:
    """The weights that come with the package."""
    return Path(str(resources.files("toile.physics.surrogate") / _PACKAGED))


def save_weights(path: Path, surrogate: Surrogate, description: dict[str, str]) -> None:
    """Write weights, architecture and a description (command, date, seed ...) atomically."""
    content = {
        "format": FORMAT,
        "units": UNITS,
        "widths": list(surrogate.network.widths),
        "description": {str(k): str(v) for k, v in description.items()},
        "weights": {k: v.detach().cpu().contiguous() for k, v in surrogate.state_dict().items()},
    }
    # Given a path, torch would write the temporary file's name into the file.
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def load_weights(path: Path | None = None) -> Surrogate:
    """The surrogate with the weights of a file; of the package if no path is given.

    Raises:
        InputError: there is no such file, or it holds something else, or weights of another format.
    """
    content = _read(packaged_weights() if path is None else path)
    surrogate = Surrogate(content["widths"])
    surrogate.load_state_dict(content["weights"])
    # The layout in which convolutions on the CPU are fastest.
    surrogate.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return surrogate.eval().requires_grad_(False)


def describe_weights(path: Path | None = None) -> dict[str, str]:
    """How the weights of a file were made."""
    description: dict[str, str] = _read(packaged_weights() if path is None else path)["description"]
    return description


def _read(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(
            "no weights of the surrogate",
            where=str(path),
            expected="a file written by toile train",
            got="no such file",
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise _unusable(path, "a file written by toile train", str(error)) from error
    if not isinstance(content, dict) or "format" not in content:
        raise _unusable(path, f"format {FORMAT}", "a file without a format")
    missing = {"units", "widths", "weights", "description"} - content.keys()
    if missing:
        found = f"a file without {', '.join(sorted(missing))}"
        raise _unusable(path, "weights with their description", found)
    for key, expected in (("format", FORMAT), ("units", UNITS)):
        if content[key] != expected:
            raise _unusable(path, f"{key}: {expected}", str(content[key]))
    shapes = {k: tuple(v.shape) for k, v in Surrogate(content["widths"]).state_dict().items()}
    got = {k: tuple(v.shape) for k, v in content["weights"].items()}
    for name in sorted(shapes.keys() | got.keys()):
        if shapes.get(name) != got.get(name):
            raise _unusable(path, f"{name} of shape {shapes.get(name)}", str(got.get(name)))
    return content


def _unusable(path: Path, expected: str, got: str) -> InputError:
    return InputError("unusable weights of the surrogate", where=str(path), expected=expected, got=got)
