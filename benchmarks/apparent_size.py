"""When a cloth that seems to become smaller does: docs/results/apparent_size.md, and two weights of sessions.

    python benchmarks/apparent_size.py  # from docs/results/apparent_size.csv; learns
    python benchmarks/apparent_size.py --sessions shrinking:3:71 ...
        # makes and tracks first clips of sessions that session_ladder names, and adds them first
    python benchmarks/apparent_size.py --graded outputs/blind_predictions/NAME=MARKS.csv
        # adds first clips of a graded set, scenes in outputs/blind/NAME
    python benchmarks/apparent_size.py --kept --sessions ... --graded ...
        # the same from tracked motions that are there, whichever version has tracked them

Sessions of the engine that is for sealed sets alone never teach.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from hydra import compose, initialize_config_dir
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from session_ladder import BLENDER, cause_of, made
from session_weights import NEVER_LEARNT_FROM

from toile.atomic_file import write_text
from toile.cli.configuration import CONF, register_resolvers
from toile.cli.diagnose import session_problem
from toile.denormals import denormals_flushed
from toile.diagnosis.apparent_size import change_in, change_of_size
from toile.diagnosis.pipeline import Pipeline
from toile.diagnosis.planned_clip import HELD_STILL
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.results import KINDS
from toile.diagnosis.session_stages import seen_clips
from toile.diagnosis.session_weights import SHIPPED, SessionWeights, lapsed_loss
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import StageTimes
from toile.diagnosis.stored_values import ValueStore
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.scenes.native import load_native
from toile.scenes.session import load_session

Array = NDArray[np.float64]
Measure = Callable[[Path, Path], float | None]
"""Change of the apparent size, from the folder of a session and that of its diagnosis."""

RESULTS = Path("docs") / "results"
TABLE = RESULTS / "apparent_size.csv"
RESIZED = "shrinking"
"""The effect that changes lengths while it is filmed."""
SHARE = 0.05
"""Sessions of a cloth that shrinks among all: as many as of any of ten causes, and none as many as all."""
PRIOR = SessionWeights()
"""What few sessions leave as it is; logarithms have a deviation of 1."""


@denormals_flushed()
def measured(folder: Path, out: Path) -> float | None:
    """Change of the apparent size in the first clip of a session, tracked if it is not."""
    with initialize_config_dir(str(CONF), version_base=None):
        cfg = compose("diagnose", [f"session='{folder.resolve()}'", "diagnosis=quick"])
    asked = session_problem(cfg)
    first = asked.clips[0]
    problem = DiagnosisProblem(first.reconstruction, first.recipe, first.effects, first.settings)
    store = StageStore(out, ValueStore(KINDS, first.effects), StageTimes.going_on(out / "times.json"))
    nothing = lambda what, share: None  # noqa: E731
    motions = [asked.session.clips[0].motion]
    (clip,) = seen_clips([problem], [0], Pipeline(store, nothing), nothing, motions)
    return change_of_size(clip)


def kept(folder: Path, out: Path) -> float | None:
    """The same from the motion that has been tracked before."""
    first = load_session(folder).clips[0]
    if first.motion not in HELD_STILL:
        return None
    (file,) = (out / "clip_0").rglob("tracked.npz")
    with np.load(file) as arrays:
        positions = np.asarray(arrays["positions"], np.float64)
    return change_in(load_native(first.folder), positions)


def of_ladder(sessions: Sequence[str], measure: Measure = measured) -> list[dict[str, object]]:
    """One row for each of these sessions."""
    rows: list[dict[str, object]] = []
    for session in sessions:
        folder = made(session, plans=DEFAULT_CLIPS[:1])
        engine = "blender" if session.startswith(BLENDER) else "toile"
        size = float(session.split(":")[1])
        change = measure(folder, folder.with_name(f"{folder.name}_run"))
        rows.append(_row(folder.name, engine, cause_of(folder.name), size, change))
        print(rows[-1], flush=True)
    return rows


def of_graded(predictions: Path, marks: pd.DataFrame, measure: Measure = measured) -> list[dict[str, object]]:
    """One row for every session of a graded set."""
    rows: list[dict[str, object]] = []
    scenes = Path("outputs") / "blind" / predictions.name / "scenes"
    for mark in marks.drop_duplicates("scene").itertuples():
        change = measure(scenes / str(mark.scene), predictions / str(mark.scene))
        rows.append(
            _row(str(mark.scene), str(mark.generator), str(mark.truth), float(mark.gap_percent), change)
        )
        print(rows[-1], flush=True)
    return rows


def _row(session: str, engine: str, cause: str, size: float, change: float | None) -> dict[str, object]:
    if change is None:
        raise ValueError(f"{session}: expected a first clip in which nobody moved the holders")
    return {
        "session": session,
        "engine": engine,
        "cause": cause,
        "size [% of the width]": size,
        "change of size [%]": 100 * change,
    }


def added(table: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
    """The table with new rows; sessions that are in both have the new one."""
    before = table[~table["session"].isin(new["session"])] if len(table) else table
    return pd.concat([before, new], ignore_index=True)


def learnt(table: pd.DataFrame) -> SessionWeights:
    """The two weights under which what shrinks and what does not is most probable.

    There are more of those that shrink than there will be, so the odds are corrected for their share (King
    and Zeng 2001, Logistic regression in rare events data, the prior correction). Cases may lapse: a cloth
    that shrinks and has been tracked where it is says nothing of how large a change must be.
    """
    sizes = np.log(np.maximum(np.abs(table["change of size [%]"].to_numpy()) / 100, 1e-4))
    signs = np.where(table["cause"] == RESIZED, 1.0, -1.0)
    start = np.log([PRIOR.resized, PRIOR.resizing])

    def cost(logs: Array) -> float:
        right = expit(signs * np.exp(logs[1]) * (sizes - logs[0]))
        return float(sum(map(lapsed_loss, right)) + 0.5 * ((logs - start) ** 2).sum())

    at, steep = np.exp(minimize(cost, start, method="Nelder-Mead").x)
    share = max(float((signs > 0).mean()), SHARE)
    more = np.log(share / (1 - share)) - np.log(SHARE / (1 - SHARE))
    return replace(PRIOR, resized=float(at * np.exp(more / steep)), resizing=float(steep))


def chance(change: float, weights: SessionWeights) -> float:
    """Probability that the cloth does become smaller or larger [change in %]."""
    share = max(abs(change) / 100, 1e-4)
    return float(expit(weights.resizing * np.log(share / weights.resized)))


def write(table: pd.DataFrame) -> None:
    """The page and the weights."""
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    weights = learnt(teaching)
    by_others = []
    for row in table.itertuples():
        others = teaching[teaching["session"] != row.session]
        by_others.append(chance(float(table.loc[row.Index, "change of size [%]"]), learnt(others)))
    shown = table.assign(probability=by_others).sort_values(
        "change of size [%]", key=lambda values: -values.abs(), kind="stable", ignore_index=True
    )
    shipped = replace(SessionWeights.load(), resized=weights.resized, resizing=weights.resizing)
    source = json.loads(SHIPPED.read_text())["source"]
    added = f"resized, resizing: {len(teaching)} sessions of docs/results/apparent_size.md"
    kept = "; ".join(part for part in source.split("; ") if not part.startswith("resized"))
    shipped.write(SHIPPED, f"{kept}; {added}")
    lines = [
        "# Change of the apparent size",
        "",
        "Made by `python benchmarks/apparent_size.py` from `apparent_size.csv`: first clips of "
        f"{len(table)} sessions with open labels, in which nobody moved what holds the cloth, and by how "
        "much its sides seem to have changed in the last third (diagnosis/apparent_size.py). Probability of "
        f"a change by weights that the session had no part in; {NEVER_LEARNT_FROM} never teaches. Size: of "
        "the effect, in % of the width, as asked for or, of sealed sessions, as made.",
        "",
        f"Shipped: `resized` {weights.resized:.4f}, `resizing` {weights.resizing:.2f}, from {len(teaching)} "
        f"sessions, {int((teaching['cause'] == RESIZED).sum())} of them of a cloth that shrinks, where "
        f"{100 * SHARE:g} % are expected to.",
        "",
        shown.to_markdown(index=False, floatfmt=("", "", "", ".1f", ".2f", ".3f")),
        "",
    ]
    write_text(RESULTS / "apparent_size.md", "\n".join(lines))
    print("\n".join(lines))


def main() -> None:
    """Add sessions to the table, or learn from it."""
    register_resolvers()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", nargs="+", default=[], help="sessions to add, see session_ladder")
    parser.add_argument("--graded", nargs="+", default=[], help="FOLDER=MARKS.csv of graded sets to add")
    parser.add_argument("--kept", action="store_true", help="track nothing: motions that are there")
    given = parser.parse_args()
    measure = kept if given.kept else measured
    rows = of_ladder(given.sessions, measure)
    for one in given.graded:
        folder, _, marks = str(one).partition("=")
        rows += of_graded(Path(folder), pd.read_csv(marks, keep_default_na=False, na_values=[""]), measure)
    table = pd.read_csv(TABLE) if TABLE.is_file() else pd.DataFrame()
    if rows:
        table = added(table, pd.DataFrame(rows))
        write_text(TABLE, table.to_csv(index=False, float_format="%.4g"))
    write(table)


if __name__ == "__main__":
    main()
