"""How much may speak for none where an effect moves the cloth by little: docs/results/small_effects.md.

    python benchmarks/small_effects.py  # a minute

What a law on a grid is wrong by passes for an effect that moves the cloth by little, so what speaks for such
an effect is shared with none (MotionEvidence.odds). How far, ``surest`` says. It is asked of all evidence of
sessions with open labels that is kept here, whatever version of the method it is of: errors of the law were
larger in those of before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd
from kept_evidence import COLUMNS, by_engines, compared, kept_cases
from session_weights import RESULTS

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE
from toile.diagnosis.session_weights import SessionCase, SessionWeights
from toile.effects.catalogue import STAND_INS

PAGE = RESULTS / "small_effects.md"
SUREST = (1e9, 30.0, 20.0, 12.0, 8.0, 4.0)
"""Values that are compared; the first bounds nothing."""
MOST = 8
"""Lines that are shown of nulls."""


def of_nulls(every: Sequence[SessionCase], weights: SessionWeights) -> pd.DataFrame:
    """What speaks most, where nothing acts, for an effect that moves the cloth by less than ``smallest``."""
    rows = []
    for case in every:
        evidence, of_clips = case.evidence, weights.of_clips(case.clips)
        for name, size in evidence.sizes.items():
            if case.cause != NONE or name in STAND_INS or name not in evidence.effects:
                continue
            if size < weights.smallest:
                nats = evidence.nats(name)
                rows.append(
                    {
                        "session": case.session,
                        "clips": case.clips,
                        "effect": name,
                        "moves the cloth by [%]": 100 * size,
                        "evidence [nats]": nats,
                        "e-folds": (nats - of_clips.threshold) / of_clips.temperature,
                    }
                )
    return pd.DataFrame(rows).sort_values("e-folds", ascending=False)


def page(table: pd.DataFrame, nulls: pd.DataFrame, n: Mapping[str, int], weights: SessionWeights) -> str:
    """Both tables in words."""
    counted = " and ".join(f"{count} of {name}" for name, count in n.items())
    return "\n".join(
        [
            "# Effects that move the cloth by little",
            "",
            "Made by `python benchmarks/small_effects.py` from all evidence of sessions with open labels "
            f"that is kept here, of several versions: {counted}. What speaks for an effect that moves the "
            "cloth by less than some 1 % of its width speaks for `none` as well, by `surest` e-folds at "
            "most. Loss: mean negative log probability of the cause; named: with 0.9 and more.",
            "",
            table.to_markdown(index=False, floatfmt=COLUMNS),
            "",
            f"The package's is {weights.surest:g}: far beyond what errors of a law have shown. Below are "
            f"the {MOST} lines with most evidence of {len(nulls)}, of an effect that moves the cloth by "
            f"less than {100 * weights.smallest:g} % where nothing acts; e-folds: of its odds by that "
            "evidence alone.",
            "",
            nulls.head(MOST).to_markdown(index=False, floatfmt=("", "", "", ".2f", ".1f", ".1f")),
            "",
        ]
    )


def main() -> None:
    """Write the page."""
    weights = SessionWeights.load()
    every = kept_cases()
    engines = by_engines(every)
    values = {
        "no bound" if value == SUREST[0] else f"{value:g}": replace(weights, surest=value) for value in SUREST
    }
    n = {name: len(own) for name, own in engines.items()}
    text = page(compared(engines, "surest", values), of_nulls(every, weights), n, weights)
    write_text(PAGE, text)
    print(text)


if __name__ == "__main__":
    main()
