"""Progress of a fit on the terminal."""

from __future__ import annotations

import logging
from typing import Any, final

from lightning import Callback, LightningModule, Trainer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from toile.learning.fit.module import PER_FRAME, FitModule
from toile.limits import Count
from toile.progress import Lines
from toile.reconstruction.parameters import ClothParameters

log = logging.getLogger(__name__)


@final
class FitProgress(Callback):
    """A bar with loss, frames covered and stiffness; plain log lines where there is no terminal.

    Args:
        log_every: cycles between two log lines; there are more where cycles take longer than ten seconds.
    """

    def __init__(self, log_every: Count) -> None:
        self.log_every = log_every
        self._console = Console(stderr=True)
        self._lines = Lines(log)
        self._bar: Progress | None = None
        self._task: Any = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show the bar."""
        assert isinstance(pl_module, FitModule)
        self._lines = Lines(log)
        self._lines("cycle", pl_module.cycles_done, pl_module.n_cycles)
        if self._console.is_terminal:
            self._bar = Progress(
                TextColumn("fit"),
                BarColumn(bar_width=12),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[state]}"),
                console=self._console,
            )
            self._task = self._bar.add_task(
                "fit", total=pl_module.n_cycles, completed=pl_module.cycles_done, state=""
            )
            self._bar.start()
        else:
            log.info(
                "fitting %d frames in %d cycles", pl_module.reconstruction.scene.n_frames, pl_module.n_cycles
            )

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance the bar, and print what the recipe has noted."""
        assert isinstance(pl_module, FitModule)
        done, report = pl_module.cycles_done, pl_module.report
        for note in () if report is None else report.notes:
            log.info("cycle %d: %s", done - 1, note)
        state = _state(pl_module)
        if self._bar is not None:
            self._bar.update(self._task, completed=done, state=state)
        elif done % self.log_every == 0 or done == pl_module.n_cycles:
            log.info("cycle %d of %d: %s", done, pl_module.n_cycles, state)
            self._lines.said()
        else:
            self._lines("cycle", done, pl_module.n_cycles, state)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the bar as it is."""
        self._stop()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Leave the bar as it is."""
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def _state(module: FitModule) -> str:
    last, n = module.history[-1], module.reconstruction.scene.n_frames
    stiffness = " ".join(
        f"{symbol} {last[f'{name} [network units]']:.4g}"
        for symbol, name in zip("YSB", ClothParameters.STIFFNESSES, strict=True)
    )
    return f"{PER_FRAME} {last[PER_FRAME]:.4g}, {last['frames']:.0f} of {n} frames, {stiffness}"
