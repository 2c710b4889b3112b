"""Lightning without its advertisements."""

from __future__ import annotations

import logging
import warnings


def quiet_lightning() -> None:
    """Keep Lightning's log to warnings: no list of missing accelerators, no tips.

    Also hides that Lightning uses a part of PyTorch that newer versions rename, and that a short epoch may
    have no step that is logged.
    """
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning, module="lightning")
    warnings.filterwarnings("ignore", message=".*smaller than the logging interval", module="lightning")
