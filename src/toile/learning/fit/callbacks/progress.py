"""Progress of a fit on the terminal."""

from __future__ import annotations

import logging
from typing import Any, final

from lightning import LightningModule, Trainer

from toile.learning.fit.module import PER_FRAME, FitModule
from toile.learning.progress import ProgressShown
from toile.limits import Count
from toile.reconstruction.parameters import ClothParameters

log = logging.getLogger(__name__)


@final
class FitProgress(ProgressShown):
    """A bar with loss, frames covered and stiffness; plain log lines where there is no terminal.

    Args:
        log_every: cycles between two log lines; there are more where cycles take longer than ten seconds.
    """

    def __init__(self, log_every: Count) -> None:
        super().__init__(log, leave=True)
        self.log_every = log_every

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Say what is ahead."""
        super().on_train_start(trainer, pl_module)
        assert isinstance(pl_module, FitModule)
        assert self.shown is not None
        frames, cycles = pl_module.reconstruction.scene.n_frames, pl_module.n_cycles
        self.shown("cycle", pl_module.cycles_done, cycles)
        if self.shown.as_lines:
            log.info("fitting %d frames in %d cycles", frames, cycles)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance, and print what the recipe has noted."""
        assert isinstance(pl_module, FitModule)
        assert self.shown is not None
        done, total, report = pl_module.cycles_done, pl_module.n_cycles, pl_module.report
        for note in () if report is None else report.notes:
            log.info("cycle %d: %s", done - 1, note)
        state = _state(pl_module)
        if self.shown.as_lines and (done % self.log_every == 0 or done == total):
            log.info("cycle %d of %d: %s", done, total, state)
            self.shown.said()
        else:
            self.shown("cycle", done, total, state)


def _state(module: FitModule) -> str:
    last, n = module.history[-1], module.reconstruction.scene.n_frames
    stiffness = " ".join(
        f"{symbol} {last[f'{name} [network units]']:.4g}"
        for symbol, name in zip("YSB", ClothParameters.STIFFNESSES, strict=True)
    )
    return f"{PER_FRAME} {last[PER_FRAME]:.4g}, {last['frames']:.0f} of {n} frames, {stiffness}"
