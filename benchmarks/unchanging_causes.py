"""How much evidence a cause from outside needs that has no history: docs/results/unchanging_causes.md.

    python benchmarks/unchanging_causes.py  # a minute

Beside free forces a cause from outside is asked for more evidence than what a motion is wrong by has been
seen to give it. Gusts, over twenty numbers a clip, take up more of that than drag, a tilt or a wrong clock,
which one to three numbers say (UNCHANGING). Which share of the others' threshold is asked of those,
``outside_unchanging`` says. It is asked of the evidence of sessions with open labels that is kept here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from kept_evidence import COLUMNS, by_engines, compared, kept_cases
from session_weights import RESULTS

from toile.atomic_file import write_text
from toile.diagnosis.decision import UNKNOWN
from toile.diagnosis.session_weights import SessionCase, SessionWeights
from toile.effects.catalogue import OUTSIDE, STAND_INS, WEIGHING

PAGE = RESULTS / "unchanging_causes.md"
SHARES = (1.0, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
"""Values that are compared; with the first all causes are asked for the same."""


def even(weights: SessionWeights) -> SessionWeights:
    """The same, but all causes from outside are asked for the same."""
    return replace(weights, outside_unchanging=1.0)


def where_idle(every: Sequence[SessionCase]) -> pd.DataFrame:
    """The most that causes from outside have beside free forces where none acts, by cause [nats]."""
    rows = []
    idle = [case for case in every if case.cause not in (*OUTSIDE, UNKNOWN) and case.evidence.outside]
    for name in (name for name in OUTSIDE if name not in WEIGHING):
        row: dict[str, object] = {"cause": name}
        for engines, own in by_engines(idle).items():
            nats = [case.evidence.freed_nats(name) for case in own if name in case.evidence.outside]
            row |= {f"cases, {engines}": len(nats)}
            row |= {
                f"nine of ten below, {engines}": float(np.quantile(nats, 0.9)),
                f"most, {engines}": max(nats),
            }
        rows.append(row)
    return pd.DataFrame(rows)


def changed(every: Sequence[SessionCase], before: SessionWeights, now: SessionWeights) -> pd.DataFrame:
    """Cases whose most probable answer, or the cause's probability by more than 0.1, is another."""
    rows = []
    for case in every:
        was, found = case.chances(before), case.chances(now)
        first, then = max(was, key=lambda n: was[n]), max(found, key=lambda n: found[n])
        if first != then or abs(was[case.cause] - found[case.cause]) > 0.1:
            rows.append(
                {
                    "session": case.session,
                    "clips": case.clips,
                    "cause": case.cause,
                    "before": f"{first} ({was[first]:.2f})",
                    "now": f"{then} ({found[then]:.2f})",
                    "the cause, before": was[case.cause],
                    "the cause, now": found[case.cause],
                }
            )
    return pd.DataFrame(rows)


def page(today: Sequence[SessionCase], others: Sequence[SessionCase], weights: SessionWeights) -> str:
    """All tables in words."""
    values = {f"{share:g}": replace(weights, outside_unchanging=share) for share in SHARES}
    least = weights.outside_threshold
    return "\n".join(
        [
            "# Causes from outside that have no history",
            "",
            "Made by `python benchmarks/unchanging_causes.py` from evidence of sessions with open labels "
            f"that is kept here, of several versions: {_counted(today)} by a base model as fine as today's, "
            f"{_counted(others)} by a coarser grid, before. Development data, no blind check; MuJoCo's cases "
            "choose nothing. Beside free forces a cause from outside is asked for "
            f"{least:.1f} nats from one clip (`outside_threshold`); drag, a tilt of gravity and a wrong "
            "clock, which one to three numbers say, for a share of that (`outside_unchanging`).",
            "",
            "## What they have where nothing from outside acts",
            "",
            "Evidence beside free forces [nats], by a base model as fine as today's. "
            f"Stand-ins ({', '.join(STAND_INS)}) and a density, which is not from outside "
            "alone, are left out.",
            "",
            where_idle(today).to_markdown(index=False, floatfmt=".1f"),
            "",
            "## Answers by share",
            "",
            "Loss: mean negative log probability of the cause; named: with 0.9 and more.",
            "",
            "### By a base model as fine as today's",
            "",
            compared(by_engines(today), "share", values).to_markdown(index=False, floatfmt=COLUMNS),
            "",
            "### By a coarser grid, before",
            "",
            compared(by_engines(others), "share", values).to_markdown(index=False, floatfmt=COLUMNS),
            "",
            f"The package's is {weights.outside_unchanging:g}: the least loss on the cases of own and "
            "Blender by today's grid.",
            "",
            "## What changes",
            "",
            "Against a share of 1: another answer, or a probability of the cause that differs by more than "
            "0.1.",
            "",
            "### Of today's grid",
            "",
            changed(today, even(weights), weights).to_markdown(index=False, floatfmt=".2f"),
            "",
            "### Of a coarser grid",
            "",
            changed(others, even(weights), weights).to_markdown(index=False, floatfmt=".2f"),
            "",
        ]
    )


def _counted(cases: Sequence[SessionCase]) -> str:
    return " and ".join(f"{len(own)} of {name}" for name, own in by_engines(cases).items())


def main() -> None:
    """Write the page."""
    text = page(kept_cases(of_today=True), kept_cases(of_today=False), SessionWeights.load())
    write_text(PAGE, text)
    print(text)


if __name__ == "__main__":
    main()
