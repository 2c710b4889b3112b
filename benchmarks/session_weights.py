"""Learn what evidence of a session is worth: docs/results/session_weights.md, and the package's weights.

    python benchmarks/session_weights.py  # from docs/results/session_evidence*.csv, see make session-ladder
    python benchmarks/session_weights.py --graded outputs/blind_predictions/NAME=MARKS.csv
        # adds a graded set first, or FOLDER alone: diagnoses of sessions of the ladder, by name
    python benchmarks/session_weights.py --into TABLE.csv --graded ...  # keeps them, nothing is learnt

Reported probabilities are those of weights that the session had no part in. Sessions of the engine that is
for sealed sets alone never teach: they say what weights learnt on other engines are worth.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
from session_ladder import BLENDER, cause_of

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_weights import (
    EVIDENCE_FILE,
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


GRADED = RESULTS / "session_evidence_graded.csv"
"""Evidence of sealed sessions, made once their labels are open."""
NEVER_LEARNT_FROM = "mujoco"
"""An engine for sealed sets alone."""


def cases_of(table: pd.DataFrame) -> tuple[list[SessionCase], list[str]]:
    """Evidence of every session on the rungs that a diagnosis has, and how many clips it is from."""
    found, clips = [], []
    for (rung, session), own in table[table["rung"].isin(RUNGS)].groupby(["rung", "session"], sort=False):
        cause = str(own["cause"].iloc[0]) if "cause" in own else cause_of(str(session))
        if cause in LEFT_OUT or (cause not in (NONE, *AS_NONE) and cause not in set(own["effect"])):
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
            {
                str(name): row["moves the cloth by [% of the width]"] / 100
                for name, row in by_name.iterrows()
                if name not in str(own["usual"].iloc[0]).split()
                and np.isfinite(row["moves the cloth by [% of the width]"])
            },
        )
        if "outside drop" in own:
            freed = by_name[by_name["outside drop"].notna()]
            outside = {str(name): _effect(row, "outside ") for name, row in freed.iterrows()}
            evidence = replace(evidence, outside=outside)
        found.append(SessionCase(str(session), NONE if cause in AS_NONE else cause, evidence))
        clips.append("one" if "one clip" in str(rung) else "three")
    return found, clips


def graded_evidence(folder: Path, marks: pd.DataFrame) -> pd.DataFrame:
    """Evidence of a graded set in the form of session_evidence.csv.

    Args:
        folder: of the predictions from first clips, every session in a folder of its own.
        marks: of all sessions, see docs/results/blind_sessions_marks.csv.
    """
    rows: list[dict[str, object]] = []
    of_motion = marks[(marks["clips"].astype(str) == "1") & ~marks["of_the_image"]]
    for mark in of_motion.itertuples():
        rows += _rows(folder / str(mark.scene), str(mark.scene), str(mark.generator), str(mark.truth))
    return pd.DataFrame(rows)


def developed_evidence(folder: Path) -> pd.DataFrame:
    """The same of diagnoses from first clips of sessions that session_ladder names."""
    rows: list[dict[str, object]] = []
    for run in sorted(path.parent for path in folder.glob(f"*/{EVIDENCE_FILE}")):
        engine = "blender" if run.name.startswith(BLENDER) else "toile"
        rows += _rows(run, run.name, engine, cause_of(run.name))
    return pd.DataFrame(rows)


def _rows(run: Path, session: str, engine: str, cause: str) -> list[dict[str, object]]:
    evidence = MotionEvidence.load(run / EVIDENCE_FILE)
    sizes = {**evidence.sizes, **evidence.usual}
    return [
        {
            "session": session,
            "engine": engine,
            "cause": cause,
            "rung": RUNGS[0],
            "usual": " ".join(evidence.usual),
            "cost of errors": evidence.base.cost,
            "expected cost": evidence.base.expected,
            "share": evidence.base.share,
            "effect": name,
            **_columns(one, ""),
            "moves the cloth by [% of the width]": 100 * sizes.get(name, float("nan")),
            "learned": (evidence.learned or {}).get(name, float("nan")),
            **(_columns(evidence.outside[name], "outside ") if name in evidence.outside else {}),
        }
        for name, one in evidence.effects.items()
    ]


def _columns(one: EffectEvidence, which: str) -> dict[str, object]:
    return {
        f"{which}drop": one.drop,
        f"{which}information": " ".join(f"{value:.5g}" for value in one.information),
        f"{which}slopes": " ".join(f"{value:.5g}" for value in one.slopes),
        f"{which}fitted size": one.fitted_size,
    }


def _effect(row: pd.Series, which: str = "") -> EffectEvidence:
    information, slopes = (
        tuple(map(float, str(row[f"{which}{key}"]).split())) for key in ("information", "slopes")
    )
    return EffectEvidence(float(row[f"{which}drop"]), information, slopes, float(row[f"{which}fitted size"]))


def main() -> None:
    """Write the page and the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    help_ = "FOLDER=MARKS.csv of graded sets, FOLDER of others"
    parser.add_argument("--graded", nargs="+", default=[], help=help_)
    parser.add_argument("--into", type=Path, default=GRADED, help="another table than that which teaches")
    given = parser.parse_args()
    if given.into != GRADED and not given.graded:
        parser.error("--into: expected --graded beside it, got nothing to keep")
    for one in given.graded:
        folder, _, marks = str(one).partition("=")
        new = graded_evidence(Path(folder), pd.read_csv(marks)) if marks else developed_evidence(Path(folder))
        if given.into.is_file():
            there = pd.read_csv(given.into)
            new = pd.concat([there[~there["session"].isin(new["session"])], new])
        write_text(given.into, new.to_csv(index=False, float_format="%.5g"))
    if given.into != GRADED:
        return
    ladder = cases_of(pd.read_csv(RESULTS / "session_evidence.csv"))
    graded = pd.read_csv(GRADED)
    never = graded["engine"] == NEVER_LEARNT_FROM
    more, other = cases_of(graded[~never]), cases_of(graded[never])
    cases, clips_of = ladder[0] + more[0], ladder[1] + more[1]
    weights, shipped = learnt_weights(cases), SessionWeights()
    unseen = [chances(case.evidence, weights) for case in other[0]]
    answers = _answers(cases, clips_of, left_out_chances(cases), weights)
    of_other = _answers(other[0], other[1], unseen, weights)
    lines = [
        "# Weights of a session's evidence",
        "",
        "Made by `python benchmarks/session_weights.py` from `session_evidence.csv` (`make session-ladder`) "
        f"and `session_evidence_graded.csv` (sealed sets after grading, sessions of "
        f"development): {len(cases)} cases of "
        f"{answers['session'].nunique()} generated sessions of two engines, open labels. Probabilities are "
        "those of weights that the session had no part in. Development data, no blind check; `strange` and "
        "`strangeness` are set by hand.",
        "",
        "| weight | learnt | before |",
        "|---|---|---|",
        *(
            f"| {name} | {getattr(weights, name):.3g} | {getattr(shipped, name):.3g} |"
            for name in (field.name for field in fields(SessionWeights))
            # Those of causes from outside are learnt elsewhere, see outside_causes.md.
            if not name.startswith("outside_")
        ),
        "",
    ]
    for clips, own in answers.groupby("clips", sort=False):
        lines += [f"{clips} clip{'s' if clips != 'one' else ''}: {_summary(own)}", ""]
    table = {"index": False, "floatfmt": ".2f"}
    lines += [answers.to_markdown(**table), "", "## An engine that taught nothing", ""]
    lines += [_summary(of_other), "", of_other.to_markdown(**table), ""]
    learnt, hand = (-np.log(answers[of]).mean() for of in ("of the cause", "of the cause, before"))
    # Few cases may teach less than they cost.
    better = learnt < hand
    lines += [f"Shipped: the weights {'learnt' if better else 'before, which say more'}.", ""]
    write_text(RESULTS / "session_weights.md", "\n".join(lines))
    if better:
        # What causes from outside are worth is learnt elsewhere: benchmarks/outside_causes.py.
        known = SessionWeights.load()
        weights = replace(
            weights,
            outside_threshold=known.outside_threshold,
            outside_temperature=known.outside_temperature,
        )
        weights.write(SHIPPED, f"{len(cases)} cases of docs/results/session_evidence*.csv")
    print("\n".join(lines))


def _answers(
    cases: list[SessionCase], clips_of: list[str], found: list[dict[str, float]], weights: SessionWeights
) -> pd.DataFrame:
    rows = []
    for case, clips, p in zip(cases, clips_of, found, strict=True):
        first = max(p, key=lambda name: p[name])
        rows.append(
            {
                "session": case.session,
                "clips": clips,
                "cause": case.cause,
                "answer": first,
                "its probability": p[first],
                "of the cause": p[case.cause],
                "of the cause, before": chances(case.evidence, SessionWeights())[case.cause],
                "misfit over usual": case.evidence.left,
            }
        )
    return pd.DataFrame(rows)


def _summary(answers: pd.DataFrame) -> str:
    named = answers["its probability"] >= SessionSettings().named
    right = answers["answer"] == answers["cause"]
    nulls = answers["cause"] == NONE
    false = int((nulls & named & ~right).sum())
    losses = [-np.log(answers[c]).mean() for c in ("of the cause", "of the cause, before")]
    return (
        f"{int((~nulls & right).sum())} of {int((~nulls).sum())} causes lead, "
        f"{int((~nulls & right & named).sum())} surely enough to be named; wrong names: {false} on "
        f"{int(nulls.sum())} without a cause, {int((~nulls & named & ~right).sum())} on the others; mean "
        f"negative log probability of the cause {losses[0]:.2f}, with the weights before {losses[1]:.2f}."
    )


if __name__ == "__main__":
    main()
