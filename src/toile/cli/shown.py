"""``toile <command> --help``: choices and settings of a command, without loading what carries it out."""

from __future__ import annotations

import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from toile.cli.configuration import CONF
from toile.cli.groups import group_choices, groups_of


class Composed(NamedTuple):
    """The configuration of a command.

    Attributes:
        cfg: everything, Hydra's own part among it.
        groups: the groups that the command takes, and their choices.
    """

    cfg: DictConfig
    groups: dict[str, list[str]]


def composed(command: str, overrides: Sequence[str], more: Path | None = None, name: str = "") -> Composed:
    """Compose the configuration of a command as Hydra does for a single run.

    Args:
        command: its name.
        overrides: ``key=value``, in Hydra's grammar.
        more: a further folder of the configuration, as given by --config-dir.
        name: of the file to begin with, if it is not that of the command.

    Raises:
        HydraException: the overrides do not fit.
    """
    search = [] if more is None else [f"hydra.searchpath=['file://{more.resolve()}']"]
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), job_name=command, version_base="1.3"):
        cfg = compose(name or command, [*overrides, *search], return_hydra_config=True)
    chosen = [group for group in cfg.hydra.runtime.choices if not str(group).startswith("hydra/")]
    return Composed(cfg, groups_of(group_choices([CONF] if more is None else [CONF, more]), chosen))


def help_text(command: str, arguments: Sequence[str]) -> str:
    """What ``toile <command> <arguments> --help`` prints.

    Hydra's own function looks at every group anew for every line of it, which takes seconds.

    Raises:
        HydraException: the overrides do not fit.
    """
    given: Any = get_args_parser().parse_args(list(arguments))
    more = None if given.config_dir is None else Path(given.config_dir)
    cfg, groups = composed(command, given.overrides, more, given.config_name or "")
    HydraConfig.instance().set_config(cfg)
    template = string.Template(cfg.hydra.help.template)
    with open_dict(cfg):
        del cfg["hydra"]
    return template.safe_substitute(
        APP_CONFIG_GROUPS="".join(f"{group}: {', '.join(names)}\n" for group, names in groups.items()),
        CONFIG=OmegaConf.to_yaml(cfg, resolve=given.resolve),
    )
