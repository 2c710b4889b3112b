"""What belongs together in TensorBoard: the charts of its Custom Scalars page."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, final

from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger

from toile.learning.fit.callbacks.chamfer import CHAMFER_TAG, ChamferLogger
from toile.learning.fit.module import PER_FRAME, PROCESSOR_SECONDS, FitModule, scalar_tag
from toile.reconstruction.parameters import ClothParameters

Layout = dict[str, dict[str, list[Any]]]
"""Category, chart, and ["Multiline", patterns of tags], as SummaryWriter.add_custom_scalars takes it."""


@final
class DashboardLayout(Callback):
    """Tells TensorBoard, once the first cycle has shown what there is, which curves share a chart."""

    def __init__(self) -> None:
        self._written = False

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write the layout after the first cycle."""
        assert isinstance(pl_module, FitModule)
        if self._written:
            return
        self._written = True
        chamfer = any(isinstance(c, ChamferLogger) and c.has_targets for c in trainer.callbacks)  # type: ignore[attr-defined]
        layout = fit_layout(pl_module.history[-1], chamfer=chamfer)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_custom_scalars(layout)


def fit_layout(columns: Iterable[str], *, chamfer: bool) -> Layout:
    """Charts for the columns of a history; runs with the same columns share them.

    Args:
        columns: see ``toile.learning.fit.module.row``.
        chamfer: whether there is a Chamfer curve.
    """
    names = [c for c in columns if c != "cycle"]
    columns_of_terms = [c for c in _matching("loss ", names) if c != PER_FRAME]
    terms = [c.removeprefix("loss ") for c in columns_of_terms]
    # Charts of one title and different curves stay apart, so recipes are told from each other by the title.
    fit = {PER_FRAME: _chart(PER_FRAME)}
    if terms:
        fit[f"terms of the loss: {', '.join(terms)}"] = _chart(*columns_of_terms)
    fit["loss, summed over the frames of the window"] = _chart("loss")
    if chamfer:
        fit["Chamfer x1e4 [m²] over the cycles"] = ["Multiline", [_exactly(CHAMFER_TAG)]]
    charts: Layout = {"fit": fit}
    charts["stiffness, network units"] = {
        f"{name} {symbol}": _chart(f"{name} [network units]")
        for name, symbol in zip(ClothParameters.STIFFNESSES, "YSB", strict=True)
    }
    charts["forces"] = {
        "wind x, y, z [m/s²]": _chart(*_matching("wind ", names)),
        "turbulence rms [m/s²]": _chart("turbulence rms [m/s²]"),
        "boundary motion rms [mm]": _chart("boundary motion rms [mm]"),
    }
    times = [c for c in ("seconds", PROCESSOR_SECONDS) if c in names]
    charts["work"] = {"time per cycle [s]": _chart(*times), "frames covered": _chart("frames")}
    iterations = [c for c in names if c.endswith("iterations")]
    if iterations:
        charts["work"]["iterations per cycle"] = _chart(*iterations)
    return charts


def _matching(prefix: str, names: list[str]) -> list[str]:
    return [name for name in names if name.startswith(prefix)]


def _chart(*columns: str) -> list[Any]:
    return ["Multiline", [_exactly(scalar_tag(c)) for c in columns]]


def _exactly(tag: str) -> str:
    """TensorBoard matches beginnings: "fit/loss" would also be "fit/loss_image"."""
    return f"{re.escape(tag)}$"
