"""What it is worth to know that no wind blew in a clip: docs/results/still_air.md.

    python benchmarks/still_air.py  # the page from still_air.csv
    python benchmarks/still_air.py --sessions gravity_tilt:3:41 blender-none:0:303 ...
        # makes and tracks first clips of sessions that session_ladder names, and adds them first; a quarter
        # of an hour of one core each

Every clip is of a cloth that was let go in still air. It is diagnosed twice: as a ``release``, in which no
wind blows, and as a ``hang``, in which corners are as still and the wind is open. What is found is kept in
outputs/still_air, so that it goes on where it was. Answers are by the package's weights.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from holders import seen_in
from kept_table import asked_for, in_markdown, of_first_clips, revisions, update
from opened_session import opened
from session_hypotheses import hypotheses
from session_ladder import answer_columns, cause_of, off_by

from toile.atomic_file import write_text
from toile.denormals import denormals_flushed
from toile.diagnosis.base_fit import N_WIND
from toile.diagnosis.session_weights import SessionWeights, chances
from toile.effects.catalogue import STAND_INS
from toile.reports.run_folder import current_git_revision

FOLDER = Path("outputs") / "still_air"
TABLE = Path("docs") / "results" / "still_air.csv"
AIR = {"hang": "open", "release": "still"}
"""What is known of the wind, by the motion that the session says."""
_KEPT = ("session", "wind")


def said_to_be(folder: Path, motion: str) -> Path:
    """The folder of a session whose first clip is that of another one, with the motion that it is said to be.

    Args:
        folder: of the other one.
        motion: see generation.clip_plan.MOTIONS.
    """
    there = FOLDER / f"{folder.name}, {motion}"
    there.mkdir(parents=True, exist_ok=True)
    clips = [{"scene": str((folder / "clip_0").resolve()), "motion": motion}]
    write_text(there / "session.yaml", yaml.safe_dump({"clips": clips}))
    return there


@denormals_flushed()
def found(folder: Path, motion: str) -> dict[str, object]:
    """What is said of a first clip with that motion."""
    session = opened(said_to_be(folder, motion), FOLDER / f"{folder.name}_run", first=True)
    held = session.held(name=f"_{motion}")
    refined, (clip,) = held.motion, held.clips
    scene = clip.problem.scene
    every = hypotheses(session, refined, session.together, seen=held.clips)
    said = chances(every.evidence, SessionWeights.load().of_clips(1))
    cause = cause_of(folder.name)
    own = {name: one.nats() for name, one in every.evidence.effects.items() if name not in every.base.names}
    rivals = {name: nats for name, nats in own.items() if name not in (cause, *STAND_INS)}
    rival = max(rivals, key=lambda name: rivals[name])
    freed = every.outside.causes.get(cause)
    return {
        "session": folder.name,
        "wind": AIR[motion],
        "revision": current_git_revision(),
        "motion off by [%]": 100 * off_by(folder, held.clips, refined)[0].mean(),
        "the model's errors [%]": 100 * every.evidence.base.share,
        "wind of the base model [m/s²]": float(np.linalg.norm(every.base.values[-N_WIND:])),
        "change of size [%]": 100 * seen_in(scene, held.holders.positions[0]).change,
        "cause [nats]": own.get(cause, np.nan),
        "beside free forces": np.nan if freed is None else freed.evidence.nats(),
        "best rival": rival,
        "its nats": rivals[rival],
        "best stand-in [nats]": max(own[name] for name in own if name in STAND_INS),
        **answer_columns(said, cause),
    }


def page(table: pd.DataFrame) -> str:
    """The table in words."""
    digits = {"motion off by [%]": 2, "the model's errors [%]": 3, "wind of the base model [m/s²]": 2}
    digits |= {"change of size [%]": 2, "cause [nats]": 1, "beside free forces": 1, "its nats": 1}
    digits |= {"best stand-in [nats]": 1, "its probability": 2, "right answer": 2}
    return "\n".join(
        [
            "# Still air",
            "",
            "Made by `python benchmarks/still_air.py` from `still_air.csv`: first clips of sessions with "
            "open labels, of a cloth that is let go in still air, once with the wind left open "
            f"(`motion: hang`) and once as what they are (`motion: release`), at {revisions(table)}. "
            "Lengths in % of the cloth's width. Evidence under the law, and beside free forces where the "
            "cause is one from outside; best rival: of the catalogue; first: the most probable answer by "
            "the package's weights; right answer: probability of the cause, of `none` where nothing acts.",
            "",
            in_markdown(table.round(digits)),
            "",
        ]
    )


def _line(motion: str, folder: Path) -> list[dict[str, object]]:
    return [found(folder, motion)]


def main() -> None:
    """Add sessions to the table, and write the page."""
    given = asked_for(__doc__).parse_args()
    ways = {f", {motion}": partial(_line, motion) for motion in AIR}
    update(TABLE, of_first_clips(given.sessions, FOLDER, ways), _KEPT, page)


if __name__ == "__main__":
    main()
