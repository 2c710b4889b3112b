"""Which grid the base model of a session needs: docs/results/model_grid.md, `make model-grid`.

Positions are the true ones, so what is left is the model's: its grid and its law. First clips of the sessions
of the ladder; what is found is kept in outputs/model_grid, so that it goes on where it was.

    python benchmarks/model_grid.py [--sessions blender-none:0:301 ...] [--grids 14:0 20:0.5 ...]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from opened_session import opened
from session_ladder import FOLDER, folder_of, made

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.denormals import denormals_flushed
from toile.diagnosis.effect_sensitivities import FORCES
from toile.diagnosis.session_stages import RefinedMotion, SessionModel, with_error_found
from toile.effects.catalogue import STAND_INS
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.reports.run_folder import current_git_revision

KEPT = Path("outputs") / "model_grid"
PAGE = Path("docs") / "results" / "model_grid.md"
SESSIONS = ("blender-none:0:301", "blender-none:0:303", "none:0:17", "rest_curvature:3:8")
GRIDS = ("14:0", "14:0.5", "20:0", "20:0.5")
"""Vertices along each side, and by how much lines come closer at the borders."""
DIGITS = {
    "crowding": "g",
    "between its vertices [% of the width]": ".3f",
    "the model leaves [% of the width]": ".3f",
    "misfit without damping": ".0f",
    "with": ".0f",
    "of [nats]": ".0f",
    "CPU [s]": ".0f",
}


@denormals_flushed()
def left(folder: Path, side: int, crowding: float) -> dict[str, object]:
    """What the base model leaves on true positions of the first clip, and what effects would take of it."""
    session = opened(folder, FOLDER / f"{folder.name}_run", first=True)
    clips, stiffness = session.clips, session.stiffness
    truth = np.load(folder / "truth_0.npy").astype(np.float64)
    positions = truth.reshape(len(truth), -1, 3)[: clips[0].n_frames]
    settings = replace(session.together, side=side, crowding=crowding)
    began = time.process_time()
    motion = with_error_found(clips, RefinedMotion([positions], None), settings, stiffness)
    model = SessionModel(clips, motion, settings, stiffness)
    fitting = model.fitting
    plain = fitting.fitted((), fitting.start_fit())
    base = fitting.fitted(fitting.usual, plain)
    seconds = time.process_time() - began
    effects = [e for e in session.effects if isinstance(e, FORCES)]
    effects += [STAND_INS[name]().for_clip(session.longest) for name in settings.stand_ins]
    systems = fitting.systems(effects, base)
    fits = fitting.linearised(effects, base, fitting.quadratic(effects, base, systems))
    nats = {name: fit.evidence(base).nats() for name, fit in fits.items() if name not in base.names}
    most = max(nats, key=lambda name: nats[name])
    grid = model.grids[0]
    on_grid = np.einsum("vn,nm,fmc->fvc", grid.prolong, grid.restrict, positions)
    width = grid.cloth_size[0]
    missed = float(np.sqrt(((on_grid - positions) ** 2).sum(-1).mean()))
    assert motion.error is not None
    return {
        "session": folder.name,
        "revision": current_git_revision()[:7],
        "vertices": f"{side} × {side}",
        "crowding": crowding,
        "between its vertices [% of the width]": 100 * missed / width,
        "the model leaves [% of the width]": 100 * motion.error,
        "misfit without damping": plain.misfit,
        "with": base.misfit,
        "most that another takes": most,
        "of [nats]": nats[most],
        "CPU [s]": seconds,
    }


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", nargs="+", default=SESSIONS)
    parser.add_argument("--grids", nargs="+", default=GRIDS, help="VERTICES:CROWDING")
    given = parser.parse_args()
    torch.set_num_threads(1)
    register_resolvers()
    rows = []
    for session in given.sessions:
        for grid in given.grids:
            side, crowding = grid.split(":")
            kept = KEPT / f"{folder_of(session).name}_{side}_{crowding}.json"
            if not kept.is_file():
                folder = made(session, plans=DEFAULT_CLIPS[:1])
                write_text(kept, json.dumps(left(folder, int(side), float(crowding))))
            rows.append(json.loads(kept.read_text()))
            print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    lines = [
        "# Which grid the base model of a session needs",
        "",
        "Made by `make model-grid`: first clips of generated sessions (80 frames, 50 a second), *true* "
        "positions, so that nothing is left but what the model's grid and law are wrong by. `crowding`: by "
        "how much lines come closer at the borders (`physics/grid_lines.py`). Between its vertices: root "
        "mean square distance of the true cloth to a spline through its places at the model's vertices; the "
        "model leaves: root mean square smooth error of the base model with usual damping (0.05 is the least "
        "that is thought possible). Misfits refer to that error, so they are of the same size; what damping "
        "takes of them on a null is what the grid is wrong by. The last columns: the effect or stand-in that "
        "would take most beside the base model, linearised; on a null that is a false alarm's evidence. "
        "Processor seconds of these fits, one thread.",
        "",
        table.to_markdown(index=False, floatfmt=tuple(DIGITS.get(name, "") for name in table.columns)),
        "",
    ]
    write_text(PAGE, "\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
