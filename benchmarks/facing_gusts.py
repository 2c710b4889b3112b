"""What it is worth that gusts push harder what faces them: docs/results/facing_gusts.md.

    python benchmarks/facing_gusts.py  # the page from facing_gusts.csv
    python benchmarks/facing_gusts.py --sessions blender-gusts:3:302 gusts:3:31 ...
        # makes and tracks first clips of sessions that session_ladder names, and adds them first; ten minutes
        # of one core each

Every clip is diagnosed twice on the same refined motion: with gusts that push all of the cloth alike, and
with those that a session has, which push harder what faces them. What is found is kept in
outputs/facing_gusts, so that it goes on where it was. Answers are by the package's weights.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from kept_table import asked_for, in_markdown, of_first_clips, revisions, update
from opened_session import opened
from session_hypotheses import hypotheses
from session_ladder import answer_columns, cause_of, off_by

from toile.denormals import denormals_flushed
from toile.effects.gusts import FacingGusts, Gusts
from toile.effects.pressure import Pressure
from toile.reports.run_folder import current_git_revision

FOLDER = Path("outputs") / "facing_gusts"
TABLE = Path("docs") / "results" / "facing_gusts.csv"
FORMS = ("alike", "facing")
_KEPT = ("session", "gusts push")


@denormals_flushed()
def found(folder: Path) -> list[dict[str, object]]:
    """What is said of a first clip with gusts of either form."""
    session = opened(folder, FOLDER / f"{folder.name}_run", first=True)
    held = session.held()
    away = off_by(folder, held.clips, held.motion)[0].mean()
    cause = cause_of(folder.name)
    rows: list[dict[str, object]] = []
    alike = [effect.alike() if isinstance(effect, FacingGusts) else effect for effect in session.effects]
    for form, effects in zip(FORMS, (alike, session.effects), strict=True):
        asked = replace(session, effects=effects)
        every = hypotheses(asked, held.motion, session.together, seen=held.clips)
        said = every.chances()
        nats = {name: one.nats() for name, one in every.evidence.effects.items()}
        freed = {name: one.evidence.nats() for name, one in every.outside.causes.items()}
        acting = every.fits[Gusts.NAME].effects[0][-1]
        rows.append(
            {
                "session": folder.name,
                "gusts push": form,
                "revision": current_git_revision(),
                "motion off by [%]": 100 * away,
                "gusts [nats]": nats[Gusts.NAME],
                "a pressure": nats[Pressure.NAME],
                "gusts beside free forces": freed.get(Gusts.NAME, np.nan),
                "a pressure there": freed.get(Pressure.NAME, np.nan),
                "share found": 0.5 + float(acting.values[-1]) if form == "facing" else np.nan,
                **answer_columns(said, cause),
            }
        )
    return rows


def page(table: pd.DataFrame) -> str:
    """The table in words."""
    digits = {"motion off by [%]": 2, "gusts [nats]": 1, "a pressure": 1, "gusts beside free forces": 1}
    digits |= {"a pressure there": 1, "share found": 2, "its probability": 2, "right answer": 2}
    return "\n".join(
        [
            "# Gusts that push harder what faces them",
            "",
            "Made by `python benchmarks/facing_gusts.py` from `facing_gusts.csv`: first clips of sessions "
            "with open labels on refined motion, with gusts that push all of the cloth alike and with those "
            f"that push harder what faces them, at {revisions(table)}. Share found: that only pushes what "
            "faces it. Evidence under the law, and beside free forces; first: the most probable answer by "
            "the package's weights; right answer: probability of the cause, of `unknown` where the catalogue "
            "lacks it, of `none` where nothing acts.",
            "",
            in_markdown(table.round(digits)),
            "",
        ]
    )


def main() -> None:
    """Add sessions to the table, and write the page."""
    given = asked_for(__doc__).parse_args()
    update(TABLE, of_first_clips(given.sessions, FOLDER, {"": found}), _KEPT, page)


if __name__ == "__main__":
    main()
