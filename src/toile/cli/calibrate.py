"""``toile calibrate RUN ...``: probabilities of the diagnosis from scenes whose effect is known."""

from __future__ import annotations

import logging
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig, ListConfig

from toile.atomic_file import write_text
from toile.blind.calibration import (
    calibrate,
    cases_of,
    left_out,
    read_labels,
    read_runs,
    read_table,
    summary,
    write_table,
)
from toile.cli.configuration import instantiate
from toile.cli.made_with import made_with_of
from toile.cli.terminal import print_path
from toile.diagnosis.decision import Calibration, probabilities
from toile.diagnosis.made_with import MadeWith
from toile.diagnosis.settings import DiagnosisSettings
from toile.errors import InputError

_log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> None:
    """Write a calibration that ``toile diagnose diagnosis.calibration=<file>`` loads, or try one out."""
    if cfg.exact_steps and not cfg.left_out:
        raise InputError(
            "A calibration for something that no diagnosis does",
            where="exact_steps",
            expected="exact_steps=true together with left_out=true",
            got="left_out=false",
        )
    made_with = made_with_of(cfg)
    table = _table(cfg, made_with)
    if cfg.exact_steps:
        table = table.assign(step=0.0)
    diagnosis: DiagnosisSettings = instantiate(cfg.diagnosis)
    making = instantiate(cfg.making)
    before = None if cfg.usual_from is None else Calibration.load(Path(cfg.usual_from))
    cases = cases_of(table, diagnosis.weights, diagnosis.usual_cost)
    if cfg.left_out:
        verdicts, score = left_out(cases, before, making, diagnosis.verdict)
        for case, verdict in zip(cases, verdicts, strict=True):
            print_path(
                f"{case.name:34s} {case.truth:22s} {verdict.effect:22s} {', '.join(verdict.candidates)}"
            )
        print_path(f"{summary(cases, verdicts)}\nlog score {score:.1f}")
        return
    if not cfg.source:
        raise InputError(
            "Nobody would know what the calibration is from",
            where="source",
            expected="source='what the scenes are'",
            got="nothing",
        )
    found = calibrate(cases, str(cfg.source), before, making, made_with)
    right = 0
    for case in cases:
        chances = probabilities(case.evidence, found)
        first, chance = next(iter(chances.items()))
        right += first == case.truth
        truth = chances.get(case.truth, 0)
        print_path(f"{case.name:34s} {case.truth:22s} {first:22s} {chance:.2f} truth {truth:.2f}")
    print_path(f"{right} of {len(cases)} right on the scenes it was made from, which is no test")
    print_path(f"for diagnoses with the settings {made_with.digest}")
    print_path(write_text(Path(cfg.output), found.to_json()))


def _table(cfg: DictConfig, made_with: MadeWith) -> pd.DataFrame:
    """What the scenes have measured, from runs or from the table of earlier ones."""
    runs = [*cfg.runs] if isinstance(cfg.runs, ListConfig) else [cfg.runs]
    if bool(runs) == bool(cfg.table):
        raise InputError(
            "Scenes come from runs or from a table",
            where="runs, table",
            expected="folders of toile diagnose with labels=<file>, or table=<CSV>",
            got="both" if runs else "neither",
        )
    if cfg.table:
        for unused in ("labels", "scenes"):
            if cfg[unused]:
                raise InputError(
                    "A table has labels already", where=unused, expected="null with table=", got=cfg[unused]
                )
        table = read_table(Path(cfg.table), made_with)
        if "settings" not in table:
            _log.warning(
                "%s does not say with which settings it was measured; taken to be those given here", cfg.table
            )
        return table
    if not cfg.labels:
        raise InputError(
            "The scenes' effects are not known", where="labels", expected="labels=<JSON file>", got="null"
        )
    table = read_runs([Path(str(r)) for r in runs], read_labels(Path(cfg.labels)), made_with)
    if cfg.scenes:
        print_path(write_table(Path(cfg.scenes), table))
    return table
