"""What a fit adds to its TensorBoard events when it is done."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from toile.physics.cloth import GRID_PARAMETERS
from toile.reports.dashboard import ASKED_FOR, Choice, write_dashboard
from toile.reports.run_folder import RunFolder, read_metrics
from toile.reports.run_settings import WITHOUT_INFLUENCE

# Groups of the configuration by which fits are compared.
_GROUPS = (
    "experiment",
    "ablation",
    "optimization",
    "loss",
    "simulator",
    "simulator/integrator",
    "cloth/rest_lengths",
    "renderer",
)


def write_final_numbers(cfg: DictConfig, run: RunFolder, config: str) -> None:
    """Add a run's final numbers and choices to its events; nothing where TensorBoard was switched off.

    Args:
        cfg: configuration of the fit.
        run: with metrics.json.
        config: the configuration as it was stored.
    """
    if run.dashboard.is_dir():
        write_dashboard(run.dashboard, compared_choices(cfg), config, read_metrics(run))


def compared_choices(cfg: DictConfig) -> dict[str, Choice]:
    """The few settings that fits are compared by, the same ones for every fit."""
    chosen = HydraConfig.get().runtime.choices
    choices: dict[str, Choice] = {"scene": Path(str(cfg.scene.name)).name}
    choices |= {group: str(chosen.get(group) or "–") for group in _GROUPS}
    asked = [str(o) for o in HydraConfig.get().overrides.task if not _has_its_own(str(o))]
    choices[ASKED_FOR] = ", ".join(sorted(asked)) or "nothing"
    choices["substeps"] = "as needed" if cfg.simulator.substeps is None else str(cfg.simulator.substeps)
    choices["seed"] = str(cfg.seed)  # a name, not a quantity
    for name in GRID_PARAMETERS.names:
        choices[f"start: {name}"] = float(cfg.parameters[name])
    return choices


def _has_its_own(override: str) -> bool:
    """Whether a setting is shown as a choice of its own, or leaves the result alone."""
    key = override.lstrip("+~").partition("=")[0]
    return key in ("scene", "scene.name", "seed", "resume") or key.partition(".")[0] in WITHOUT_INFLUENCE
