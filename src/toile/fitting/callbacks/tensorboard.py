"""TensorBoard: curves after every cycle, pictures and the mesh now and then."""

from __future__ import annotations

from typing import Any, final

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from toile.fitting.module import FitModule


@final
class CurveLogger(Callback):
    """Sends every row of the history to whatever loggers there are."""

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Log the last row under ``fit/``."""
        assert isinstance(pl_module, FitModule)
        numbers = {f"fit/{_tag(k)}": v for k, v in pl_module.history[-1].items() if k != "cycle"}
        for logger in trainer.loggers:
            logger.log_metrics(numbers, step=pl_module.cycles_done - 1)


@final
class PictureLogger(Callback):
    """Draws rendered | observed | difference and the mesh into TensorBoard.

    Args:
        every: cycles between two drawings; the last cycle is always drawn.
        frames: number of frames to draw, evenly spread over those covered.
    """

    def __init__(self, every: int, frames: int) -> None:
        self.every = every
        self.frames = frames

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Draw if it is time."""
        assert isinstance(pl_module, FitModule)
        done, report = pl_module.cycles_done, pl_module.report
        writers = [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        if not writers or report is None or not (done % self.every == 0 or done == pl_module.n_cycles):
            return
        faces = pl_module.reconstruction.faces
        for f in (
            torch.linspace(0, report.n_frames - 1, min(self.frames, report.n_frames)).round().int().tolist()
        ):
            picture = _picture(pl_module, report.positions[f], f)
            # TensorBoard shows y up and looks along -z.
            mesh = report.positions[f] * torch.tensor([1.0, -1.0, -1.0], dtype=report.positions.dtype)
            for writer in writers:
                writer.add_image(f"frame {f:03d}", picture, done - 1, dataformats="HWC")
                writer.add_mesh(f"mesh {f:03d}", mesh[None].float(), faces=faces[None], global_step=done - 1)


@torch.no_grad()
def _picture(module: FitModule, positions: Tensor, frame: int) -> Tensor:
    """Rendered, observed and their absolute difference side by side, (h, 3 w, 3)."""
    r = module.reconstruction
    uv = r.texture_coordinates + r.parameters.texture_offset
    rendered = r.renderer.render(positions[None], r.faces, uv, r.scene.texture, r.scene.camera).rgb[0]
    observed = r.scene.frames[frame] * r.scene.masks[frame][..., None]
    return torch.cat((rendered, observed, (rendered - observed).abs()), 1).clamp(0, 1)


def _tag(column: str) -> str:
    """A column's name without what TensorBoard does not allow in tags."""
    return column.replace("²", "2").replace(" [", "_").replace("]", "").replace(" ", "_").replace("/s", "_s")
