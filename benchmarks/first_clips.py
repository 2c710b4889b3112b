"""What the first clips of sessions with open labels say, tracked, refined and judged from their images.

    python benchmarks/first_clips.py outputs/blind/NAME/scenes/SESSION outputs/session_ladder/SESSION ...
        # keeps the evidence of each in outputs/first_clips/SESSION, and leaves what is there
    python benchmarks/session_weights.py --graded outputs/first_clips outputs/first_clips=MARKS.csv
        # adds it to docs/results/session_evidence_held.csv
    python benchmarks/first_clips.py --all-clips outputs/session_ladder/SESSION ...
        # the same of all clips of each, in outputs/all_clips: session_weights.py --clips 3

As ``toile blind run`` (``one_clip=true``) judges them, without a prediction of what was held out and without
clips to be recorded next: half the time.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import torch
from opened_session import opened
from session_hypotheses import Hypotheses, hypotheses

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.denormals import denormals_flushed
from toile.diagnosis.session_weights import EVIDENCE_FILE
from toile.effects.contact import Contact
from toile.reports.run_folder import current_git_revision

KEPT = Path("outputs") / "first_clips"
KEPT_OF_ALL = Path("outputs") / "all_clips"
FINDINGS_FILE = "findings.json"
_SAID = 0.005
"""Probability below which nothing is said of a hypothesis."""


@denormals_flushed()
def judged(folder: Path, out: Path, *, first: bool = True) -> dict[str, Any]:
    """What the first clip of a session says, or all of them; their evidence is kept in ``out``."""
    began = time.process_time()
    session = opened(folder, out, first=first)
    held = session.held()
    found = hypotheses(session, held.motion, session.together, seen=held.clips)
    found.evidence.write(out / EVIDENCE_FILE)
    findings = {
        "revision": current_git_revision(),
        "CPU [s]": time.process_time() - began,
        "base misfit": found.base.misfit,
        "share": found.evidence.base.share,
        "probabilities": {name: p for name, p in found.chances().items() if p > _SAID},
        "effects": _of_effects(found),
        "obstacles": _obstacles(found),
    }
    write_text(out / FINDINGS_FILE, json.dumps(findings, indent=1) + "\n")
    return findings


def _of_effects(found: Hypotheses) -> dict[str, dict[str, float | None]]:
    """Evidence under the law and beside free forces [nats], and by how much an effect moves the cloth."""
    outside = found.evidence.outside
    return {
        name: {
            "nats": one.nats(),
            "nats before it is fitted": found.linear[name].nats(),
            "nats beside free forces": outside[name].nats() if name in outside else None,
            "moves the cloth by [% of the width]": 100 * found.sizes[name],
            "passes": len(found.fits[name].history) - len(found.base.history),
            "CPU [s]": found.seconds[name],
        }
        for name, one in found.evidence.effects.items()
    }


def _obstacles(found: Hypotheses) -> list[dict[str, list[float]] | None]:
    """What every clip's cloth may touch."""
    return [
        {k: v.tolist() for k, v in own[Contact.NAME].place().items()} if Contact.NAME in own else None
        for own in found.model.own
    ]


def main() -> None:
    register_resolvers()
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sessions", nargs="+", type=Path, help="folders with session.yaml")
    parser.add_argument("--all-clips", action="store_true", help="not the first of each alone")
    parser.add_argument("--out", type=Path, help=f"where evidence is kept ({KEPT}, {KEPT_OF_ALL})")
    given = parser.parse_args()
    kept_in = given.out or (KEPT_OF_ALL if given.all_clips else KEPT)
    for folder in given.sessions:
        if not (folder / "session.yaml").is_file():
            parser.error(f"expected folders with session.yaml, got {folder}")
    for folder in given.sessions:
        out = kept_in / folder.name
        kept = out / FINDINGS_FILE
        findings: dict[str, Any] = (
            json.loads(kept.read_text()) if kept.is_file() else judged(folder, out, first=not given.all_clips)
        )
        said = ", ".join(f"{name} {p:.3f}" for name, p in findings["probabilities"].items())
        took = f"{findings['CPU [s]']:.0f} s of the processor, {findings['revision'][:7]}"
        print(f"{folder.name}: {said} ({took})", flush=True)


if __name__ == "__main__":
    main()
