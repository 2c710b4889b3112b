"""What it is worth that an obstacle's push has a history beside free forces: docs/results/contact_push.md.

    python benchmarks/contact_push.py  # the page from contact_push.csv
    python benchmarks/contact_push.py --sessions blender-contact:3:901 contact:3:51 ...
        # makes and tracks first clips of sessions that session_ladder names, and adds them first; ten minutes
        # of one core each

Every clip is diagnosed once, on refined motion. Beside free forces contact is judged twice: by a push as
hard as it is deep, and by one with a history in time (effects/contact.py, ContactPush), which a session has.
What is found is kept in outputs/contact_push, so that it goes on where it was. Answers are by the package's
weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd
from kept_table import asked_for, in_markdown, of_first_clips, revisions, update
from opened_session import OpenedSession, opened
from session_hypotheses import Hypotheses, hypotheses
from session_ladder import answer_columns, cause_of, off_by

from toile.denormals import denormals_flushed
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.held_motion import HeldMotion
from toile.diagnosis.outside_causes import OutsideCause, freed_fit, judged
from toile.diagnosis.session_weights import SessionWeights, chances
from toile.effects.base import Effect, VertexEffect
from toile.effects.catalogue import OUTSIDE, STAND_INS
from toile.effects.contact import Contact
from toile.effects.gusts import Gusts
from toile.effects.pressure import Pressure
from toile.reports.run_folder import current_git_revision

FOLDER = Path("outputs") / "contact_push"
TABLE = Path("docs") / "results" / "contact_push.csv"
FORMS = ("constant", "history")
_KEPT = ("session", "push")


class UnvaryingContact(Contact):
    """As hard as it is deep, all the time."""

    def pushing(self, duration: float) -> VertexEffect:
        """See Contact."""
        return self


def unvarying(effect: Effect) -> Effect:
    """The effect; of contact the one whose push has no history."""
    return UnvaryingContact().placed(effect.place()) if isinstance(effect, Contact) else effect


def constant(session: OpenedSession, held: HeldMotion, found: Hypotheses) -> Mapping[str, OutsideCause]:
    """Causes from outside beside free forces, with contact as hard as it is deep."""
    freed = freed_fit(held.clips, held.motion, session.together, session.stiffness, own=found.model.own)
    if freed is None:
        return {}
    fitting, base, width = freed
    own = [{name: unvarying(effect) for name, effect in clip.own.items()} for clip in fitting.clips]
    outside = [unvarying(effect) for effect in found.moving if effect.NAME in (*OUTSIDE, *STAND_INS)]
    return judged(fitting.with_own(own), base, width, outside).causes


@denormals_flushed()
def lines(folder: Path) -> list[dict[str, object]]:
    """What is said of a first clip with either push."""
    session = opened(folder, FOLDER / f"{folder.name}_run", first=True)
    held = session.held()
    away = off_by(folder, held.clips, held.motion)[0].mean()
    cause = cause_of(folder.name)
    every = hypotheses(session, held.motion, session.together, seen=held.clips)
    law, weights = every.evidence.effects, SessionWeights.load().of_clips(1)
    rows: list[dict[str, object]] = []
    for form, causes in zip(FORMS, (constant(session, held, every), every.outside.causes), strict=True):
        freed = {name: cause.evidence for name, cause in causes.items()}
        said = chances(replace(every.evidence, outside=freed), weights)
        rows.append(
            {
                "session": folder.name,
                "push": form,
                "revision": current_git_revision(),
                "motion off by [%]": 100 * away,
                "contact [nats]": nats(law, Contact.NAME),
                "gusts": nats(law, Gusts.NAME),
                "contact beside free forces": nats(freed, Contact.NAME),
                "gusts there": nats(freed, Gusts.NAME),
                "a pressure there": nats(freed, Pressure.NAME),
                **answer_columns(said, cause),
            }
        )
    return rows


def nats(evidence: Mapping[str, EffectEvidence], name: str) -> float:
    """Of an effect; not a number where it was not asked about."""
    return evidence[name].nats() if name in evidence else float("nan")


def page(table: pd.DataFrame) -> str:
    """The table in words."""
    digits = {
        "motion off by [%]": 2,
        "its probability": 2,
        "right answer": 2,
        "contact [nats]": 1,
        "gusts": 1,
    }
    digits |= {"contact beside free forces": 1, "gusts there": 1, "a pressure there": 1}
    return "\n".join(
        [
            "# A push with a history",
            "",
            "Made by `python benchmarks/contact_push.py` from `contact_push.csv`: first clips of sessions "
            "with open labels on refined motion. Beside free forces contact is a push as hard as it is deep "
            f"(constant), or one with a history in time, at {revisions(table)}. Evidence under the law, "
            "where contact is the same on both lines, and beside free forces; first: the most probable "
            "answer by the package's weights; right answer: probability of the cause, of `none` where "
            "nothing acts. A dash: nothing that might be touched was found.",
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
