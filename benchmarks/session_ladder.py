"""Where a diagnosis of several clips loses what they know: `make session-ladder`.

One thing after the other takes its true place: positions are the true ones, those with noise, the tracked
ones, or those that the base model refines; hypotheses have a free force or none; one clip counts or all, or
one of half the frame rate. Sessions come from the package's out-of-family generator and, through the extra
``blender``, from Blender. They are kept in outputs/session_ladder, as is what is found, so that it goes on
where it was.

    python benchmarks/session_ladder.py [--sessions air_drag:3:1 none:0:2 ...] [--rungs true tracked refined]
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from opened_session import OpenedSession, opened
from session_hypotheses import Hypotheses, hypotheses

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.denormals import denormals_flushed
from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.left_out import left_out_shrinks
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import RefinedMotion, SeenClip
from toile.effects.base import Effect
from toile.effects.catalogue import CATALOGUE, STAND_INS
from toile.generation.clip_plan import DEFAULT_CLIPS, ClipPlan
from toile.generation.out_of_family.base_scene import OutOfFamilySettings
from toile.generation.out_of_family.from_blender import make_clips_with_blender
from toile.generation.out_of_family.session_set import write_opaque_session
from toile.generation.out_of_family.sessions import SessionRequest, make_session
from toile.reports.run_folder import current_git_revision

Array = NDArray[np.float64]

FOLDER = Path("outputs") / "session_ladder"
BLENDER = "blender-"
"""Before the name of an effect: Blender makes the session."""
NEVER_LEARNT_FROM = "mujoco"
"""An engine for sealed sets alone."""
_FORCE = 0.3
"""Of each mode of the free force of a rung [m/s²]."""
WITHOUT_TRACE = ("gravity_tilt", "anchor_slip")
SESSIONS = (
    "none:0:2",
    "none:0:12",
    "none:0:13",
    "none:0:17",
    "air_drag:3:1",
    "internal_damping:3:3",
    "internal_damping:3:23",
    "anisotropic_stiffness:3:4",
    "anisotropic_stiffness:3:21",
    "gusts:3:5",
    "strain_stiffening:3:6",
    "nonuniform_density:3:7",
    "rest_curvature:3:8",
    "nonuniform_stiffness:3:9",
    "gravity_tilt:3:10",
    "anchor_slip:3:14",
    "blender-none:0:301",
    "blender-gusts:3:302",
    "blender-none:0:303",
    "blender-air_drag:3:304",
)
REFINED_ALONE = (
    *(f"none:0:{seed}" for seed in range(41, 46)),
    "air_drag:3:31",
    "gusts:3:32",
    "nonuniform_density:3:33",
    "nonuniform_stiffness:3:34",
    "rest_curvature:3:35",
    "frame_rate:3:36",
    "strain_stiffening:3:37",
    "anisotropic_stiffness:3:38",
    "contact:3:51",
    "contact:3:52",
    "vortex_field:3:61",
    "vortex_field:7:62",
    "shrinking:3:63",
    "shrinking:7:64",
    "internal_pressure:7:66",
    "plastic_creases:7:68",
    "blender-shrinking:7:305",
    "blender-vortex_field:7:306",
)
"""More sessions, as a diagnosis of their first clip sees them; some causes are not in the catalogue."""
REFINED = "refined, one clip"
NOISY = "true with noise, one clip"
SHORT = "refined, one clip at 25 fps"
RUNGS = (
    "true, one clip",
    NOISY,
    "tracked, one clip",
    REFINED,
    "refined, one clip, force 0.3",
    SHORT,
    "true",
    "refined",
)
_NOISE = 0.003
"""Mean distance by which NOISY moves every vertex in every frame, of the width."""
_SHORT = (replace(DEFAULT_CLIPS[0], n_frames=40, fps=25.0),)
"""As long as the first clip, in half as many frames: the clip of most users."""


def folder_of(session: str, within: Path = FOLDER) -> Path:
    """Where a session is kept that SESSIONS names."""
    name, size, seed = session.split(":")
    return within / f"{name}_{float(size):g}_{seed}"


def cause_of(folder: str) -> str:
    """The effect, or none, that made a session of that folder name."""
    return folder.rsplit("_", 2)[0].removeprefix(BLENDER)


def made(session: str, within: Path = FOLDER, plans: tuple[ClipPlan, ...] = DEFAULT_CLIPS) -> Path:
    """A session that SESSIONS names, with the truth beside its clips."""
    folder = folder_of(session, within)
    name, size, seed = session.removeprefix(BLENDER).split(":")
    if not (folder / f"truth_{len(plans) - 1}.npy").is_file():
        setup = OutOfFamilySettings(
            templates=(), substeps=4, coarse_substeps=3, largest_grid_share=2.5, n_frames=80, fps=50.0
        )
        effects = () if name == "none" else ((name, float(size)),)
        if session.startswith(BLENDER):
            clips = make_clips_with_blender(folder.name, effects, int(seed), plans)
        else:
            clips = make_session(setup, SessionRequest(folder.name, effects, int(seed), plans))
        films = [(plan, clip.scene) for plan, clip in zip(plans, clips, strict=True)]
        # Of fewer clips: the first of them are the same.
        shutil.rmtree(folder, ignore_errors=True)
        write_opaque_session(folder.name, films, folder)
        for k, clip in enumerate(clips):
            np.save(folder / f"truth_{k}.npy", clip.vertices.numpy())
    return folder


def true_motion(folder: Path, clips: Sequence[SeenClip]) -> list[Array]:
    """Of a session that was made here: of every clip (F, N, 3) [m]."""
    return [
        np.load(folder / f"truth_{k}.npy").astype(np.float64).reshape(clip.n_frames, -1, 3)
        for k, clip in enumerate(clips)
    ]


def off_by(folder: Path, clips: Sequence[SeenClip], motion: RefinedMotion) -> list[Array]:
    """How far a motion is from the true one: of every clip (F, N), in widths of the cloth."""
    width = clips[0].problem.scene.cloth_size[0]
    both = zip(motion.positions, true_motion(folder, clips), strict=True)
    return [np.linalg.norm(found - true, axis=-1) / width for found, true in both]


def right_answer(cause: str) -> str:
    """What should be said of it: its name, or none, or unknown where the catalogue lacks it."""
    return cause if cause in CATALOGUE or cause == NONE else UNKNOWN


def answer_columns(said: Mapping[str, float], cause: str) -> dict[str, object]:
    """The most probable answer, and the probability of the right one.

    Args:
        said: probability of every answer.
        cause: what has made the session.
    """
    best = max(said, key=lambda name: said[name])
    return {
        "first": best,
        "its probability": said[best],
        "right answer": said.get(right_answer(cause), 0.0),
    }


@denormals_flushed()
def fitted(folder: Path, rung: str, out: Path) -> list[dict[str, object]]:
    """Every hypothesis on one rung."""
    session = opened(folder, out, first="one clip" in rung)
    clips, settings = session.clips, session.together
    truth = true_motion(folder, clips)
    width = clips[0].problem.scene.cloth_size[0]
    motion, seen = _motion(session, truth, rung, width)
    if "force" in rung:
        settings = replace(settings, fit=replace(settings.fit, force=_FORCE, outside=_FORCE))
    away = off_by(folder, clips, motion)
    truth_is = cause_of(folder.name)
    # The cause is fitted whatever it promises, so that what it predicts is known.
    found = hypotheses(session, motion, settings, (truth_is,), free="force" not in rung, seen=seen)
    errors, base = found.evidence.base, found.base
    learned = found.evidence.learned or {}
    common = {
        "session": folder.name,
        "rung": rung,
        "revision": current_git_revision(),
        "position error [% of the width]": 100 * np.mean([one.mean() for one in away]),
        "seconds": sum((clip.n_frames - 1) / clip.problem.scene.fps for clip in clips),
        "plain misfit": found.plain.misfit,
        "base misfit": base.misfit,
        "usual": " ".join(base.names),
        "cost of errors": errors.cost,
        "expected cost": errors.expected,
        "share": errors.share,
    }
    rows: list[dict[str, object]] = []
    for name, one in found.evidence.effects.items():
        freed = found.outside.causes.get(name)
        rows.append(
            {
                **common,
                "effect": name,
                **evidence_columns(one),
                "occam": one.occam,
                "nats": one.nats(),
                "nats before it is fitted": found.linear[name].nats(),
                "moves the cloth by [% of the width]": 100 * found.sizes[name],
                "learned": learned.get(name, float("nan")),
                "nats from outside": None if freed is None else freed.evidence.nats(),
                "moves the cloth from outside by [% of the width]": None
                if freed is None
                else 100 * freed.displacement.last,
                **({} if freed is None else evidence_columns(freed.evidence, "outside ")),
                "passes": len(found.fits[name].history) - len(base.history),
                "CPU [s]": found.seconds[name],
            }
        )
    said = found.chances()
    fps, exact = clips[-1].problem.scene.fps, rung.startswith("true")
    asked_for = [effect for effect in found.chosen if truth_is == effect.NAME]
    predicted = _predicted(found, asked_for, settings, fps, exact=exact) if asked_for else {}
    for row in rows:
        name = str(row["effect"])
        row |= {"probability": said.get(name, float("nan")), "probability of none": said[NONE]}
        row |= {"probability of unknown": said.get(UNKNOWN, float("nan")), **predicted.get(name, {})}
    return rows


def evidence_columns(one: EffectEvidence, which: str = "") -> dict[str, object]:
    """What an effect's evidence is made of, under names that begin with ``which``."""
    return {
        f"{which}drop": one.drop,
        f"{which}information": " ".join(f"{value:.5g}" for value in one.information),
        f"{which}slopes": " ".join(f"{value:.5g}" for value in one.slopes),
        f"{which}fitted size": one.fitted_size,
    }


def _predicted(
    found: Hypotheses, chosen: Sequence[Effect], settings: SessionSettings, fps: float, *, exact: bool
) -> dict[str, dict[str, float | None]]:
    """How far the effects asked for shrink the held-out error; on true positions: the oracle.

    The best placebo is the same for all of them.
    """
    shrinks = left_out_shrinks(
        found.model.fitting,
        found.model.left_out,
        found.base,
        {effect.NAME: found.fits[effect.NAME] for effect in chosen},
        {effect.NAME: effect for effect in chosen},
        max(2, round(settings.ahead * fps / 25)),
        settings.placebos,
        settings.seed,
        None if exact else found.model.last_clip_of,
    ).shrinks
    return {
        name: {"held-out shrink": one.estimate, "its low": one.low, "best placebo": one.best_placebo}
        for name, one in shrinks.items()
    }


def _motion(
    session: OpenedSession, truth: list[Array], rung: str, width: float
) -> tuple[RefinedMotion, Sequence[SeenClip]]:
    """The motion of a rung, and the clips with what is known of their holders."""
    if rung == NOISY:
        rng = np.random.default_rng(0)
        # A Gaussian vector is longer than its standard deviation along an axis, 1.6 times in the mean.
        along = _NOISE * width / np.sqrt(8 / np.pi)
        return RefinedMotion([x + along * rng.standard_normal(x.shape) for x in truth], None), session.clips
    if rung.startswith("true"):
        return RefinedMotion(truth, None), session.clips
    if rung.startswith("tracked"):
        tracked = [clip.tracked.positions[: clip.n_frames] for clip in session.clips]
        return RefinedMotion(tracked, None), session.clips
    held = session.held()
    return held.motion, held.clips


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Per rung: which effect leads, by how much, and how far nulls go."""
    rows = []
    for (rung, session), every in table.groupby(["rung", "session"], sort=False):
        truth = cause_of(str(session))
        usual = every["usual"] == every["effect"]
        # What the base model has of itself is no rival, and a stand-in names nothing.
        own = every[(~usual & ~every["effect"].isin(STAND_INS)) | (every["effect"] == truth)]
        best = own.sort_values("nats", ascending=False).iloc[0]
        of_truth = own.loc[own["effect"] == truth, "nats"]
        rivals = own.loc[own["effect"] != truth, "nats"].max()
        rows.append(
            {
                "rung": rung,
                "session": session,
                "revision": str(own["revision"].iloc[0])[:7],
                "truth": truth,
                "position error [%]": own["position error [% of the width]"].iloc[0],
                "leads": best["effect"],
                "truth leads": best["effect"] == truth,
                "its gain [nats]": best["nats"],
                "usual damping moves the cloth by [%]": every.loc[
                    usual, "moves the cloth by [% of the width]"
                ].max(),
                "truth over best rival [nats]": of_truth.iloc[0] - rivals if len(of_truth) else np.nan,
                "its probability": _of_truth(every, truth),
                "shrink [%]": 100 * _first(own[own["effect"] == truth], "held-out shrink"),
                "best placebo [%]": 100 * _first(own[own["effect"] == truth], "best placebo"),
            }
        )
    return pd.DataFrame(rows)


def _of_truth(rows: pd.DataFrame, truth: str) -> float:
    """Probability of the cause, or of none or unknown where that is right; NaN where it was not kept."""
    if (answer := right_answer(truth)) in (NONE, UNKNOWN):
        return _first(rows, f"probability of {answer}")
    return _first(rows[rows["effect"] == truth], "probability")


def _first(rows: pd.DataFrame, column: str) -> float:
    return float(rows[column].iloc[0]) if column in rows and len(rows) else float("nan")


def main() -> None:
    """Write docs/results/session_ladder.md and its evidence, session_ladder.csv."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", nargs="+", default=(*SESSIONS, *REFINED_ALONE))
    parser.add_argument("--rungs", nargs="+", help="of every session; all of SESSIONS, one of the others")
    parser.add_argument("--known", action="store_true", help="fit nothing: the tables of what is kept")
    parser.add_argument("--output", type=Path, default=Path("docs") / "results" / "session_ladder.md")
    given = parser.parse_args()
    torch.set_num_threads(1)
    register_resolvers()
    rows: list[dict[str, object]] = []
    for session in given.sessions:
        rungs = given.rungs or ((REFINED,) if session in REFINED_ALONE else RUNGS)
        # The first clip is the same, whether others follow or not.
        alone = all("one clip" in rung for rung in rungs)
        plans = DEFAULT_CLIPS[:1] if alone else DEFAULT_CLIPS
        for rung in rungs:
            kept = FOLDER / f"{folder_of(session).name}, {rung}.json"
            if not kept.is_file():
                if given.known:
                    continue
                within = FOLDER / "short" if rung == SHORT else FOLDER
                folder = made(session, within, _SHORT if rung == SHORT else plans)
                write_text(kept, json.dumps(fitted(folder, rung, within / f"{folder.name}_run")))
            rows += json.loads(kept.read_text())
            print(
                summary(pd.DataFrame(rows)).tail(1).to_string(index=False, header=len(rows) < 12), flush=True
            )
    evidence = given.output.with_suffix(".csv")
    table = _with_lines_before(pd.DataFrame(rows), evidence)
    write_text(evidence, table.to_csv(index=False, float_format="%.5g"))
    write_text(given.output, page(table))


def _with_lines_before(new: pd.DataFrame, path: Path) -> pd.DataFrame:
    """Sorted by rungs; sessions that have not been run on this machine keep the lines that are there."""
    if path.is_file():
        before = pd.read_csv(path)
        before = before[before["rung"].isin(RUNGS)]
        mine = pd.MultiIndex.from_frame(new[["session", "rung"]])
        theirs = pd.MultiIndex.from_frame(before[["session", "rung"]])
        new = pd.concat([new, before[~theirs.isin(mine)]], ignore_index=True)
    order = {rung: k for k, rung in enumerate(RUNGS)}
    ranked = new["rung"].map(lambda rung: order.get(rung, len(order)))
    return new.iloc[np.argsort(ranked.to_numpy(), kind="stable")]


def _by_rung(sessions: pd.DataFrame, column: str, show: str) -> pd.DataFrame:
    """A column of every session, rung beside rung; sessions of no value are left out."""
    wide = sessions.pivot(index="session", columns="rung", values=column).dropna(how="all")
    wide = wide[[rung for rung in RUNGS if rung in wide]]
    return wide.map(lambda value: "–" if np.isnan(value) else show.format(value))


def _share(sessions: pd.DataFrame, column: str, least: float) -> pd.Series:
    """By rung: how many reach it, of how many where that is known."""
    known = sessions[sessions[column].notna()].groupby("rung", sort=False)[column]
    return known.agg(lambda values: f"{int((values >= least).sum())} of {len(values)}").astype(object)


def page(table: pd.DataFrame) -> str:
    """Both tables in words."""
    lines = [
        "# Ladder of a diagnosis of several clips",
        "",
        "Made by `make session-ladder`. Lines are of the revision that they name; what has not been run "
        "since keeps its line.",
        "",
    ]
    sessions = summary(table)
    moved = sessions.loc[sessions["truth"].isin(tuple(CATALOGUE)) & ~sessions["truth"].isin(WITHOUT_TRACE)]
    lacking = sessions.loc[~sessions["truth"].isin((*CATALOGUE, "none"))]
    still = sessions.loc[sessions["truth"] == "none"]
    counts = pd.DataFrame(
        {
            "effects": moved.groupby("rung", sort=False).size(),
            "truth leads": moved.groupby("rung", sort=False)["truth leads"].sum(),
            "and above every null": pd.Series(
                {
                    rung: np.nan
                    if np.isnan(nothing)
                    else int((own["truth leads"] & (own["its gain [nats]"] > nothing)).sum())
                    for rung, own in moved.groupby("rung", sort=False)
                    for nothing in [still.loc[still["rung"] == rung, "its gain [nats]"].max()]
                },
                dtype=object,
            ),
            "median over best rival [nats]": moved.groupby("rung", sort=False)[
                "truth over best rival [nats]"
            ].median(),
            "named (0.9)": _share(moved, "its probability", 0.9),
            "shrink, median [%]": moved.groupby("rung", sort=False)["shrink [%]"].median(),
            "best placebo, median [%]": moved.groupby("rung", sort=False)["best placebo [%]"].median(),
            "nulls": still.groupby("rung", sort=False).size(),
            "largest gain of a null [nats]": still.groupby("rung", sort=False)["its gain [nats]"].max(),
            "nulls answered none (0.5)": _share(still, "its probability", 0.5),
            "outside the catalogue, unknown (0.9)": _share(lacking, "its probability", 0.9),
        }
    )
    of_nats = [name for name in counts if "median" in name or "nats" in name]
    counts = counts.reindex([rung for rung in RUNGS if rung in counts.index])
    for name in counts:
        show = "{:.1f}" if name in of_nats else "{:.0f}"
        counts[name] = [
            "–" if pd.isna(value) else value if isinstance(value, str) else show.format(value)
            for value in counts[name]
        ]
    lines += [counts.rename_axis("rung").reset_index().to_markdown(index=False), ""]
    lines += [
        f"Sessions whose cause is {' or '.join(WITHOUT_TRACE)} do not count: the former is a wind, the "
        "latter is seen in images. "
        "Damping, which the base model has where a clip shows it, counts as an effect only where it is the "
        "cause; its gain is against a model without.",
        "",
    ]
    lines += [
        "Leads and gains are those under a law; probabilities are of all evidence, causes from outside "
        "judged with the forces within the cloth free. The shrink is that of the fitted cause on the clip "
        "that was left out (of one clip: on pieces of it); on true positions it is what could be reached. "
        "Images of clips (light, blur, slips of holders) are not judged here. "
        f"Noise: {100 * _NOISE:g} % of the width in the mean, of every vertex in every frame on its own.",
        "",
    ]
    for column, show, what in (
        ("its probability", "{:.2f}", "Probability of the truth"),
        ("truth over best rival [nats]", "{:.0f}", "Truth over the best rival under the law [nats]"),
        ("position error [%]", "{:.2f}", "Error of the positions [% of the width]"),
    ):
        lines += [f"## {what}", "", _by_rung(sessions, column, show).to_markdown(), ""]
    lines += ["## Every line", ""]
    for column in (
        "truth over best rival [nats]",
        "its probability",
        "shrink [%]",
        "best placebo [%]",
    ):
        sessions[column] = sessions[column].map(lambda value: "–" if np.isnan(value) else f"{value:.2f}")
    lines += [sessions.to_markdown(index=False, floatfmt=".2f"), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
