"""The documents of a graded blind check: ``docs/results/blind_standard.md``, its tables as CSV, its figure.

    make blind-results
    python benchmarks/blind_results.py standard4 --stem blind_standard_before    # another set, beside it

Reads what ``toile blind grade`` has written, the answers and the files of the scenes: no key, no sealed
label.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import numpy as np
import pandas as pd
from bench_diagnosis import text as times_text
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from toile.atomic_file import write_text, written_atomically
from toile.blind.leak import file_statistics, leaks, power
from toile.blind.measures import measured
from toile.blind.run import Predictions
from toile.blind.sealing import BlindSet
from toile.blind.tables import LEVELS
from toile.diagnosis.stage_times import TIMES_FILE, read_times
from toile.effects.catalogue import MOVING, STAGES
from toile.errors import InputError

ARMS = {
    "shrink_true": ("true effect", "o", "#0b6fb8"),
    "shrink_runner_up": ("runner-up: best wrong candidate", "s", "#d9822b"),
    "shrink_placebo": ("best placebo", "^", "#777777"),
}
"""Title, marker and colour by column of the marks."""

# Beyond this the figure shows an arrow: a bad refit can be many times worse than the base model.
_EDGE = 100.0


def read_table(path: Path) -> pd.DataFrame:
    """A table of the grade; "null" and "none" are words in it."""
    try:
        return pd.read_csv(path, keep_default_na=False, na_values=[""])
    except pd.errors.EmptyDataError:
        return pd.DataFrame()
    except OSError as error:
        raise InputError(
            "No grade", where=str(path), expected="the tables of toile blind grade", got=str(error)
        ) from error


def number(value: float, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "–" if pd.isna(value) else f"{value:.{digits}f}"


def with_interval(row: Mapping[str, float]) -> str:
    """Value with its interval."""
    if pd.isna(row["value"]):
        return "–"
    return f"{row['value']:.2f} [{row['low']:.2f}, {row['high']:.2f}]"


def shown(table: pd.DataFrame) -> str:
    """Markdown with empty cells where nothing is known."""
    cells = table.astype(object).where(table.notna(), "")
    return str(cells.to_markdown(index=False, disable_numparse=True))


def measures_table(measures: pd.DataFrame) -> pd.DataFrame:
    """Measure, aim, what was measured, whether that is enough, the baseline."""
    return pd.DataFrame(
        {
            "measure": measures["measure"],
            "aim": measures["aim"],
            "measured [95 % interval]": [with_interval(row) for _, row in measures.iterrows()],
            "reached": measures["reached"],
            "naive baseline": [number(v) for v in measures["naive"]],
            "scenes": measures["scenes"],
        }
    )


def generators_table(generators: pd.DataFrame) -> pd.DataFrame:
    """Measures side by side, one column per generator."""
    table: dict[str, list[str]] = {}
    for generator, rows in generators.groupby("generator", sort=True):
        table["measure"], table["aim"] = list(rows["measure"]), list(rows["aim"])
        cells = [f"{with_interval(row)}, {row['scenes']} scenes" for _, row in rows.iterrows()]
        table[str(generator)] = [cell if not cell.startswith("–") else "–" for cell in cells]
        if rows["naive"].notna().any():
            table[f"{generator}, naive"] = [number(v) for v in rows["naive"]]
    return pd.DataFrame(table)


def effects_table(effects: pd.DataFrame) -> pd.DataFrame:
    """Per effect, with counts per level."""
    found = [f"{f}/{n}" for f, n in zip(effects["found"], effects["scenes"], strict=True)]
    table = {
        "effect": [f"`{name}`" for name in effects["effect"]],
        "top-1": found,
        "rate": [number(v) for v in effects["rate"]],
        **{level: effects[level] for level in LEVELS},
        "in the 90 % set": effects["in_set"],
        "identifiable": effects["identifiable"],
        "naive top-1": effects["naive"],
    }
    return pd.DataFrame(table)


def limits_table(limits: pd.DataFrame, effects: pd.DataFrame, detection: pd.DataFrame) -> pd.DataFrame:
    """Limits that the diagnosis names beside the smallest level and size at which it found an effect."""
    found = effects.set_index("effect") if len(effects) else pd.DataFrame()
    sizes = detection.set_index("effect") if len(detection) else pd.DataFrame()
    named = limits.set_index("effect") if len(limits) else pd.DataFrame()
    rows = []
    for name in STAGES:
        if name not in found.index and name not in named.index:
            continue
        row = {
            "effect": f"`{name}`",
            "predicted limit (median)": "–",
            "range": "–",
            "clips with a limit": "–",
        }
        if name in named.index:
            at = named.loc[name]
            if at["with_limit"] > 0:
                unit = "" if str(at["unit"]) == "1" else f" {at['unit']}"
                row["predicted limit (median)"] = f"{at['parameter']} {at['median']:.3g}{unit}"
                row["range"] = f"{at['smallest']:.3g} – {at['largest']:.3g}"
            row["clips with a limit"] = f"{at['with_limit']} of {at['clips']}"
        in_set = name in found.index
        level = found.loc[name, "smallest_level"] if in_set else math.nan
        row["smallest level found"] = "–" if not in_set else "not found" if pd.isna(level) else str(level)
        for column, title in (
            ("smallest_found", "smallest size found"),
            ("largest_missed", "largest missed"),
        ):
            row[title] = number(sizes.loc[name, column]) if name in sizes.index else "–"
        rows.append(row)
    return pd.DataFrame(rows)


def scenes_table(marks: pd.DataFrame) -> pd.DataFrame:
    """One row per scene, by truth."""
    ordered = marks.sort_values(["kind", "truth", "generator", "scene"])
    columns = {
        "scene": "scene",
        "generator": "generator",
        "kind": "kind",
        "truth": "truth",
        "level": "level",
        "answer": "answer",
        "also": "also",
        "candidates": "candidates",
        "probability": "probability",
        "naive": "naive baseline",
    }
    there = [c for c in columns if c in ordered.columns]
    table = ordered[there].rename(columns=columns)
    if "probability" in table:
        table["probability"] = [number(v) for v in table["probability"]]
    return table


def moving_singles(marks: pd.DataFrame) -> pd.DataFrame:
    """Answered scenes of one effect that moves the cloth, by effect and then by size."""
    singles = marks[(marks["kind"] == "single") & (marks["answer"] != "no diagnosis")]
    moving = singles[[STAGES.get(truth) in MOVING for truth in singles["truth"]]].copy()
    for column in ARMS:
        if column not in moving:
            moving[column] = math.nan
    moving["order"] = [LEVELS.index(level) if level in LEVELS else -1 for level in moving["level"]]
    return moving.sort_values(["truth", "order", "generator", "scene"]).drop(columns="order")


def shrink_medians(moving: pd.DataFrame) -> pd.DataFrame:
    """Medians over the scenes in which the true effect was compared, and over all that have a number."""
    known = moving[moving["shrink_true"].notna()]
    rows = []
    for title, part in (("true effect compared", known), ("all", moving)):
        row: dict[str, object] = {"scenes": title, "number": len(part)}
        for column, (arm, _, _) in ARMS.items():
            values = part[column].dropna().astype(float)
            row[arm] = f"{100 * values.median():.1f} % ({len(values)})" if len(values) else "–"
        rows.append(row)
    return pd.DataFrame(rows)


def shrink_table(moving: pd.DataFrame) -> pd.DataFrame:
    """One row per scene."""
    table = {
        "scene": moving["scene"],
        "generator": moving["generator"],
        "effect": [f"`{name}`" for name in moving["truth"]],
        "level": moving["level"],
        "answer": moving["answer"],
    }
    for column, (arm, _, _) in ARMS.items():
        table[f"{arm} [%]"] = [number(100 * float(v), 1) for v in moving[column]]
    if "runner_up" in moving:
        table["which runner-up"] = moving["runner_up"]
    return pd.DataFrame(table)


def shrink_figure(moving: pd.DataFrame, path: Path) -> Path:
    """True effect, runner-up and best placebo in every scene, and their medians; (n, 3) dots."""
    n = len(moving)
    figure = Figure(figsize=(7.5, 1.6 + 0.21 * (n + 2)), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    labels = [
        f"{row['truth']}, {row['level']}" + (" (Blender)" if row["generator"] == "blender" else "")
        for _, row in moving.iterrows()
    ]
    previous = None
    for k, truth in enumerate(moving["truth"]):
        if truth != previous and previous is not None:
            axes.axhline(k - 0.5, color="#dddddd", lw=0.8, zorder=0)
        previous = truth
    compared = moving["shrink_true"].notna().to_numpy()
    for place, there in enumerate(compared):
        if not there:
            axes.text(
                0.995,
                place,
                "true effect not compared",
                fontsize=6,
                color="#0b6fb8",
                ha="right",
                va="center",
                transform=axes.get_yaxis_transform(),
            )
    for column, (title, marker, colour) in ARMS.items():
        values = 100 * moving[column].astype(float).to_numpy()
        clipped = np.clip(values, -_EDGE, _EDGE)
        face = colour if column == "shrink_true" else "none"
        axes.scatter(
            clipped,
            np.arange(n),
            s=24,
            marker=marker,
            label=title,
            zorder=3,
            facecolors=face,
            edgecolors=colour,
        )
        for at in np.flatnonzero(values < -_EDGE).tolist():
            _note_at_edge(axes, values[at], at, colour)
        known = values[compared][~np.isnan(values[compared])]
        if len(known):
            median = float(np.clip(np.median(known), -_EDGE, _EDGE))
            if np.median(known) < -_EDGE:
                _note_at_edge(axes, float(np.median(known)), n + 0.5, colour)
            axes.scatter(median, n + 0.5, s=60, marker=marker, zorder=3, facecolors=face, edgecolors=colour)
            axes.axvline(median, color=colour, lw=0.8, ls=":", zorder=1)
    axes.axvline(0, color="black", lw=0.8, zorder=1)
    axes.axhline(n - 0.25, color="black", lw=0.8)
    axes.set_yticks([*range(n), n + 0.5], [*labels, "median"], fontsize=7)
    axes.set_ylim(n + 1.1, -0.7)
    axes.set_xlim(-_EDGE * 1.12, _EDGE * 1.05)
    axes.set_xlabel("held-out error saved [%]")
    axes.legend(loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=3, fontsize=8, frameon=False)
    with written_atomically(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})
    return path


def _note_at_edge(axes: Axes, value: float, row: float, colour: str) -> None:
    """Say what lies beyond the left edge."""
    axes.annotate(
        f"{value:.0f}",
        (-_EDGE, row),
        (-4, 0),
        textcoords="offset points",
        fontsize=6,
        color=colour,
        ha="right",
        va="center",
        annotation_clip=False,
    )


def shrink_caption(moving: pd.DataFrame) -> str:
    """What the figure shows, with the number of scenes in which something is missing."""
    missing = int(moving["shrink_true"].isna().sum())
    return (
        f"Held-out error saved (of the base model's) in the {len(moving)} scenes of one effect that moves "
        "the cloth, one row each. Runner-up: the wrong candidate that saves most. Medians, and dotted lines, "
        f"are over the {len(moving) - missing} scenes in which the true effect was among the compared ones; "
        f"in the other {missing} it was not, and its dot is missing. What is worse than -{_EDGE:.0f} % "
        "stands at the left edge."
    )


def gathered_times(blind: BlindSet, predictions: Predictions) -> pd.DataFrame:
    """Times of all scenes that have some, one row per scene and stage."""
    rows = []
    for name in blind.names():
        path = predictions.diagnosis(name).with_name(TIMES_FILE)
        if not path.is_file() or not predictions.diagnosis(name).is_file():
            continue
        scene = json.loads((blind.scenes / name / "scene.json").read_text())
        grid = "×".join(map(str, scene["grid"]))
        for stage, taken in read_times(path).items():
            rows.append(
                {
                    "scene": name,
                    "size": f"{scene['n_frames']} frames, {grid} vertices",
                    "stage": stage,
                    "wall": taken.wall,
                    "cpu": taken.cpu,
                    "cached": taken.cached,
                }
            )
    return pd.DataFrame(rows, columns=["scene", "size", "stage", "wall", "cpu", "cached"])


def leak_tables(blind: BlindSet, marks: pd.DataFrame, permutations: int, draws: int) -> str:
    """The leak test and its power as Markdown; labels come from the marks, the rest from the files."""
    truth = pd.DataFrame(
        {"generator": marks["generator"], "effect": marks["truth"], "stage": marks["true_stage"]}
    )
    statistics = pd.DataFrame([file_statistics(blind.scenes / name) for name in marks["scene"]])
    found = leaks(statistics, truth, permutations=permutations)
    controls = power(statistics, truth, draws=draws)
    parts = []
    if len(found):
        table = pd.DataFrame(
            {
                "generator": found["generator"],
                "question": found["question"],
                "accuracy": [number(v) for v in found["accuracy"]],
                "95 % of permuted labels": [
                    f"{low:.2f} – {high:.2f}"
                    for low, high in zip(found["chance_low"], found["chance_high"], strict=True)
                ],
                "p": [number(v, 3) for v in found["p_value"]],
                "scenes": found["scenes"],
            }
        )
        parts.append(shown(table))
    if len(controls):
        table = pd.DataFrame(
            {
                "generator": controls["generator"],
                "planted": controls["planted"],
                "found at p < 0.05": [f"{100 * v:.0f} %" for v in controls["found"]],
                "mean accuracy": [number(v) for v in controls["accuracy"]],
                "scenes": controls["scenes"],
                "draws": controls["draws"],
            }
        )
        parts.append(
            "Power: labels (effect or none) are shuffled, then a leak is planted in what the files of the "
            "scenes called effects say.\n\n" + shown(table)
        )
    return "\n\n".join(parts) or "Too few scenes for a leak test."


def magnitudes_table(marks: pd.DataFrame) -> pd.DataFrame:
    """True numbers beside the estimates, where both sides have the same ones."""
    if "magnitude" not in marks:
        return pd.DataFrame()
    known = marks[marks["magnitude"].notna()].sort_values(["truth", "generator", "scene"])
    return pd.DataFrame(
        {
            "scene": known["scene"],
            "generator": known["generator"],
            "effect": [f"`{name}`" for name in known["truth"]],
            "found": ["yes" if right in (True, 1) else "no" for right in known["top1"]],
            "truth, estimate [90 % interval]": known["magnitude"],
            "error": [f"{100 * float(v):.0f} %" for v in known["magnitude_error"]],
        }
    )


def document(
    stem: str, blind: BlindSet, predictions: Predictions, marks: pd.DataFrame, leak: str, times: pd.DataFrame
) -> str:
    """The whole page."""
    name = blind.read_description()["composition"]
    folder = predictions.grade
    graded = json.loads((folder / "graded.json").read_text())
    measures = read_table(folder / "measures.csv")
    effects, limits = read_table(folder / "effects.csv"), read_table(folder / "limits.csv")
    moving = moving_singles(marks)
    kinds = ", ".join(f"{n} {kind}" for kind, n in marks["kind"].value_counts().items())
    makers = ", ".join(f"{n} by {maker}" for maker, n in marks["generator"].value_counts().items())
    unanswered = marks["answer"] == "no diagnosis"
    secret = "drawn at random" if graded["blind"] else "made from a seed, so nothing here was blind"
    head = [
        f"# Blind check of the diagnosis: {name} set",
        "Made by `benchmarks/blind_results.py` (`make blind-results`), from what "
        "`toile blind make`, `run` and `grade` left. "
        f"{len(marks)} scenes ({kinds}; {makers}). The key was {secret}. Predictions sha256 "
        f"`{graded['predictions']}`, hashed before any label was opened.",
    ]
    # How the set differs from what its composition asks for: scenes left out, another generator.
    head += [f"{note[0].upper()}{note[1:]}." for note in blind.read_description().get("notes", [])]
    if unanswered.any():
        head.append(
            f"**{int(unanswered.sum())} of {len(marks)} scenes have no diagnosis and count as wrong.**"
        )
    sections = [
        (
            "Measures",
            "Intervals resample scenes (Wilson's where all or none are right). The naive baseline names the "
            "candidate with the largest drop of the training loss. Whether a single is identifiable is "
            "judged by the diagnosis' own alias matrix (traces at least 0.9 parallel are one class), so the "
            "rows on identifiable scenes lean on it.\n\n" + shown(measures_table(measures)),
        )
    ]
    if unanswered.any():
        only = measured(marks[~unanswered], resamplings=500, seed=0)
        sections.append(("Measures over the scenes that were diagnosed", shown(measures_table(only))))
    against = read_table(folder / "over_naive.csv")
    if len(against):
        against = against.assign(
            difference=[
                f"{row['difference']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}]"
                for _, row in against.iterrows()
            ],
            diagnosis=[number(v) for v in against["diagnosis"]],
            naive=[number(v) for v in against["naive"]],
        ).drop(columns=["low", "high"])
        sections.append(("Right answers, against the baseline", shown(against)))
    sections += [
        ("By generator", shown(generators_table(read_table(folder / "generators.csv")))),
        (
            "Single effects",
            "Right answers over scenes, by level. `ambiguous` is no right answer here, even if the truth is "
            "among the candidates.\n\n" + shown(effects_table(effects)),
        ),
        (
            "Confusion matrix",
            "Rows: truth. Columns: answer. Pairs are left out.\n\n"
            + shown(_without_zeros(read_table(folder / "confusion.csv"))),
        ),
        (
            "Detection limits",
            "Predicted: smallest strength that the alias analysis of a clip calls detectable, in the unit of "
            "the effect's first parameter, median and range over all clips that have one. Found: level and "
            "size of the weakest scene with the right answer, sizes in % (of the cloth's width for what "
            "moves it or its image).\n\n"
            + shown(limits_table(limits, effects, read_table(folder / "detection.csv"))),
        ),
        (
            "Magnitudes",
            "Only numbers that mean the same in generator and catalogue: "
            "`toile/blind/magnitudes.py` says which. Errors of several numbers are added up in "
            "prior deviations.\n\n" + shown(magnitudes_table(marks)),
        ),
        (
            "Shrink of the held-out error",
            f"![Shrink of the held-out error](../images/{stem}_shrink.png)\n\n{shrink_caption(moving)}\n\n"
            + shown(shrink_medians(moving))
            + "\n\n"
            + shown(shrink_table(moving)),
        ),
        (
            "Leak test",
            "A linear classifier on statistics of whole files, cross-validated; balanced accuracy. Each "
            f"generator for itself: who made a scene shows, and Blender makes no pairs.\n\n{leak}",
        ),
        ("Run times", times_text(times) if len(times) else "No diagnosis of this set has written its times."),
        ("Scenes", shown(scenes_table(marks))),
    ]
    return "\n\n".join([*head, *(f"## {title}\n\n{body}" for title, body in sections)]) + "\n"


def _without_zeros(table: pd.DataFrame) -> pd.DataFrame:
    return table.astype(object).where(table != 0, "")


def put_section(text: str, title: str, body: str) -> str:
    """Text with its ``## title`` section replaced, or put where the order of titles has it."""
    section = f"## {title}\n\n{body.strip()}\n\n"
    found = re.search(rf"^## {re.escape(title)}\n.*?(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    if found:
        return (text[: found.start()] + section + text[found.end() :]).rstrip() + "\n"
    later = [m.start() for m in re.finditer(r"^## (.+)$", text, re.MULTILINE) if m.group(1) > title]
    at = later[0] if later else len(text)
    before = text[:at] if later else text.rstrip() + "\n\n"
    return (before + section + text[at:]).rstrip() + "\n"


def put_between(text: str, marker: str, body: str) -> str:
    """Text with what stands between two markers replaced; unchanged without them."""
    start, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    if start not in text or end not in text:
        return text
    before, _, rest = text.partition(start)
    return f"{before}{start}\n{body.strip()}\n{end}{rest.partition(end)[2]}"


def write_results(
    blind: BlindSet,
    predictions: Predictions,
    docs: Path,
    *,
    stem: str | None = None,
    permutations: int = 1000,
    draws: int = 30,
) -> list[Path]:
    """Write everything; returns the paths.

    Args:
        blind: the set.
        predictions: answers and grade.
        docs: ``results`` and ``images`` are below it.
        stem: of the files; ``blind_`` and the composition unless given. With another one nothing else is
            touched: the summary on the page of the diagnosis and the run times are those of one set.
        permutations: of the labels in the leak test.
        draws: in the measurement of its power.

    Raises:
        InputError: there is no grade, or it is that of other predictions.
    """
    try:
        graded = json.loads((predictions.grade / "graded.json").read_text())
    except OSError as error:
        raise InputError(
            "No grade", where=str(predictions.grade), expected="toile blind grade before", got=str(error)
        ) from error
    digest = predictions.hash.read_text().strip()
    if graded["predictions"] != digest:
        raise InputError(
            "The grade is that of other predictions",
            where=str(predictions.grade),
            expected=digest,
            got=str(graded["predictions"]),
        )
    usual = f"blind_{blind.read_description()['composition']}"
    stem = usual if stem is None else stem
    marks = read_table(predictions.grade / "scenes.csv")
    times = gathered_times(blind, predictions)
    leak = leak_tables(blind, marks, permutations, draws)
    results = docs / "results"
    everything = read_table(predictions.grade / "measures.csv")
    everything.insert(0, "generator", "all")
    measures = pd.concat((everything, read_table(predictions.grade / "generators.csv")))
    paths = [
        write_text(results / f"{stem}.csv", measures.to_csv(index=False, float_format="%.6g")),
        write_text(results / f"{stem}_scenes.csv", marks.to_csv(index=False, float_format="%.6g")),
        shrink_figure(moving_singles(marks), docs / "images" / f"{stem}_shrink.png"),
    ]
    if len(times):
        paths.append(
            write_text(results / f"{stem}_times.csv", times.to_csv(index=False, float_format="%.4g"))
        )
        benchmarks = results / "benchmarks.md"
        if stem == usual and benchmarks.is_file():
            changed = put_section(benchmarks.read_text(), "bench_diagnosis", times_text(times))
            paths.append(write_text(benchmarks, changed))
    paths.append(write_text(results / f"{stem}.md", document(stem, blind, predictions, marks, leak, times)))
    page = docs / "diagnosis" / "validation.md"
    if stem == usual and page.is_file():
        summary = shown(measures_table(everything.drop(columns="generator")))
        summary += f"\n\nAll tables: [results/{stem}.md](../results/{stem}.md).\n\n"
        summary += f"![Shrink of the held-out error](../images/{stem}_shrink.png)\n\n"
        summary += shrink_caption(moving_singles(marks))
        text = page.read_text()
        changed = put_between(text, "blind", summary)
        if changed != text:
            paths.append(write_text(page, changed))
    return paths


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", nargs="?", default="standard", help="of the set")
    parser.add_argument("--outputs", type=Path, default=Path("outputs"))
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("--stem", help="of the files, in place of blind_ and the composition")
    parser.add_argument("--permutations", type=int, default=1000)
    parser.add_argument("--draws", type=int, default=30)
    given = parser.parse_args()
    blind = BlindSet(given.outputs / "blind" / given.name)
    predictions = Predictions(given.outputs / "blind_predictions" / given.name)
    for path in write_results(
        blind,
        predictions,
        given.docs,
        stem=given.stem,
        permutations=given.permutations,
        draws=given.draws,
    ):
        print(path)


if __name__ == "__main__":
    main()
