"""How far corners that nobody moved may wander: docs/results/held_corners.md.

    python benchmarks/held_corners.py  # the page from held_corners.csv
    python benchmarks/held_corners.py --sessions none:0:21 blender-gusts:3:602 ...
        # makes, tracks and refines first clips of sessions that session_ladder names, and adds them first;
        # a quarter of an hour of one core each
    python benchmarks/held_corners.py --widths "2 mm" --sessions blender-none:0:702 ...
        # with one width alone, to learn weights from (session_weights.py)

With every width a motion is refined, and all hypotheses are fitted around it with that width as well. What
is found is kept in outputs/held_corners, so that it goes on where it was. Answers are by the package's
weights.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from holders import chance_of_slip, seen_in
from kept_table import asked_for, in_markdown, revisions, update
from opened_session import OpenedSession, opened
from session_hypotheses import hypotheses
from session_ladder import BLENDER, REFINED, cause_of, evidence_columns, made, off_by

from toile.atomic_file import write_text
from toile.denormals import denormals_flushed
from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.session_weights import SessionWeights, chances
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.catalogue import CATALOGUE, STAND_INS
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.reports.run_folder import current_git_revision

FOLDER = Path("outputs") / "held_corners"
TABLE = Path("docs") / "results" / "held_corners.csv"
WIDTHS = {"10 mm": 0.01, "2 mm": 0.002}
"""Values of ``session_model.held`` [m]."""
_KEPT = ("session", "width")


@denormals_flushed()
def found(session: OpenedSession, folder: Path, width: str) -> list[dict[str, object]]:
    """Every hypothesis of a first clip, refined and compared with one width."""
    settings = replace(session.together, held=WIDTHS[width])
    held = session.held(settings, f"_{width.replace(' ', '_')}")
    motion, (clip,) = held.motion, held.clips
    scene = clip.problem.scene
    away = off_by(folder, held.clips, motion)[0]
    seen = seen_in(scene, held.holders.positions[0])
    every = hypotheses(session, motion, settings, seen=held.clips)
    said = chances(replace(every.evidence, resized=seen.change), SessionWeights.load().of_clips(1))
    errors = every.evidence.base
    common: dict[str, object] = {
        "session": folder.name,
        "engine": "blender" if folder.name.startswith(BLENDER) else "toile",
        "cause": cause_of(folder.name),
        "width": width,
        "rung": REFINED,
        "revision": current_git_revision(),
        "usual": " ".join(every.base.names),
        "cost of errors": errors.cost,
        "expected cost": errors.expected,
        "share": errors.share,
        "motion off by [% of the width]": 100 * away.mean(),
        "corners off by [% of the width]": 100 * away[:, list(scene.pinned_vertices)].mean(),
        "change of size [%]": 100 * seen.change,
        "slip [nats]": seen.slip,
        "let go": clip.let_go,
        "base misfit": every.base.misfit,
        "probability of none": said[NONE],
        "probability of unknown": said.get(UNKNOWN, 0.0),
    }
    rows = []
    for name, one in every.evidence.effects.items():
        freed = every.outside.causes.get(name)
        of_outside = {} if freed is None else evidence_columns(freed.evidence, "outside ")
        rows.append(
            {
                **common,
                "effect": name,
                "nats": one.nats(),
                "probability": said.get(name, np.nan),
                "moves the cloth by [% of the width]": 100 * every.sizes[name],
                "moves the cloth from outside by [% of the width]": np.nan
                if freed is None
                else 100 * freed.displacement.last,
                "learned": (every.evidence.learned or {}).get(name, np.nan),
                **evidence_columns(one),
                **of_outside,
            }
        )
    return rows


def answers(table: pd.DataFrame) -> pd.DataFrame:
    """One line for every session and width: the motion, and what speaks for what."""
    weights = SessionWeights.load()
    lines = []
    for (session, width), own in table.groupby(list(_KEPT), sort=False):
        first = own.iloc[0]
        cause = str(first["cause"])
        rivals = own[~own["effect"].isin((cause, *STAND_INS)) & (own["effect"] != first["usual"])]
        rival = rivals.sort_values("nats").iloc[-1]
        of_cause = own.loc[own["effect"] == cause, ["nats", "probability"]]
        if cause == AnchorSlip.NAME:
            right = chance_of_slip(float(first["slip [nats]"]), weights)
        elif len(of_cause):
            right = float(of_cause["probability"].iloc[0])
        else:
            right = float(first[f"probability of {NONE if cause == NONE else UNKNOWN}"])
        nats = float(of_cause["nats"].iloc[0]) if len(of_cause) else float("nan")
        if cause not in CATALOGUE and cause != NONE:
            nats = float(own.loc[own["effect"].isin(STAND_INS), "nats"].max())
        lines.append(
            {
                "session": session,
                "corners may wander by": width,
                "motion off by [%]": first["motion off by [% of the width]"],
                "corners off by [%]": first["corners off by [% of the width]"],
                "the model's errors [%]": 100 * float(first["share"]),
                "change of size [%]": first["change of size [%]"],
                "slip [nats]": first["slip [nats]"],
                "cause [nats]": nats,
                "best rival": rival["effect"],
                "its nats": rival["nats"],
                "right answer": right,
            }
        )
    return pd.DataFrame(lines)


def page(table: pd.DataFrame) -> str:
    """The lines in words."""
    lines = answers(table)
    digits = {"motion off by [%]": 2, "corners off by [%]": 2, "the model's errors [%]": 3}
    digits |= {"change of size [%]": 2, "slip [nats]": 1, "cause [nats]": 1, "its nats": 1, "right answer": 2}
    of_both = lines.groupby("session")["session"].transform("size") == len(WIDTHS)
    means = lines[of_both].groupby("corners may wander by", sort=False)[
        ["motion off by [%]", "corners off by [%]", "the model's errors [%]", "right answer"]
    ]
    return "\n".join(
        [
            "# Corners that nobody moved",
            "",
            "Made by `python benchmarks/held_corners.py` from `held_corners.csv`: first clips of sessions "
            "with open labels, in which nobody moved what holds the cloth, refined and compared with corners "
            "that may wander by so much from knot to knot (`session_model.held`). Those of a clip in which "
            "one slips are let go. Lengths in % of the cloth's width. Right answer: probability of the cause "
            "by the package's weights; of `none` where nothing acts, of `unknown` where the cause is none of "
            "the catalogue, whose nats are those of the best stand-in; of a slip where nothing else acts. "
            f"Best rival: of the catalogue. Found at {revisions(table)}; until af20231 wind was open in all "
            "clips.",
            "",
            in_markdown(lines.round(digits)),
            "",
            "Means over the clips with both:",
            "",
            means.mean().round(3).assign(clips=means.size()).reset_index().to_markdown(index=False),
            "",
        ]
    )


def measured(names: Sequence[str], widths: Sequence[str]) -> pd.DataFrame:
    """All rows of these sessions with these widths; what is kept is not found anew."""
    rows: list[dict[str, object]] = []
    for name in names:
        folder = made(name, FOLDER, DEFAULT_CLIPS[:1])
        session = opened(folder, folder.with_name(f"{folder.name}_run"), first=True)
        for width in widths:
            kept = FOLDER / f"{folder.name}, {width}.json"
            if not kept.is_file():
                write_text(kept, json.dumps(found(session, folder, width)))
            own = json.loads(kept.read_text())
            print(answers(pd.DataFrame(own)).to_string(index=False), flush=True)
            rows += own
    return pd.DataFrame(rows)


def main() -> None:
    """Add sessions to the table, and write the page."""
    parser = asked_for(__doc__)
    parser.add_argument("--widths", nargs="+", choices=WIDTHS, default=tuple(WIDTHS))
    given = parser.parse_args()
    update(TABLE, measured(given.sessions, given.widths), _KEPT, page)


if __name__ == "__main__":
    main()
