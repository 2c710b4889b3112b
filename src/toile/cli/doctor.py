"""``toile doctor scene=R1``: everything that can be said about a scene, as a table."""

from __future__ import annotations

from collections import Counter

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.table import Table
from rich.text import Text

from toile.cli.failures import BAD_INPUT, CommandError
from toile.cli.terminal import console
from toile.errors import InputError
from toile.scenes.doctor import diagnose
from toile.scenes.findings import Severity, has_errors

PLURAL = {Severity.ERROR: "errors", Severity.WARNING: "warnings", Severity.INFO: "notes"}
STYLE = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: "dim"}


_USED = ("scene.name", "scene.data_dir")


def _check_nothing_else_asked() -> None:
    """The scene is looked at as it lies there: what a fit would be told beside it is not checked.

    Raises:
        InputError: it was asked for all the same.
    """
    asked = [o.lstrip("+~").partition("=") for o in HydraConfig.get().overrides.task]
    others = [f"{key}={value}" for key, _, value in asked if key.startswith("scene.") and key not in _USED]
    if others:
        raise InputError(
            "toile doctor looks at a scene as it lies there",
            where="toile doctor",
            expected=f"scene=, {' or '.join(_USED)}; toile fit checks the rest before it begins",
            got=", ".join(others),
        )


def run(cfg: DictConfig) -> None:
    """Print the findings; exit status 2 if any of them is an error."""
    name = str(cfg.scene.name)
    _check_nothing_else_asked()
    findings = diagnose(name, cfg.scene.data_dir)
    table = Table(
        "", "finding", "where", "expected", "got", title=Text(f"Scene {name}"), title_justify="left"
    )
    for f in findings:
        row = (f.severity, f.what, f.where, f.expected, f.got)
        # As Text, because brackets in paths and values are no markup.
        table.add_row(*(Text(str(cell), overflow="fold") for cell in row), style=STYLE[f.severity])
    out = console()
    if findings:
        out.print(table)
    count = Counter(f.severity for f in findings)
    out.print(", ".join(f"{plural}: {count[severity]}" for severity, plural in PLURAL.items()))
    if has_errors(findings):
        raise CommandError(BAD_INPUT)
