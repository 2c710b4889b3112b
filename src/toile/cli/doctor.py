"""``toile doctor scene=R1``: everything that can be said about a scene, as a table."""

from __future__ import annotations

from collections import Counter

from omegaconf import DictConfig
from rich.table import Table
from rich.text import Text

from toile.cli.failures import BAD_INPUT, CommandError
from toile.cli.terminal import console
from toile.scenes.doctor import diagnose
from toile.scenes.findings import Severity, has_errors

PLURAL = {Severity.ERROR: "errors", Severity.WARNING: "warnings", Severity.INFO: "notes"}
STYLE = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: "dim"}


def run(cfg: DictConfig) -> None:
    """Print the findings; exit status 2 if any of them is an error."""
    name = str(cfg.scene.name)
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
