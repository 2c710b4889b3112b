"""Learn what evidence of a session is worth: docs/results/session_weights.md, and the package's weights.

    python benchmarks/session_weights.py  # from docs/results/session_evidence.csv, see make session-ladder

Reported probabilities are those of weights that the session had no part in.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pandas as pd
from session_ladder import cause_of

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_weights import (
    SHIPPED,
    MotionEvidence,
    SessionCase,
    SessionWeights,
    chances,
    learnt_weights,
    left_out_chances,
)

RESULTS = Path("docs") / "results"
RUNGS = ("refined, one clip", "refined")
AS_NONE = ("anchor_slip",)
"""Causes that images show; what they do beside is no effect on the motion."""
LEFT_OUT = ("gravity_tilt",)
"""Causes that are a wind to the base model: neither none nor to be found."""


def cases_of(table: pd.DataFrame) -> tuple[list[SessionCase], list[str]]:
    """Evidence of every session on the rungs that a diagnosis has, and how many clips it is from."""
    found, clips = [], []
    for (rung, session), own in table[table["rung"].isin(RUNGS)].groupby(["rung", "session"], sort=False):
        cause = cause_of(str(session))
        if cause in LEFT_OUT:
            continue
        by_name = own.set_index("effect")
        learned = by_name["learned"].dropna().to_dict() or None
        evidence = MotionEvidence(
            ModelErrors(*(float(own[key].iloc[0]) for key in ("cost of errors", "expected cost", "share"))),
            {str(name): _effect(row) for name, row in by_name.iterrows()},
            learned,
            {
                name: by_name.loc[name, "moves the cloth by [% of the width]"] / 100
                for name in str(own["usual"].iloc[0]).split()
            },
        )
        found.append(SessionCase(str(session), NONE if cause in AS_NONE else cause, evidence))
        clips.append("one" if "one clip" in str(rung) else "three")
    return found, clips


def _effect(row: pd.Series) -> EffectEvidence:
    information, slopes = (tuple(map(float, str(row[key]).split())) for key in ("information", "slopes"))
    return EffectEvidence(float(row["drop"]), information, slopes, float(row["fitted size"]))


def main() -> None:
    """Write the page and the weights."""
    table = pd.read_csv(RESULTS / "session_evidence.csv")
    cases, clips_of = cases_of(table)
    weights, by_hand = learnt_weights(cases), SessionWeights()
    rows = []
    for case, clips, p in zip(cases, clips_of, left_out_chances(cases), strict=True):
        first = max(p, key=lambda name: p[name])
        before = chances(case.evidence, by_hand)
        rows.append(
            {
                "session": case.session,
                "clips": clips,
                "cause": case.cause,
                "answer": first,
                "its probability": p[first],
                "of the cause": p[case.cause],
                "of the cause, weights by hand": before[case.cause],
                "misfit over usual": case.evidence.left(weights),
            }
        )
    answers = pd.DataFrame(rows)
    right = answers["answer"] == answers["cause"]
    lines = [
        "# Weights of a session's evidence",
        "",
        "Made by `python benchmarks/session_weights.py` from `session_evidence.csv` (`make session-ladder`)"
        f": {len(cases)} cases of {answers['session'].nunique()} generated sessions, open labels, 3 % of the "
        "width. Probabilities are those of weights that the session had no part in. Development data, no "
        "blind check; `strange` and `strangeness` are set by hand.",
        "",
        "| weight | learnt | by hand |",
        "|---|---|---|",
        *(
            f"| {name} | {getattr(weights, name):.3g} | {getattr(by_hand, name):.3g} |"
            for name in (field.name for field in fields(SessionWeights))
        ),
        "",
    ]
    for clips, own in answers.groupby("clips", sort=False):
        nulls = own["cause"] == NONE
        good = right[own.index]
        losses = [-np.log(own[c]).mean() for c in ("of the cause", "of the cause, weights by hand")]
        named, false = int(good[~nulls].sum()), int((~good[nulls]).sum())
        lines += [
            f"{clips} clip{'s' if clips != 'one' else ''}: {named} of {int((~nulls).sum())} causes named, "
            f"{false} of {int(nulls.sum())} without one named falsely; mean negative log probability of the "
            f"cause {losses[0]:.2f}, by hand {losses[1]:.2f}.",
            "",
        ]
    lines += [answers.to_markdown(index=False, floatfmt=".2f"), ""]
    learnt, hand = (-np.log(answers[of]).mean() for of in ("of the cause", "of the cause, weights by hand"))
    # Few cases may teach less than they cost.
    better = learnt < hand
    lines += [f"Shipped: the weights {'learnt' if better else 'by hand, which say more'}.", ""]
    write_text(RESULTS / "session_weights.md", "\n".join(lines))
    if better:
        weights.write(SHIPPED, f"{len(cases)} cases of docs/results/session_evidence.csv")
    else:
        by_hand.write(SHIPPED, "set by hand: those learnt from docs/results/session_evidence.csv say less")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
