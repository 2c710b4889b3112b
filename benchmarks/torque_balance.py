"""What the balance of torques knows of causes from outside: `make torque-balance`.

On the sessions of the ladder (session_ladder.py): with true positions in place of what images say, from one
clip and from three; with positions refined by the base model, corners free as a diagnosis has them; and the
same with corners that stay where the template has them. What is found is kept in outputs/session_ladder, so
that it goes on where it was.

    python benchmarks/torque_balance.py [--sessions air_drag:3:1 none:0:2 ...] [--rungs "true, one clip" ...]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import session_ladder as ladder
import torch
from opened_session import opened

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.diagnosis.mechanics import horizontal_axes
from toile.diagnosis.torque_balance import MovingCloth, torque_evidence
from toile.effects.base import Surroundings
from toile.effects.catalogue import OUTSIDE, PUSHING

RUNGS = ("true, one clip", "true", "refined, one clip", "refined, one clip, corners held")
HELD = 0.0003
"""Deviation of the corners [m] where they are held."""


def measured(folder: Path, rung: str, out: Path) -> dict[str, object]:
    """Evidence of every cause from outside [nats] of one session, on one rung."""
    session = opened(folder, out, first="one clip" in rung)
    problems, effects = session.problems, session.effects
    scenes = [problem.scene for problem in problems]
    truth = [
        np.load(folder / f"truth_{k}.npy").astype(np.float64).reshape(scene.n_frames, -1, 3)
        for k, scene in enumerate(scenes)
    ]
    motion = truth
    if rung.startswith("refined"):
        held = "held" in rung
        settings = replace(session.together, held=HELD) if held else session.together
        motion = session.refined(settings, "_held" if held else "").positions
    cloths = []
    for scene, problem, positions in zip(scenes, problems, motion, strict=True):
        gravity = torch.from_numpy(scene.gravity.numpy().astype(np.float64))
        cloth, size = problem.reconstruction.cloth, scene.cloth_size
        around = Surroundings(cloth, size, gravity, scene.fps, len(positions))
        cloths.append(MovingCloth(positions, around, horizontal_axes(gravity).numpy()))
    found = torque_evidence(cloths, effects)
    assert found is not None
    width = scenes[0].cloth_size[0]
    away = [np.linalg.norm(x - t, axis=-1).mean() for x, t in zip(motion, truth, strict=True)]
    return {"session": folder.name, "rung": rung, "position error [%]": 100 * np.mean(away) / width, **found}


def page(table: pd.DataFrame) -> str:
    """The tables in words."""
    table = table.assign(truth=[ladder.cause_of(name) for name in table["session"]])
    # A tilt of gravity is a wind here, which every clip has.
    names = [name for name in OUTSIDE if name not in (*ladder.WITHOUT_TRACE, *PUSHING)]
    table = table.assign(leads=table[names].idxmax(axis=1), nats=table[names].max(axis=1))
    rows = []
    for rung, own in table.groupby("rung", sort=False):
        outside = own[own["truth"].isin(names)]
        others = own[~own["truth"].isin(names)]
        blender = others["session"].str.startswith(ladder.BLENDER)
        rows.append(
            {
                "rung": rung,
                "causes from outside": len(outside),
                "the truth leads": int((outside["leads"] == outside["truth"]).sum()),
                "least of a truth [nats]": min(
                    (float(row[str(row["truth"])]) for _, row in outside.iterrows()), default=np.nan
                ),
                "others, own engine": int((~blender).sum()),
                "most of any [nats]": others.loc[~blender, "nats"].max(),
                "nulls of Blender": int(blender.sum()),
                "most of any of them [nats]": others.loc[blender, "nats"].max(),
            }
        )
    summary = pd.DataFrame(rows).astype(object)
    summary = summary.where(summary.notna(), "–")
    lines = [
        "# What the balance of torques knows",
        "",
        "Made by `make torque-balance` on the sessions of the [ladder](session_ladder.md); log evidence of "
        "every cause from outside against none [nats]. Others: nulls and causes within the cloth, for which "
        "every cause from outside is wrong.",
        "",
        summary.to_markdown(index=False, floatfmt=".1f"),
        "",
        table[["rung", "session", "position error [%]", *names, "leads"]].to_markdown(
            index=False, floatfmt=("", "", ".2f", *(".1f" for _ in names), "")
        ),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Write docs/results/torque_balance.md and .csv."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", nargs="+", default=ladder.SESSIONS)
    parser.add_argument("--rungs", nargs="+", default=RUNGS)
    parser.add_argument("--known", action="store_true", help="compute nothing: the tables of what is kept")
    parser.add_argument("--output", type=Path, default=Path("docs") / "results" / "torque_balance.md")
    given = parser.parse_args()
    torch.set_num_threads(1)
    register_resolvers()
    rows: list[dict[str, object]] = []
    for rung in given.rungs:
        for session in given.sessions:
            name = ladder.folder_of(session).name
            kept = ladder.FOLDER / f"balance of {name}, {rung}.json"
            if not kept.is_file():
                if given.known:
                    continue
                folder = ladder.made(session)
                write_text(kept, json.dumps(measured(folder, rung, ladder.FOLDER / f"{name}_run")))
            rows.append(json.loads(kept.read_text()))
            print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(given.output.with_suffix(".csv"), index=False, float_format="%.4g")
    write_text(given.output, page(table))


if __name__ == "__main__":
    main()
