"""What the user reads, and the exit status, when a command fails."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import NamedTuple

from hydra.errors import HydraException, InstantiationException
from omegaconf.errors import (
    InterpolationToMissingValueError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from toile.atomic_file import disk_failure
from toile.errors import InputError

BAD_INPUT = 2
SIMULATION_FAILED = 3
PROCESS_KILLED = 4
INTERRUPTED = 130

FULL_ERROR_VARIABLE = "HYDRA_FULL_ERROR"


_KILLED = (
    "error: A process that shared the work was killed, most often because the memory was full; fewer at a "
    "time need less. Stages that were finished are kept."
)


class CommandError(Exception):
    """A command failed and has said why; carries the exit status through Hydra and its launchers."""

    def __init__(self, status: int) -> None:
        self.status = status
        super().__init__(status)


class Failure(NamedTuple):
    """A failure that needs no traceback."""

    message: str
    status: int


def explain(error: BaseException) -> Failure | None:
    """The message for a mistake of the user or a failed simulation; None for a mistake in the program."""
    # A simulation can only have failed where it was loaded; loading it, and PyTorch, for a typing error would
    # make the user wait for the message.
    simulators = sys.modules.get("toile.physics.simulator")
    pools = sys.modules.get("concurrent.futures.process")
    disk = disk_failure(error)
    if disk is not None:
        # Python does not always know the file.
        where = f": {disk.filename}" if disk.filename else ""
        return Failure(f"error: {disk.strerror}{where}", BAD_INPUT)
    failure = None
    for cause in _chain(error):
        if isinstance(cause, InputError):
            return Failure(f"error: {cause}", BAD_INPUT)
        if simulators is not None and isinstance(cause, simulators.SimulationError):
            return Failure(f"error: {cause}", SIMULATION_FAILED)
        if pools is not None and isinstance(cause, pools.BrokenProcessPool):
            # Those of joblib are of this kind as well.
            return Failure(_KILLED, PROCESS_KILLED)
    if isinstance(error, MissingMandatoryValue | InterpolationToMissingValueError):
        failure = _missing(error)
    elif isinstance(error, InstantiationException):
        # Arguments that do not fit are a mistake in the configuration; anything else is one in the program.
        if isinstance(error.__cause__, TypeError | ValueError | None):
            failure = _messages(error)
    elif isinstance(error, HydraException | OmegaConfBaseException):
        failure = _messages(error)
    elif isinstance(error, OSError) and error.filename is not None:
        failure = Failure(f"error: {error.strerror}: {error.filename}", BAD_INPUT)
    return failure


def _missing(error: OmegaConfBaseException) -> Failure:
    if "scene.name" in f"{error} {error.full_key}":
        return Failure(
            "error: no scene is given; say scene=<name in the data folder, or path of a folder>", BAD_INPUT
        )
    key = error.full_key or "a value"
    return Failure(f"error: {key} is missing; say {key}=...", BAD_INPUT)


def _messages(error: Exception) -> Failure:
    # Where Hydra has looked helps nobody who has mistyped a choice.
    parts = dict.fromkeys(str(e).partition("Config search path:")[0].strip() for e in _chain(error))
    return Failure("error: " + "\n".join(parts), BAD_INPUT)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__
