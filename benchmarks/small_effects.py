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
from held_corners import TABLE as HELD_CORNERS
from session_ladder import NEVER_LEARNT_FROM
from session_weights import RESULTS, cases_of, named, of_width

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_weights import SessionCase, SessionWeights, lapsed_loss
from toile.effects.catalogue import STAND_INS

PAGE = RESULTS / "small_effects.md"
SUREST = (1e9, 30.0, 20.0, 12.0, 8.0, 4.0)
"""Values that are compared; the first bounds nothing."""
MOST = 8
"""Lines that are shown of nulls."""


def cases() -> list[SessionCase]:
    """Of all tables of evidence; a session that two versions have judged counts twice."""
    held = pd.read_csv(HELD_CORNERS)
    tables = [of_width(held, SessionSettings().held)]
    tables += [pd.read_csv(path) for path in sorted(RESULTS.glob("session_evidence_*.csv"))]
    of_engines = [
        [replace(case, session=f"{engine} {case.session}") for case in cases_of(own)]
        for table in tables
        for engine, own in table.groupby("engine", sort=False)
    ]
    return [case for own in of_engines for case in own]


def compared(every: Sequence[SessionCase], weights: SessionWeights) -> pd.DataFrame:
    """Loss and names by value of ``surest``, teaching engines and the one that never teaches apart."""
    rows = []
    for value in SUREST:
        row: dict[str, object] = {"surest": "no bound" if value == SUREST[0] else f"{value:g}"}
        for engines, own in _by_engines(every).items():
            found = [case.chances(replace(weights, surest=value)) for case in own]
            names = [named(p) for p in found]
            losses = [lapsed_loss(p[case.cause]) for case, p in zip(own, found, strict=True)]
            row |= {
                f"loss, {engines}": sum(losses),
                f"named, {engines}": sum(n == case.cause for n, case in zip(names, own, strict=True)),
                f"wrongly, {engines}": sum(
                    n not in ("", case.cause) for n, case in zip(names, own, strict=True)
                ),
            }
        rows.append(row)
    return pd.DataFrame(rows)


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
            "most. Loss: sum of negative log probabilities of the causes; named: with 0.9 and more.",
            "",
            table.to_markdown(index=False, floatfmt=".2f"),
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


def _by_engines(every: Sequence[SessionCase]) -> dict[str, list[SessionCase]]:
    found: dict[str, list[SessionCase]] = {"own and Blender": [], "MuJoCo": []}
    for case in every:
        never = case.session.startswith(NEVER_LEARNT_FROM)
        found["MuJoCo" if never else "own and Blender"].append(case)
    return found


def main() -> None:
    """Write the page."""
    weights = SessionWeights.load()
    every = cases()
    n = {name: len(own) for name, own in _by_engines(every).items()}
    text = page(compared(every, weights), of_nulls(every, weights), n, weights)
    write_text(PAGE, text)
    print(text)


if __name__ == "__main__":
    main()
