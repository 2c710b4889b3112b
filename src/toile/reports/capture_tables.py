"""Tables of the capture, after Tables 1 to 3 of Li et al. (3DV 2021): CSV, Markdown, LaTeX.

One line of the CSV is a row, domain and seed, before or after the final resolution. Markdown and LaTeX say
mean ± standard deviation over the seeds, with the paper's rows beside ours: other people, cameras, units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib.resources import files
from pathlib import Path

import pandas as pd

from toile.atomic_file import write_text
from toile.capture.metrics.out_of_balance import CONTACT_PROTOCOL, TOUCHING
from toile.capture.metrics.reconstruction import Measures
from toile.evaluation.penetration import BODY_PENETRATION_PROTOCOL, PENETRATION_PROTOCOL
from toile.evaluation.view_silhouettes import VIEWS_PROTOCOL

REQUIRED = (
    "out_of_balance_avg",
    "out_of_balance_max",
    "penetration_mean_mm",
    "penetration_max_mm",
    "iou_all",
    "iou_reference",
    "iou_single",
    "mpjpe_mm",
    "vertex_error_mm",
    "vertex_error_visible_mm",
)
"""Columns that come first; the others of Measures follow after ``before_resolution``."""
_KEYS = ("row", "domain", "seed")
_FORCES = ("out_of_balance_avg", "out_of_balance_max")
_DEPTHS = ("penetration_mean_mm", "penetration_max_mm", "penetration_share")
_OVERLAPS = ("iou_all", "iou_reference", "iou_single")
_ERRORS = (
    "mpjpe_mm",
    "vertex_error_mm",
    "vertex_error_visible_mm",
    "vertex_error_hidden_mm",
)
_TITLES = {
    "out_of_balance_avg": "average",
    "out_of_balance_max": "largest",
    "penetration_mean_mm": "mean [mm]",
    "penetration_max_mm": "largest [mm]",
    "penetration_share": "vertices [%]",
    "iou_all": "all views [%]",
    "iou_reference": "all but the input [%]",
    "iou_single": "input [%]",
    "mpjpe_mm": "MPJPE",
    "vertex_error_mm": "garment",
    "vertex_error_visible_mm": "visible",
    "vertex_error_hidden_mm": "hidden",
}
_PERCENT = (*_OVERLAPS, "penetration_share")
_NOTE = "other data"


@dataclass(frozen=True)
class Line:
    """One line of the CSV.

    Attributes:
        row: name of the way to reconstruct.
        domain: of the clips.
        seed: of the training.
        before_resolution: whether the final resolution is left out.
        measures: of all clips of the domain together.
    """

    row: str
    domain: str
    seed: int
    before_resolution: bool
    measures: Measures


def table_of(lines: Sequence[Line]) -> pd.DataFrame:
    """The lines as a table, columns as in the CSV; NaN where there is nothing to measure."""
    rows = [
        {"row": line.row, "domain": line.domain, "seed": line.seed, **asdict(line.measures)}
        | {"before_resolution": line.before_resolution}
        for line in lines
    ]
    others = [f.name for f in fields(Measures) if f.name not in REQUIRED]
    return pd.DataFrame(rows, columns=[*_KEYS, *REQUIRED, "before_resolution", *others])


def write_capture_tables(
    lines: Sequence[Line], output: Path, titles: Mapping[str, str], note: str
) -> list[Path]:
    """Write ``<output>.csv``, ``.md`` and ``.tex``.

    Args:
        lines: measured.
        output: path without suffix.
        titles: of the rows by their names, in their order.
        note: a sentence above the tables: how they were made.
    """
    table = table_of(lines)
    output.parent.mkdir(parents=True, exist_ok=True)
    written = []
    for suffix, text in (
        (".csv", table.to_csv(index=False, float_format="%.6g", lineterminator="\n")),
        (".md", _markdown(table, titles, note)),
        (".tex", _latex(table, titles)),
    ):
        path = output.with_name(output.name + suffix)
        write_text(path, text)
        written.append(path)
    return written


def read_published() -> pd.DataFrame:
    """The paper's rows: forces in its own unit, depths in mm, overlaps from 0 to 1."""
    with (files("toile.reports.published") / "capture.csv").open(encoding="utf-8") as file:
        table = pd.read_csv(file)
    table[list(_OVERLAPS)] /= 100
    return table


def claims(table: pd.DataFrame, domain: str) -> list[tuple[str, str, str]]:
    """What the method should do, against what it does: claim, what was measured, and the verdict.

    Args:
        table: see table_of.
        domain: name.
    """
    own = table[table.domain == domain]

    def mean(row: str, column: str, before: bool) -> float:
        chosen = own[(own.row == row) & (own.before_resolution == before)][column]
        return float(chosen.mean()) if len(chosen) else math.nan

    found = []
    for before in (True, False):
        when = "before" if before else "after"
        force, other = (mean(row, "out_of_balance_avg", before) for row in ("physics", "warm"))
        found.append(
            _claim(
                f"out-of-balance force of physics at most half of that of warm start, {when} the resolution",
                f"{_number(force)} against {_number(other)} weights",
                force - 0.5 * other,
            )
        )
        # The mean over all vertices: of those that penetrate alone it does not fall with their number.
        deep, start = (
            mean(row, "penetration_mean_mm", before) * mean(row, "penetration_share", before)
            for row in ("physics", "warm")
        )
        found.append(
            _claim(
                f"penetration of physics (mean over all vertices) at most a fifth of warm start's, {when} it",
                f"{_number(deep)} against {_number(start)} mm",
                deep - 0.2 * start,
            )
        )
    overlap, of_warm = (mean(row, "iou_all", False) for row in ("physics", "warm"))
    found.append(
        _claim(
            "overlap of physics within 2 points of that of warm start",
            f"{_number(100 * overlap)} against {_number(100 * of_warm)} %",
            of_warm - overlap - 0.02,
        )
    )
    for row, column, words in (
        ("warm", "vertex_error_mm", "than warm start"),
        ("skinning", "vertex_error_mm", "than skinning"),
        ("simulation", "vertex_error_visible_mm", "on visible vertices than pure simulation"),
    ):
        ours, theirs = mean("physics", column, False), mean(row, column, False)
        found.append(
            _claim(
                f"garment of physics nearer to the truth {words}",
                f"{_number(ours)} against {_number(theirs)} mm",
                ours - theirs,
            )
        )
    return found


def _claim(words: str, measured: str, excess: float) -> tuple[str, str, str]:
    return words, measured, "not measured" if math.isnan(excess) else "holds" if excess <= 0 else "fails"


def _markdown(table: pd.DataFrame, titles: Mapping[str, str], note: str) -> str:
    parts = [
        "# One camera: body and garment",
        "",
        f"{note} Mean ± standard deviation over {_seeds(table)}. Rows of the paper are of {_NOTE}: other "
        "people, garments, cameras, and a unit of force that it does not state.",
    ]
    published = read_published()
    for domain in dict.fromkeys(table.domain):
        own = table[table.domain == domain]
        parts += ["", f"## {domain}", "", "| claim | measured | |", "|---|---|---|"]
        parts += [f"| {' | '.join(line)} |" for line in claims(table, domain)]
        for heading, columns, beside in (
            ("Out-of-balance force [weights of a vertex]", _FORCES, True),
            ("Penetration of the garment's vertices", _DEPTHS, True),
            ("Overlap with the masks", _OVERLAPS, False),
            ("Errors [mm]", _ERRORS, False),
        ):
            parts += ["", f"**{heading}**", "", *_block(own, titles, columns, published, before=beside)]
    parts += ["", "How it was measured: " + "; ".join(_protocols()) + "."]
    return "\n".join(parts) + "\n"


def _protocols() -> tuple[str, ...]:
    return (
        CONTACT_PROTOCOL.format(distance=1e3 * TOUCHING),
        PENETRATION_PROTOCOL,
        BODY_PENETRATION_PROTOCOL,
        VIEWS_PROTOCOL,
        "errors: mean distance of 3D landmarks (MPJPE) and of the garment's vertices, visible ones being "
        "those that the input view shows in truth; with the translation as it was found / the true one",
    )


def _block(
    own: pd.DataFrame,
    titles: Mapping[str, str],
    columns: Sequence[str],
    published: pd.DataFrame,
    *,
    before: bool,
) -> list[str]:
    """A table; two numbers in a cell are before / after the resolution, or found / true translation."""
    split = "before / after the resolution" if before else "translation found / true"
    lines = [
        f"| row ({split}) | " + " | ".join(_TITLES[c] for c in columns) + " |",
        "|---|" + "---|" * len(columns),
    ]
    for row in [name for name in titles if name in set(own.row)]:
        cells = []
        for column in columns:
            chosen = own[own.row == row]
            after = chosen[~chosen.before_resolution]
            if before:
                pair = (chosen[chosen.before_resolution][column], after[column])
            else:
                pair = (after[column], after[_true(column)])
            cells.append(" / ".join(_spread(values, column) for values in pair))
        lines.append(f"| {titles[row]} | " + " | ".join(cells) + " |")
    for entry in published.to_dict("records"):
        known = [entry.get(c) for c in columns]
        if any(_exists(v) for v in known):
            cells = [_in_unit(c, v) if _exists(v) else "–" for c, v in zip(columns, known, strict=True)]
            lines.append(f"| *{entry['method']}, {_NOTE}* | " + " | ".join(cells) + " |")
    return lines


def _latex(table: pd.DataFrame, titles: Mapping[str, str]) -> str:
    columns = (*_FORCES, *_DEPTHS[:1], *_OVERLAPS, *_ERRORS)
    heads = ("force avg", "force max", "pen.", "AMV", "RV", "SV", "MPJPE", "garment", "visible", "hidden")
    lines = []
    for domain in dict.fromkeys(table.domain):
        own = table[(table.domain == domain) & ~table.before_resolution]
        lines += [
            f"% {domain}, after the final resolution",
            r"\begin{tabular}{l" + "r" * len(columns) + "}",
            r"\toprule",
            " & ".join(("row", *heads)) + r" \\",
            r"\midrule",
        ]
        for row in [name for name in titles if name in set(own.row)]:
            cells = [_spread(own[own.row == row][c], c).replace("±", r"$\pm$") for c in columns]
            lines.append(" & ".join((titles[row].replace("%", r"\%"), *cells)) + r" \\")
        lines.append(r"\midrule")
        for entry in read_published().to_dict("records"):
            known = [entry.get(c) for c in columns]
            cells = [_in_unit(c, v) if _exists(v) else "--" for c, v in zip(columns, known, strict=True)]
            lines.append(" & ".join((f"{entry['method']} ({_NOTE})", *cells)) + r" \\")
        lines += [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def _true(column: str) -> str:
    stem, unit = (column.removesuffix("_mm"), "_mm") if column.endswith("_mm") else (column, "")
    return f"{stem}_true_translation{unit}"


def _exists(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _in_unit(column: str, value: float) -> str:
    return _number(100 * value if column in _PERCENT else value)


def _spread(values: pd.Series, column: str) -> str:
    known = values.dropna() * (100 if column in _PERCENT else 1)
    if not len(known):
        return "–"
    deviation = f" ± {_number(float(known.std()))}" if len(known) > 1 else ""
    return _number(float(known.mean())) + deviation


def _number(value: float) -> str:
    """Three digits, without an exponent."""
    if not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    digits = 2 - math.floor(math.log10(abs(value)))
    return f"{round(value, digits):.{max(0, min(digits, 4))}f}"


def _seeds(table: pd.DataFrame) -> str:
    counts = table[~table.before_resolution].groupby(["row", "domain"]).seed.nunique()
    low, high = int(counts.min()), int(counts.max())
    return f"{low} seed{'s' if low > 1 else ''}" if low == high else f"{low} to {high} seeds"
