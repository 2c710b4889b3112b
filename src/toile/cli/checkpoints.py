"""Checkpoints, looked at before a run continues from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import nn

from toile.errors import InputError


def check_checkpoint(path: Path, module: nn.Module, key: str, kind: str) -> None:
    """Refuse a file from which a run cannot continue.

    Args:
        path: the checkpoint.
        module: what is to be restored from it; it stays as it is.
        key: under which such a run keeps its state.
        kind: "fit" or "training", for messages.

    Raises:
        InputError: it is torn, no checkpoint, or that of another run.
    """
    try:
        content: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # PyTorch has a dozen exceptions for it, and advice that does not apply here.
        first = str(error).strip().partition("\n")[0][:120]
        raise _unusable(path, kind, f"{type(error).__name__}: {first}") from error
    if not isinstance(content, dict):
        raise _unusable(path, kind, f"a {type(content).__name__}")
    missing = {key, "state_dict", "pytorch-lightning_version"} - content.keys()
    if missing:
        raise _unusable(path, kind, f"nothing under {', '.join(sorted(missing))}")
    there, here = _shapes(content["state_dict"]), _shapes(module.state_dict())
    for name in sorted(there.keys() | here.keys()):
        if there.get(name) != here.get(name):
            found = f"{name} of shape {there.get(name)} instead of {here.get(name)}"
            raise _unusable(path, kind, f"that of another {kind}: {found}")


def _shapes(state: Any) -> dict[str, tuple[int, ...]]:
    return {str(name): tuple(value.shape) for name, value in state.items() if isinstance(value, torch.Tensor)}


def _unusable(path: Path, kind: str, got: str) -> InputError:
    return InputError(
        f"The {kind} cannot be continued from this checkpoint",
        where=str(path),
        expected=f"a checkpoint of an interrupted {kind}; delete the file to start the {kind} anew",
        got=got,
    )
