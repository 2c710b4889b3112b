"""What it is worth to know where the base model is wrong: docs/results/uneven_errors.md.

    python benchmarks/uneven_errors.py  # the page from uneven_errors.csv
    python benchmarks/uneven_errors.py --sessions none:0:12 blender-anisotropic_stiffness:3:911 ...
        # makes and tracks first clips of sessions that session_ladder names, and adds them first; ten minutes
        # of one core each

Every clip is diagnosed twice on the same refined motion: with errors of the base model that are thought alike
everywhere, as a session has them, and with those that are found place by place
(diagnosis/uneven_errors.py; session_model.uneven_rounds=4).
Causes from outside are judged once, beside free forces, where errors are alike. What is found is kept in
outputs/uneven_errors, so that it goes on where it was, the evidence of either kind in a folder of its own, as
benchmarks/session_weights.py --graded takes it. Answers are by the package's weights.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from kept_table import asked_for, in_markdown, of_first_clips, revisions, update
from opened_session import opened
from session_hypotheses import Hypotheses, hypotheses
from session_ladder import answer_columns, cause_of, off_by

from toile.denormals import denormals_flushed
from toile.diagnosis.decision import NONE
from toile.diagnosis.session_weights import EVIDENCE_FILE, SessionWeights, chances
from toile.effects.catalogue import STAND_INS
from toile.reports.run_folder import current_git_revision

FOLDER = Path("outputs") / "uneven_errors"
TABLE = Path("docs") / "results" / "uneven_errors.csv"
ERRORS = {"uneven": 4, "alike": 0}
"""Values of ``session_model.uneven_rounds``."""
_KEPT = ("session", "errors")


@denormals_flushed()
def lines(folder: Path) -> list[dict[str, object]]:
    """What is said of a first clip with errors of either kind."""
    session = opened(folder, FOLDER / f"{folder.name}_run", first=True)
    held = session.held()
    away = off_by(folder, held.clips, held.motion)[0].mean()
    cause = cause_of(folder.name)
    together = {errors: replace(session.together, uneven_rounds=n) for errors, n in ERRORS.items()}
    both = {
        "uneven": hypotheses(session, held.motion, together["uneven"], (cause,), seen=held.clips),
        "alike": hypotheses(session, held.motion, together["alike"], (cause,), free=False, seen=held.clips),
    }
    outside = both["uneven"].evidence.outside
    rows: list[dict[str, object]] = []
    for errors, found in both.items():
        evidence = replace(found.evidence, outside=outside)
        kept = FOLDER / errors / folder.name
        kept.mkdir(parents=True, exist_ok=True)
        evidence.write(kept / EVIDENCE_FILE)
        said = chances(evidence, SessionWeights.load().of_clips(1))
        rows.append(
            {
                "session": folder.name,
                "errors": errors,
                "revision": current_git_revision(),
                "motion off by [%]": 100 * away,
                "the model's errors [%]": 100 * found.evidence.base.share,
                **_under_law(found, cause),
                **answer_columns(said, cause),
            }
        )
    return rows


def _under_law(found: Hypotheses, cause: str) -> dict[str, object]:
    """Evidence of the cause, of its best rival in the catalogue, and of the best stand-in."""
    nats = {name: one.nats() for name, one in found.evidence.effects.items()}
    rivals = {n: v for n, v in nats.items() if n not in (cause, *STAND_INS, *found.base.names)}
    rival = max(rivals, key=lambda name: rivals[name])
    return {
        "cause [nats]": nats.get(cause, np.nan),
        "best rival": rival,
        "its nats": rivals[rival],
        "best stand-in [nats]": max(v for n, v in nats.items() if n in STAND_INS),
    }


def over_rival(table: pd.DataFrame) -> pd.DataFrame:
    """By session: how far the cause is ahead of its best rival, of a null what its best effect has."""
    null = table["session"].str.contains(f"(?:^|-){NONE}_")
    ahead = (table["cause [nats]"] - table["its nats"]).where(~null, table["its nats"])
    wide = table.assign(ahead=ahead).pivot(index="session", columns="errors", values="ahead")
    return wide[list(ERRORS)].assign(null=null.groupby(table["session"]).first())


def page(table: pd.DataFrame) -> str:
    """The table in words."""
    digits = {"motion off by [%]": 2, "the model's errors [%]": 3, "cause [nats]": 1, "its nats": 1}
    digits |= {"best stand-in [nats]": 1, "its probability": 2, "right answer": 2}
    by = over_rival(table)
    causes, nulls = by[~by["null"]], by[by["null"]]
    right = table.groupby("errors")["right answer"].mean()
    gain = int((causes["uneven"] > causes["alike"]).sum())
    summary = [
        f"Of {len(causes)} causes the evidence is ahead of the best rival's by "
        f"{causes['alike'].median():.0f} nats in the median where errors are thought alike, by "
        f"{causes['uneven'].median():.0f} where they are uneven ({gain} gain)."
    ]
    if len(nulls):
        summary.append(
            f"Where nothing acts ({len(nulls)}) the best effect has {nulls['alike'].max():.0f} and "
            f"{nulls['uneven'].max():.0f} nats at most."
        )
    summary.append(
        f"The right answer has {right['alike']:.2f} and {right['uneven']:.2f} in the mean, by weights that "
        "were learnt where errors were thought alike."
    )
    return "\n".join(
        [
            "# Where the base model is wrong",
            "",
            "Made by `python benchmarks/uneven_errors.py` from `uneven_errors.csv`: first clips of sessions "
            "with open labels on refined motion, under the law, with errors of the base model found place by "
            f"place (uneven) or thought alike everywhere, at {revisions(table)}. Errors: root mean square "
            "over the cloth. First: the most probable answer by the package's weights; right answer: "
            "probability of the cause, of `none` where nothing acts. A dash: nothing acts.",
            "",
            " ".join(summary),
            "",
            in_markdown(table.round(digits)),
            "",
        ]
    )


def main() -> None:
    """Add sessions to the table, and write the page."""
    given = asked_for(__doc__).parse_args()
    update(TABLE, of_first_clips(given.sessions, FOLDER, {"": lines}), _KEPT, page)


if __name__ == "__main__":
    main()
