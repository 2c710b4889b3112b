"""Learn what evidence of a session is worth: docs/results/session_weights.md, and the package's weights.

    python benchmarks/session_weights.py
        # from docs/results/held_corners.csv, session_evidence_held.csv
    python benchmarks/session_weights.py --graded outputs/blind_predictions/NAME=MARKS.csv
        # adds a graded set first, or FOLDER alone: diagnoses of sessions of the ladder, by name
    python benchmarks/session_weights.py --clips 3 --graded ...  # from three clips, not the first
    python benchmarks/session_weights.py --ship  # puts what is best on these cases into the package
    python benchmarks/session_weights.py --into TABLE.csv --graded ...  # keeps them, nothing is learnt

Evidence is worth what the model and the motion are wrong by, so only those of today teach; the other tables
are of corners that may wander by 10 mm, or of models of 14 x 14 even vertices.

Weights are judged on an engine that they were not learnt from. Sessions of the engine that is for sealed sets
alone never teach.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from held_corners import TABLE as HELD_CORNERS
from held_corners import WIDTHS
from numpy.typing import NDArray
from session_ladder import BLENDER, NEVER_LEARNT_FROM, REFINED, cause_of, evidence_columns

from toile.atomic_file import write_text
from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_weights import (
    EVIDENCE_FILE,
    SHIPPED,
    MotionEvidence,
    SessionCase,
    SessionWeights,
    lapsed_loss,
    learnt_weights,
)
from toile.effects.catalogue import PUSHING, STAND_INS
from toile.generation.out_of_family.catalogue import OUTSIDE

Array = NDArray[np.float64]

RESULTS = Path("docs") / "results"
RUNGS = {1: REFINED, 3: "refined"}
"""By clips."""
AS_NONE = ("anchor_slip",)
"""Causes that images show; what they do beside is no effect on the motion."""
LEFT_OUT = ("gravity_tilt",)
"""Causes that are a wind to the base model: neither none nor to be found."""


_FREED_SIZE = "moves the cloth from outside by [% of the width]"

HELD = RESULTS / "session_evidence_held.csv"
"""Evidence of sealed sessions after grading, by motions whose corners are held."""
SIZES_SEEN = RESULTS / "holders.csv"
"""By how much sides seem to change, by session: benchmarks/holders.py."""
FIXED = (
    "outside_spread",
    "outside_unchanging",
    *(f.name for f in fields(SessionWeights) if f.name.startswith(("resiz", "cover", "slip_"))),
)
"""Learnt elsewhere: benchmarks/outside_causes.py, unchanging_causes.py, holders.py, occlusion.py."""
RIVALS = (1e9, 32.0, 16.0, 8.0, 4.0)
"""Values of ``rivals`` among which one is chosen [nats]; with the first the law is not asked."""
_EQUAL = 0.01
"""Loss by which two values are as good as each other."""
FARTHEST = (5.0, 8.0, 12.0, 20.0)
"""Values of ``farthest`` among which one is chosen."""
HANDICAPS = (0.0, 10.0, 20.0, 30.0, 45.0, 60.0)
"""Values of stand_in, searched and outside_stand_in among which one of each is chosen [nats]."""
SPREADS = (0.0, 0.35, 0.7, 1.0, 1.4)
"""Values of law_spread among which one is chosen."""


def cases_of(table: pd.DataFrame) -> list[SessionCase]:
    """Evidence of every session on the rungs that a diagnosis has."""
    seen = pd.read_csv(SIZES_SEEN).set_index("session")["change of size [%]"] / 100
    found = []
    table = table[table["rung"].isin(RUNGS.values())]
    for (rung, session), own in table.groupby(["rung", "session"], sort=False):
        cause = str(own["cause"].iloc[0]) if "cause" in own else cause_of(str(session))
        if cause in OUTSIDE and set(STAND_INS) & set(own["effect"]):
            cause = UNKNOWN
        elif cause in LEFT_OUT or cause not in (NONE, *AS_NONE, *own["effect"]):
            continue
        by_name = own.set_index("effect")
        # A base model may have none.
        usual = " ".join(map(str, own["usual"].dropna().unique())).split()
        learned = by_name["learned"].dropna().to_dict() or None
        evidence = MotionEvidence(
            ModelErrors(*(float(own[key].iloc[0]) for key in ("cost of errors", "expected cost", "share"))),
            {str(name): _effect(row) for name, row in by_name.iterrows()},
            learned,
            {name: by_name.loc[name, "moves the cloth by [% of the width]"] / 100 for name in usual},
            {
                str(name): row["moves the cloth by [% of the width]"] / 100
                for name, row in by_name.iterrows()
                if name not in usual and np.isfinite(row["moves the cloth by [% of the width]"])
            },
        )
        freed_sizes = {
            str(name): row[_FREED_SIZE] / 100
            for name, row in by_name.iterrows()
            if np.isfinite(row.get(_FREED_SIZE, np.nan))
        }
        # As a diagnosis has them: of causes from outside beside free forces, of stand-ins the larger.
        sizes = dict(evidence.sizes)
        sizes |= {n: size for n, size in freed_sizes.items() if n not in (*PUSHING, *STAND_INS)}
        sizes |= {n: max(sizes[n], freed_sizes[n]) for n in STAND_INS if n in sizes and n in freed_sizes}
        resized = _looked(own, "resized")
        if resized is None and session in seen.index:
            resized = float(seen[session])
        evidence = replace(evidence, sizes=sizes, resized=resized, covered=_looked(own, "covered"))
        if "outside drop" in own:
            freed = by_name[by_name["outside drop"].notna()]
            outside = {str(name): _effect(row, "outside ") for name, row in freed.iterrows()}
            evidence = replace(evidence, outside=outside)
        (n,) = (clips for clips, name in RUNGS.items() if name == rung)
        found.append(SessionCase(str(session), NONE if cause in AS_NONE else cause, evidence, n))
    return found


def graded_evidence(folder: Path, marks: pd.DataFrame, rung: str = REFINED) -> pd.DataFrame:
    """Evidence of sealed sessions with open labels in the form of session_ladder.csv.

    Args:
        folder: of diagnoses, every session in a folder of its own.
        marks: of all sessions, see docs/results/blind_sessions_seven_marks.csv.
        rung: which clips they are from.
    """
    rows: list[dict[str, object]] = []
    of_motion = marks[~marks["of_the_image"]].drop_duplicates("scene")
    for mark in of_motion.itertuples():
        if not (folder / str(mark.scene) / EVIDENCE_FILE).is_file():
            # Of another set, or not answered.
            continue
        about = (str(mark.scene), str(mark.generator), str(mark.truth), rung)
        rows += _rows(folder / str(mark.scene), *about)
    return pd.DataFrame(rows)


def developed_evidence(folder: Path, rung: str = REFINED) -> pd.DataFrame:
    """The same of diagnoses of sessions that session_ladder names."""
    rows: list[dict[str, object]] = []
    for run in sorted(path.parent for path in folder.glob(f"*/{EVIDENCE_FILE}")):
        if run.name.count("_") < 2:
            # A sealed session, whose folder tells nothing.
            continue
        engine = "blender" if run.name.startswith(BLENDER) else "toile"
        rows += _rows(run, run.name, engine, cause_of(run.name), rung)
    return pd.DataFrame(rows)


def _rows(run: Path, session: str, engine: str, cause: str, rung: str) -> list[dict[str, object]]:
    evidence = MotionEvidence.load(run / EVIDENCE_FILE)
    sizes = {**evidence.sizes, **evidence.usual}
    return [
        {
            "session": session,
            "engine": engine,
            "cause": cause,
            "rung": rung,
            "usual": " ".join(evidence.usual),
            "cost of errors": evidence.base.cost,
            "expected cost": evidence.base.expected,
            "share": evidence.base.share,
            "resized": float("nan") if evidence.resized is None else evidence.resized,
            "covered": float("nan") if evidence.covered is None else evidence.covered,
            "effect": name,
            **evidence_columns(one),
            "moves the cloth by [% of the width]": 100 * sizes.get(name, float("nan")),
            "learned": (evidence.learned or {}).get(name, float("nan")),
            **(evidence_columns(evidence.outside[name], "outside ") if name in evidence.outside else {}),
        }
        for name, one in evidence.effects.items()
    ]


def _looked(own: pd.DataFrame, key: str) -> float | None:
    """What the cloth looks like; None where that was not kept, or not found."""
    value = float(own[key].iloc[0]) if key in own else float("nan")
    return None if np.isnan(value) else value


def _effect(row: pd.Series, which: str = "") -> EffectEvidence:
    information, slopes = (
        tuple(map(float, str(row[f"{which}{key}"]).split())) for key in ("information", "slopes")
    )
    return EffectEvidence(float(row[f"{which}drop"]), information, slopes, float(row[f"{which}fitted size"]))


def main() -> None:
    """Write the page and the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    help_ = "FOLDER=MARKS.csv of graded sets, FOLDER of others"
    parser.add_argument("--graded", nargs="+", default=[], help=help_)
    parser.add_argument("--into", type=Path, default=HELD, help="another table than that which teaches")
    parser.add_argument("--clips", type=int, choices=RUNGS, default=1, help="that --graded is from")
    parser.add_argument("--ship", action="store_true", help="put the weights into the package")
    given = parser.parse_args()
    if given.into != HELD and not given.graded:
        parser.error("--into: expected --graded beside it, got nothing to keep")
    for one in given.graded:
        folder, _, marks = str(one).partition("=")
        rung = RUNGS[given.clips]
        new = (
            graded_evidence(Path(folder), pd.read_csv(marks), rung)
            if marks
            else developed_evidence(Path(folder), rung)
        )
        if new.empty:
            parser.error(f"--graded {one}: expected evidence of a session of it, got none in {folder}")
        if given.into.is_file():
            there = pd.read_csv(given.into)
            again = there["session"].isin(new["session"]) & (there["rung"] == rung)
            new = pd.concat([there[~again], new])
        write_text(given.into, new.to_csv(index=False, float_format="%.5g"))
    if given.into != HELD:
        return
    write(known_cases(), ship=given.ship)


def known_cases() -> dict[str, list[SessionCase]]:
    """Cases with open labels by the engine that made them."""
    tables = [of_width(pd.read_csv(HELD_CORNERS), SessionSettings().held)]
    if HELD.is_file():
        tables.append(pd.read_csv(HELD))
    return {str(engine): cases_of(own) for engine, own in pd.concat(tables).groupby("engine", sort=False)}


def of_width(table: pd.DataFrame, held: float) -> pd.DataFrame:
    """Lines of held_corners.csv by one value of ``session_model.held`` [m], in the form of the others."""
    (width,) = (name for name, value in WIDTHS.items() if value == held)
    return table[table["width"] == width].assign(resized=table["change of size [%]"] / 100)


def write(cases: Mapping[str, Sequence[SessionCase]], *, ship: bool) -> None:
    """The page, and with ``ship`` the weights: those that say most of an engine they have not seen."""
    before = SessionWeights.load()
    teaching = {engine: list(own) for engine, own in cases.items() if engine != NEVER_LEARNT_FROM}
    everything = [case for own in teaching.values() for case in own]
    unseen = list(cases.get(NEVER_LEARNT_FROM, ()))
    rows: list[dict[str, object]] = []
    losses: list[Array] = []
    learnt: dict[float, SessionWeights] = {}
    for spread in SPREADS:
        prior = replace(before, law_spread=spread)
        by_others = {
            engine: learnt_weights(
                [case for other, own in teaching.items() if other != engine for case in own], prior, FIXED
            )
            for engine in teaching
        }
        learnt[spread] = learnt_weights(everything, prior, FIXED)
        for which, by_engine, of_all in (
            ("as before", dict.fromkeys(teaching, prior), prior),
            ("learnt", by_others, learnt[spread]),
        ):
            asked = [(case, by_engine[engine]) for engine, own in teaching.items() for case in own]
            losses.append(np.array([lapsed_loss(case.chances(w)[case.cause]) for case, w in asked]))
            about = {"weights": which, "law_spread": spread}
            others = _of_unseen(unseen, of_all)
            rows.append(about | score(asked, "") | others)
            print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    best = _most_cautious(table, losses)
    spread = float(best["law_spread"])
    weights = learnt[spread] if best["weights"] == "learnt" else replace(before, law_spread=spread)
    asked_of_law, of_rivals = _rivals(weights, everything, unseen)
    weights = replace(weights, **asked_of_law)
    handicaps, of_handicaps = _handicaps(weights, everything)
    weights = replace(weights, **handicaps)
    source = json.loads(SHIPPED.read_text())["source"]
    n = len({case.session for case in everything})
    scored = (".3f", "g", "g") * (2 if unseen else 1)
    chosen = "Shipped" if ship else "Best on these cases, not shipped"
    if ship and weights != before:
        within = "" if best["weights"] == "as before" else " and all within the cloth"
        how = f"law_spread, rivals, stand-ins{within}"
        added = f"{how}: {n} sessions of docs/results/session_weights.md"
        weights.write(SHIPPED, source if source.endswith(added) else f"{source}; {added}")
    shown = {"index": False, "floatfmt": ".2f"}
    answering = weights if ship else before
    without = replace(answering, law_spread=0.0)
    answers = {name: _answers(own, without, answering) for name, own in cases.items()}
    lines = [
        "# Weights of a session's evidence",
        "",
        "Made by `python benchmarks/session_weights.py` from `held_corners.csv` (first clips of sessions of "
        "the ladder's kind) and `session_evidence_held.csv` (sealed sets after grading), by motions whose "
        f"corners are held to 2 mm: {len(everything)} cases of {n} generated sessions of {len(teaching)} "
        "engines, open labels. Development data, no blind check; `strange`, `strangeness` and `surest` "
        "are set by hand, the spread of sizes from outside is of [outside_causes.md](outside_causes.md), "
        "`outside_unchanging` of [unchanging_causes.md](unchanging_causes.md), weights of the apparent size "
        "and of slips of [holders.md](holders.md).",
        "",
        "## An engine that taught nothing",
        "",
        "What carries over to a cloth unlike those that taught: *learnt* are weights that the engine asked "
        "about had no part in; *as before* are those of the package, all but `law_spread`. Loss: mean "
        "negative log probability of the cause, cases of all teaching engines alike; named: with "
        f"{SessionSettings().named:g} and more."
        + (" MuJoCo's columns choose nothing." if unseen else " MuJoCo has no case of such models yet."),
        "",
        table.to_markdown(index=False, floatfmt=("", "g", *scored)),
        "",
        f"{chosen}: {best['weights']}, `law_spread` {spread:g}, the widest within one standard error of "
        "the least loss: a wrong name costs more than none.",
        "",
        "| weight | before | chosen | learnt from all, for that spread |",
        "|---|---|---|---|",
        *(
            f"| {f.name} | {getattr(before, f.name):.3g} | {getattr(weights, f.name):.3g} "
            f"| {getattr(learnt[spread], f.name):.3g} |"
            for f in fields(SessionWeights)
            if f.name not in (*FIXED, *asked_of_law, *handicaps)
        ),
        "",
        "## One cause from outside against another",
        "",
        "`rivals`: evidence under the law by which the odds among drag, gusts, a wrong clock and stand-ins "
        "grow e-fold, by `farthest` e-folds at most, all else as before; *no* asks the free forces alone. "
        "All teaching cases; two numbers, chosen on the same cases.",
        "",
        of_rivals.to_markdown(index=False, floatfmt=("", "g", ".4f", *scored[1:])),
        "",
        f"{chosen}: {asked_of_law['rivals']:g} and {asked_of_law['farthest']:g}; of those with "
        f"fewest wrong names and a loss within {_EQUAL:g} of the least that with the smallest `farthest`, "
        "unless those of before name as few wrongly and lose no more than one standard error.",
        "",
        "## Stand-ins, and contact that was looked for",
        "",
        "`stand_in`: evidence under the law that a flexible stand-in for what the catalogue lacks needs "
        "beyond what an effect does; `outside_stand_in`: the same beside free forces; `searched`: the same "
        "of contact with the best of many obstacles, under the law. Chosen together, with the least loss on "
        "the sessions that have both, the largest of equals, unless those of before lose no more than one "
        "standard error beside them. A cause left out: handicaps chosen without any session of it.",
        "",
        of_handicaps.to_markdown(index=False, floatfmt=".3f"),
        "",
        f"{chosen}: " + ", ".join(f"{name} {value:g}" for name, value in handicaps.items()) + ".",
        "",
    ]
    lines += ["## Answers by the weights of the package", ""]
    for engine, own in answers.items():
        about = " (never teaches)" if engine == NEVER_LEARNT_FROM else ""
        lines += [f"### Cases: {engine}{about}", "", _summary(own), "", own.to_markdown(**shown), ""]
    write_text(RESULTS / "session_weights.md", "\n".join(lines))
    print("\n".join(lines))


def _rivals(
    weights: SessionWeights, teaching: Sequence[SessionCase], unseen: Sequence[SessionCase]
) -> tuple[dict[str, float], pd.DataFrame]:
    """Values of ``rivals`` and ``farthest`` with the least loss of those with fewest wrong names.

    Those of before stay where they name as few wrongly and lose no more than one standard error of the paired
    differences: what a handful of cases more would turn round is no reason to change an answer.
    """
    before = {"rivals": weights.rivals, "farthest": weights.farthest}
    tried = [{"rivals": RIVALS[0], "farthest": FARTHEST[0]}]
    tried += [{"rivals": r, "farthest": f} for r, f in product(RIVALS[1:], FARTHEST)]
    tried += [before] if before not in tried else []
    scores, rows, losses = [], [], []
    for one in tried:
        asking = replace(weights, **one)
        scores.append(score([(case, asking) for case in teaching], ""))
        losses.append(_losses(teaching, asking))
        others = _of_unseen(unseen, asking)
        name = "no" if one["rivals"] == RIVALS[0] else f"{one['rivals']:g}"
        rows.append({"rivals [nats]": name, "farthest": one["farthest"]} | scores[-1] | others)
    fewest = min(int(score["wrongly"]) for score in scores)
    kept = [k for k, score in enumerate(scores) if int(score["wrongly"]) == fewest]
    least = min(float(scores[k]["loss"]) for k in kept)
    # The more the law may say, the more a fit of it that has failed may spoil.
    near = [k for k in kept if float(scores[k]["loss"]) < least + _EQUAL]
    best = min(near, key=lambda k: (tried[k]["farthest"], float(scores[k]["loss"])))
    there = tried.index(before)
    more = losses[there] - losses[best]
    if there in kept and float(more.mean()) <= float(more.std(ddof=1)) / np.sqrt(len(more)):
        best = there
    return tried[best], pd.DataFrame(rows)


def _handicaps(
    weights: SessionWeights, teaching: Sequence[SessionCase]
) -> tuple[dict[str, float], pd.DataFrame]:
    """Handicaps with the least loss, and the answers to every kind by handicaps that have not seen it.

    Those of before stay where they lose no more than one standard error.
    """
    cases = [case for case in teaching if set(STAND_INS) & set(case.evidence.effects)]
    names = ("stand_in", "outside_stand_in", "searched")
    # The most cautious first, so that of equals it stays.
    tried = [
        dict(zip(names, values, strict=True)) for values in product(sorted(HANDICAPS, reverse=True), repeat=3)
    ]
    losses = np.array([_losses(cases, replace(weights, **one)) for one in tried])
    rows = []
    # The folders of sealed sessions tell nothing.
    kinds = np.array([cause_of(case.session) if "_" in case.session else case.cause for case in cases])
    for kind in dict.fromkeys(kinds.tolist()):
        own = kinds == kind
        best = tried[int(losses[:, ~own].mean(1).argmin())]
        there = [case for case, here in zip(cases, own, strict=True) if here]
        found = [case.chances(replace(weights, **best)) for case in there]
        right = [p[case.cause] for p, case in zip(found, there, strict=True)]
        wrong = [_named(p) not in ("", case.cause) for p, case in zip(found, there, strict=True)]
        rows.append(
            {
                "cause left out": kind,
                "sessions": len(there),
                **best,
                "probability of the cause, median": float(np.median(right)),
                "least": min(right),
                "named wrongly": sum(wrong),
            }
        )
    best = int(losses.mean(1).argmin())
    before = {name: getattr(weights, name) for name in names}
    # As with the rivals: what a handful of cases more would turn round is no reason.
    more = _losses(cases, weights) - losses[best]
    stay = float(more.mean()) <= float(more.std(ddof=1)) / np.sqrt(len(more))
    return before if stay else tried[best], pd.DataFrame(rows)


def _losses(cases: Sequence[SessionCase], weights: SessionWeights) -> Array:
    return np.array([lapsed_loss(case.chances(weights)[case.cause]) for case in cases])


def _named(p: Mapping[str, float]) -> str:
    """The effect that is probable enough to be the answer, "" for none."""
    first = max(p, key=lambda name: p[name])
    return first if p[first] >= SessionSettings().named and first not in (NONE, UNKNOWN) else ""


def _most_cautious(table: pd.DataFrame, losses: Sequence[Array]) -> pd.Series:
    """Of those within one standard error of the least loss the one with the widest spread.

    A name that is wrong costs more than none, so where the cases cannot tell the wider one is taken
    (Breiman et al. 1984, the rule of one standard error, of paired differences here).
    """
    least = min(range(len(losses)), key=lambda k: float(losses[k].mean()))
    more = [own - losses[least] for own in losses]
    near = [float(d.mean()) <= float(d.std(ddof=1)) / np.sqrt(len(d)) for d in more]
    same = table["weights"] == table["weights"].iloc[least]
    return table[same & np.array(near)].sort_values("law_spread").iloc[-1]


def score(asked: Sequence[tuple[SessionCase, SessionWeights]], suffix: str) -> dict[str, float]:
    loss, right, wrong = 0.0, 0, 0
    for case, weights in asked:
        p = case.chances(weights)
        name = _named(p)
        loss += lapsed_loss(p[case.cause]) / len(asked)
        right += int(name == case.cause)
        wrong += int(name not in ("", case.cause))
    return {f"loss{suffix}": loss, f"named{suffix}": right, f"wrongly{suffix}": wrong}


def _of_unseen(cases: Sequence[SessionCase], weights: SessionWeights) -> dict[str, float]:
    """The same of the engine that never teaches; nothing where it has no case."""
    return score([(case, weights) for case in cases], f", {NEVER_LEARNT_FROM}") if cases else {}


def _answers(cases: Sequence[SessionCase], without: SessionWeights, weights: SessionWeights) -> pd.DataFrame:
    rows = []
    for case in cases:
        p = case.chances(weights)
        first = max(p, key=lambda name: p[name])
        rows.append(
            {
                "session": case.session,
                "clips": case.clips,
                "cause": case.cause,
                "answer": first,
                "its probability": p[first],
                "of the cause": p[case.cause],
                "without spread": case.chances(without)[case.cause],
                "misfit over usual": case.evidence.left,
            }
        )
    return pd.DataFrame(rows)


def _summary(answers: pd.DataFrame) -> str:
    named = (answers["its probability"] >= SessionSettings().named) & ~answers["answer"].isin([NONE, UNKNOWN])
    right = answers["answer"] == answers["cause"]
    nulls = answers["cause"] == NONE
    false = int((nulls & named & ~right).sum())
    losses = [-np.log(answers[c]).mean() for c in ("of the cause", "without spread")]
    return (
        f"{int((~nulls & right).sum())} of {int((~nulls).sum())} causes lead, "
        f"{int((~nulls & right & named).sum())} surely enough to be named; wrong names: {false} on "
        f"{int(nulls.sum())} without a cause, {int((~nulls & named & ~right).sum())} on the others; mean "
        f"negative log probability of the cause {losses[0]:.2f}, without `law_spread` {losses[1]:.2f}."
    )


if __name__ == "__main__":
    main()
