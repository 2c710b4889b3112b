"""Settings of a configuration that the evidence of a diagnosis depends on."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig, OmegaConf

from toile.diagnosis.made_with import MadeWith


def made_with_of(cfg: DictConfig) -> MadeWith:
    """Settings of a diagnosis that its evidence depends on: its own, and those of tracking and the images.

    Args:
        cfg: of ``toile diagnose`` or ``toile calibrate``.
    """
    # The last stage alone tracks the motion.
    stages = {name: stage for name, stage in (cfg.optimization.get("stages") or {}).items() if stage}
    last = dict(list(stages.items())[-1:])
    return MadeWith.of(
        {
            "diagnosis": _plain(cfg.diagnosis),
            "optimization": {"stages": {str(name): _plain(stage) for name, stage in last.items()}},
            "simulator": _plain(cfg.simulator),
            "renderer": _plain(cfg.renderer),
            "cloth": {name: _plain(cfg.cloth[name]) for name in ("law", "rest_lengths")},
            "candidates": sorted(str(name) for name, effect in cfg.candidates.items() if effect is not None),
        }
    )


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=True)
