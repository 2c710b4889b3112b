"""The Lightning trainer of fits and trainings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lightning import Callback, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from toile.cli.configuration import instantiate
from toile.errors import InputError


def make_trainer(settings: DictConfig, callbacks: Sequence[Callback], logger: Any) -> Trainer:
    """The trainer that the configuration describes; with checkpoints where a callback writes them.

    Raises:
        InputError: this machine, or Lightning, does not have what it asks for.
    """
    given: dict[str, Any] = {"callbacks": list(callbacks), "logger": logger}
    if "enable_checkpointing" not in settings:
        given["enable_checkpointing"] = any(isinstance(c, Checkpoint) for c in callbacks)
    try:
        trainer: Trainer = instantiate(settings)(**given)
    except (MisconfigurationException, ValueError, TypeError, ImportError) as error:
        raise InputError(
            "The trainer cannot be made",
            where="trainer",
            expected="settings of lightning.Trainer that this machine can serve, such as trainer=cpu",
            got=" ".join(str(error).split()),
        ) from error
    return trainer
