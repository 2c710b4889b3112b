"""Ends a run between two steps: on Ctrl-C, or when its time is up."""

from __future__ import annotations

import signal
import threading
from typing import Any, final

from lightning import Callback, LightningModule, Trainer

from toile.learning.surrogate.module import SurrogateTraining

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@final
class StopBetweenSteps(Callback):
    """Lets the running step end, then stops; a second signal ends the program at once.

    With several processes, one that wants to stop takes the others along.

    Args:
        minutes: longest time of the run, all its resumes together; None for no limit.

    Attributes:
        interrupted: whether a signal asked for the stop.
        out_of_time: whether the limit did.
    """

    def __init__(self, minutes: float | None) -> None:
        self.minutes = minutes
        self.interrupted = False
        self.out_of_time = False
        self._before: dict[int, Any] = {}

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take over the signals."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in _SIGNALS}

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop if it is time."""
        assert isinstance(pl_module, SurrogateTraining)
        late = self.minutes is not None and pl_module.seconds >= 60 * self.minutes
        self.interrupted = trainer.strategy.reduce_boolean_decision(self.interrupted, all=False)
        self.out_of_time = trainer.strategy.reduce_boolean_decision(late, all=False)
        if self.interrupted or self.out_of_time:
            trainer.should_stop = True

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Give the signals back."""
        self._release()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Give the signals back."""
        self._release()

    def _note(self, number: int, frame: object) -> None:
        self.interrupted = True
        self._release()

    def _release(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
