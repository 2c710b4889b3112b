"""What holds the cloth: when it slips, and when a cloth that seems to become smaller does.

    python benchmarks/holders.py  # from docs/results/holders.csv: holders.md, and four weights of sessions
    python benchmarks/holders.py --sessions shrinking:3:71 anchor_slip:3:75 ...
        # makes, tracks and refines first clips of sessions that session_ladder names, and adds them first
    python benchmarks/holders.py --graded outputs/blind_predictions/NAME=MARKS.csv
        # adds first clips of a graded set, scenes in outputs/blind/NAME
    python benchmarks/holders.py --kept --sessions ... --graded ...
        # the same from motions that are there, whichever version has refined them, of all clips together

Sessions of the engine that is for sealed sets alone never teach.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from opened_session import opened
from scipy.optimize import minimize
from scipy.special import expit
from session_ladder import BLENDER, NEVER_LEARNT_FROM, cause_of, made

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.denormals import denormals_flushed
from toile.diagnosis.apparent_size import change_in
from toile.diagnosis.holder_slips import slip_of
from toile.diagnosis.planned_clip import HELD_STILL
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_weights import SHIPPED, SessionWeights, lapsed_loss
from toile.effects.anchor_slip import AnchorSlip
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.scenes.native import load_native
from toile.scenes.scene import Scene
from toile.scenes.session import load_session

Array = NDArray[np.float64]

RESULTS = Path("docs") / "results"
TABLE = RESULTS / "holders.csv"
CHANGE, SLIP = "change of size [%]", "slip [nats]"
RESIZED = "shrinking"
"""The effect that changes lengths while it is filmed."""
SHARE = 0.05
"""Sessions of one cause among all: as many as of any of ten causes, and none as many as all."""


NAMES = ("resized", "resizing", "slip_threshold", "slip_temperature")
"""Of the weights."""


@dataclass(frozen=True)
class Seen:
    """What a clip in which nobody moved the holders shows of them.

    Attributes:
        change: of the apparent size, see apparent_size.
        slip: log evidence of a slip [nats], see holder_slips.
    """

    change: float
    slip: float


Measure = Callable[[Path, Path], Seen]
"""Of the first clip, from the folder of a session and that of its diagnosis."""


def seen_in(scene: Scene, positions: Array) -> Seen:
    """From the refined motion (F, N, 3) [m] of a clip, nothing held in it."""
    slip = slip_of(scene, positions, AnchorSlip(), SessionSettings().slip, held_still=True)
    return Seen(change_in(scene, positions), slip.log_evidence)


@denormals_flushed()
def measured(folder: Path, out: Path) -> Seen:
    """From the first clip of a session, tracked and refined if it is not."""
    _check(load_session(folder).clips[0].motion, folder)
    session = opened(folder, out, first=True)
    (clip,) = session.clips
    return seen_in(clip.problem.scene, session.held().holders.positions[0])


def kept(folder: Path, out: Path) -> Seen:
    """The same from the motion that has been refined before."""
    first = load_session(folder).clips[0]
    _check(first.motion, folder)
    names = ("loosened_1.npz", "loosened.npz", "refined_1.npz", "refined.npz")
    (file,) = [path for name in names if (path := out / name).is_file()][:1]
    with np.load(file, allow_pickle=False) as arrays:
        positions = np.asarray(arrays["positions.0"], np.float64)
    return seen_in(load_native(first.folder), positions)


def _check(motion: str, folder: Path) -> None:
    if motion not in HELD_STILL:
        raise ValueError(f"{folder}: expected a first clip in which nobody moved the holders, got '{motion}'")


def of_ladder(sessions: Sequence[str], measure: Measure = measured) -> list[dict[str, object]]:
    """One row for each of these sessions."""
    rows: list[dict[str, object]] = []
    for session in sessions:
        folder = made(session, plans=DEFAULT_CLIPS[:1])
        engine = "blender" if session.startswith(BLENDER) else "toile"
        size = float(session.split(":")[1])
        seen = measure(folder, folder.with_name(f"{folder.name}_run"))
        rows.append(_row(folder.name, engine, cause_of(folder.name), size, seen))
        print(rows[-1], flush=True)
    return rows


def of_graded(predictions: Path, marks: pd.DataFrame, measure: Measure = measured) -> list[dict[str, object]]:
    """One row for every session of a graded set."""
    rows: list[dict[str, object]] = []
    scenes = Path("outputs") / "blind" / predictions.name / "scenes"
    for mark in marks.drop_duplicates("scene").itertuples():
        seen = measure(scenes / str(mark.scene), predictions / str(mark.scene))
        rows.append(
            _row(str(mark.scene), str(mark.generator), str(mark.truth), float(mark.gap_percent), seen)
        )
        print(rows[-1], flush=True)
    return rows


def _row(session: str, engine: str, cause: str, size: float, seen: Seen) -> dict[str, object]:
    return {
        "session": session,
        "engine": engine,
        "cause": cause,
        "size [% of the width]": size,
        CHANGE: 100 * seen.change,
        SLIP: seen.slip,
    }


def updated(path: Path, rows: Sequence[Mapping[str, object]]) -> pd.DataFrame:
    """A table of sessions with new rows, in its file as well."""
    table = pd.read_csv(path) if path.is_file() else pd.DataFrame()
    if rows:
        write_text(path, added(table, pd.DataFrame(rows)).to_csv(index=False, float_format="%.4g"))
        table = pd.read_csv(path)
    return table


def added(table: pd.DataFrame, new: pd.DataFrame, keys: Sequence[str] = ("session",)) -> pd.DataFrame:
    """The table with new rows; what is in both by these columns has the new ones."""
    if table.empty or new.empty:
        return new if table.empty else table
    mine, theirs = (pd.MultiIndex.from_frame(rows[list(keys)]) for rows in (new, table))
    return pd.concat([table[~theirs.isin(mine)], new], ignore_index=True)


def learnt(table: pd.DataFrame) -> SessionWeights:
    """The four weights under which what shrinks, what slips and what does neither is most probable."""
    found = SessionWeights()
    sizes = np.log(np.maximum(np.abs(table[CHANGE].to_numpy()) / 100, 1e-4))
    shrinks = (table["cause"] == RESIZED).to_numpy()
    at, steep = parted(sizes, shrinks, (float(np.log(found.resized)), 1.0), found.resizing)
    found = replace(found, resized=float(np.exp(at)), resizing=steep)
    # Holders seem to go with a cloth that seems to change its size, so there nobody asks for slips.
    asked = ~shrinks
    slips = np.array([AnchorSlip.NAME in str(cause).split("+") for cause in table["cause"]])[asked]
    nats = table[SLIP].to_numpy()[asked]
    at, steep = parted(nats, slips, (found.slip_threshold, 10.0), 1 / found.slip_temperature)
    return replace(found, slip_threshold=at, slip_temperature=1 / steep)


def parted(
    values: Array, acts: NDArray[np.bool_], at: tuple[float, float], steep: float
) -> tuple[float, float]:
    """Place and slope of log odds steep (value - at) under which two kinds of sessions are most probable.

    There are more of those with the cause than there will be, so the odds are corrected for their share
    (King and Zeng 2001, Logistic regression in rare events data, the prior correction). Cases may lapse: a
    cloth that shrinks and has been tracked where it is says nothing of how large a change must be.

    Args:
        values: what is seen of every session (n,).
        acts: whether it has the cause (n,).
        at: place that few sessions leave as it is, and its deviation.
        steep: slope, the same; its logarithm has a deviation of 1.
    """
    signs = np.where(acts, 1.0, -1.0)
    start, wide = np.array([at[0], np.log(steep)]), np.array([at[1], 1.0])

    def cost(x: Array) -> float:
        right = expit(signs * np.exp(x[1]) * (values - x[0]))
        return float(sum(map(lapsed_loss, right)) + 0.5 * (((x - start) / wide) ** 2).sum())

    found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6}).x
    slope = float(np.exp(found[1]))
    share = max(float(acts.mean()), SHARE)
    more = np.log(share / (1 - share)) - np.log(SHARE / (1 - SHARE))
    return float(found[0] + more / slope), slope


def chance(change: float, weights: SessionWeights) -> float:
    """Probability that the cloth does become smaller or larger [change in %]."""
    share = max(abs(change) / 100, 1e-4)
    return float(expit(weights.resizing * np.log(share / weights.resized)))


def chance_of_slip(nats: float, weights: SessionWeights) -> float:
    """Probability that a holder slips where nothing else acts."""
    return float(expit((nats - weights.slip_threshold) / weights.slip_temperature))


def ship(weights: SessionWeights, names: Sequence[str], sessions: int, page: str) -> None:
    """Give the package some weights, and say what they are from.

    Args:
        weights: learnt.
        names: of those.
        sessions: that taught them.
        page: on which these are.
    """
    shipped = replace(SessionWeights.load(), **{name: getattr(weights, name) for name in names})
    source = str(json.loads(SHIPPED.read_text())["source"])
    before = [part for part in source.split("; ") if not part.startswith(names[0])]
    shipped.write(SHIPPED, "; ".join((*before, f"{', '.join(names)}: {sessions} sessions of {page}")))


def by_others(table: pd.DataFrame) -> pd.DataFrame:
    """The table with the probabilities of both by weights that a session had no part in."""
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    shrinks, slips = [], []
    for row in table.to_dict("records"):
        weights = learnt(teaching[teaching["session"] != row["session"]])
        shrinks.append(chance(row[CHANGE], weights))
        # As in a diagnosis, which asks for no slip where the size changes.
        resized = abs(row[CHANGE]) > 100 * weights.resized
        slips.append(float("nan") if resized else chance_of_slip(row[SLIP], weights))
    return table.assign(**{"changes its size": shrinks, "slips": slips})


def page(table: pd.DataFrame, weights: SessionWeights) -> str:
    """The page."""
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    shown = by_others(table)
    shown = shown.round({"size [% of the width]": 1, CHANGE: 2, SLIP: 1, "changes its size": 3, "slips": 3})
    shown = shown.assign(size=shown[CHANGE].abs()).sort_values(["size", SLIP], ascending=False, kind="stable")
    shown = shown.drop(columns="size")
    lines = [
        "# What holds the cloth: slips, and change of the apparent size",
        "",
        "Made by `python benchmarks/holders.py` from `holders.csv`: first clips of "
        f"{len(table)} sessions with open labels, in which nobody moved what holds the cloth. By how much "
        "its sides seem to have changed in the last third (diagnosis/apparent_size.py), and evidence of a "
        "slip (diagnosis/holder_slips.py), both in the motion that the base model has refined. "
        "Probabilities by weights that the session had no part in, of a slip where nothing else acts; "
        f"{NEVER_LEARNT_FROM} never teaches. Where the size changes no slip is asked for. Size: of the "
        "effect, in % of the width, as asked for or, of sealed sessions, as made.",
        "",
        f"Shipped: `resized` {weights.resized:.4f}, `resizing` {weights.resizing:.2f}, `slip_threshold` "
        f"{weights.slip_threshold:.1f} nats, `slip_temperature` {weights.slip_temperature:.2f} nats, from "
        f"{len(teaching)} sessions, {int((teaching['cause'] == RESIZED).sum())} of a cloth that shrinks and "
        f"{int(teaching['cause'].str.contains(AnchorSlip.NAME).sum())} of one whose holder slips, where "
        f"{100 * SHARE:g} % of each are expected.",
        "",
        shown.astype(object).where(shown.notna(), "–").to_markdown(index=False),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Add sessions to the table, or learn from it."""
    register_resolvers()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", nargs="+", default=[], help="sessions to add, see session_ladder")
    parser.add_argument("--graded", nargs="+", default=[], help="FOLDER=MARKS.csv of graded sets to add")
    parser.add_argument("--kept", action="store_true", help="refine nothing: motions that are there")
    given = parser.parse_args()
    measure = kept if given.kept else measured
    rows = of_ladder(given.sessions, measure)
    for one in given.graded:
        folder, _, marks = str(one).partition("=")
        rows += of_graded(Path(folder), pd.read_csv(marks, keep_default_na=False, na_values=[""]), measure)
    table = updated(TABLE, rows)
    teaching = table[table["engine"] != NEVER_LEARNT_FROM]
    weights = learnt(teaching)
    ship(weights, NAMES, len(teaching), "docs/results/holders.md")
    text = page(table, weights)
    write_text(RESULTS / "holders.md", text)
    print(text)


if __name__ == "__main__":
    main()
