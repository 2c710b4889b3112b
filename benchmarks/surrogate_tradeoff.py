"""Where the neural surrogate is worth it: error over time beside Newton's method, on one thread.

    python benchmarks/surrogate_tradeoff.py                          # docs/results/surrogate_tradeoff.md
    python benchmarks/surrogate_tradeoff.py --quick                  # a minute, tiny, into outputs/

Every part is written to docs/results/surrogate/ and not measured again with the same weights and settings.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

# Sets the number of BLAS threads before NumPy is loaded.
import toile.cli  # noqa: F401

# isort: split
import os

import matplotlib as mpl
import pandas as pd
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from surrogate import tables
from surrogate.contenders import SOLVER
from surrogate.figures import save
from surrogate.records import Records, fingerprint
from surrogate.tradeoff import (
    COMPILED,
    COMPILING,
    ERRORS,
    LOW,
    SURROGATE,
    TIME,
    WITH_NETWORK,
    TradeoffSettings,
    errors,
    tradeoff,
)

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.physics.surrogate.surrogate import STEP
from toile.physics.surrogate.weights import describe_weights, load_weights, packaged_weights
from toile.reports.figures import STYLE
from toile.reports.palette import INK, SERIES

ROOT = Path(__file__).resolve().parent.parent
QUICK = TradeoffSettings((8,), (1, 2), (1, 2), (2,), (1, 2), rounds=1, steps=1)
# Errors at which it is asked who gets there first [% of width].
LEVELS = {
    ERRORS[0]: (0.1, 0.03, 0.01, 0.001),
    ERRORS[1]: (1.0, 0.3, 0.1, 0.03),
    ERRORS[2]: (3.0, 1.0, 0.3, 0.1),
}
PICTURE = Path("images") / "surrogate" / "tradeoff.png"
PART_TIMES, PART_ERRORS = "tradeoff_times", "tradeoff_errors"


def measured(records: Records, weights: Path, settings: TradeoffSettings) -> tuple[pd.DataFrame, str]:
    """Times and errors in one table, and how they were made."""
    about = {"weights": weights.name, "sha256": fingerprint(weights), "step": STEP, **asdict(settings)}
    # How long a pass takes hangs on the network's size alone.
    widths = list(load_weights(weights).network.widths)
    size_of = {"widths": widths, "step": STEP, **asdict(settings)}

    def times() -> pd.DataFrame:
        parts = [tradeoff(weights, size, n, settings) for size in settings.sizes for n in settings.batches]
        return pd.concat(parts, ignore_index=True)

    def all_errors() -> pd.DataFrame:
        return pd.concat([errors(weights, size, settings) for size in settings.sizes], ignore_index=True)

    records.measure(PART_TIMES, size_of, times)
    records.measure(PART_ERRORS, about, all_errors)
    found = [records.read(part) for part in (PART_TIMES, PART_ERRORS)]
    first, second = (record for record in found if record is not None)
    table = first.table.merge(second.table, on=["size", "family", "knob"], how="left")
    made = (
        f"`make surrogate-tradeoff` on {first.about['machine']}, {first.about['threads']} thread, torch "
        f"{first.about['torch']}: times in {first.about['seconds']:.0f} s from {first.about['date']}, load "
        f"{first.about['load before']} before, then errors in {second.about['seconds']:.0f} s from "
        f"{second.about['date']}; {weights.name}, sha256 "
        f"{about['sha256']}…"
    )
    return table, made


def winners(table: pd.DataFrame) -> str:
    """Who reaches an error in the least time, with and without the network."""
    rows = []
    for (size, batch), part in table.groupby(["size", "batch"], sort=True):
        for error, levels in LEVELS.items():
            for level in levels:
                row = {"grid": f"{size}×{size}", "batch": batch, "error": _short(error), "at most [%]": level}
                network = _fastest(part[part.family.isin(WITH_NETWORK)], error, level)
                without = _fastest(part[~part.family.isin(WITH_NETWORK)], error, level)
                row["with the network"] = _named(network)
                row["without"] = _named(without)
                if network is None:
                    row["the network is faster by"] = "never gets there"
                else:
                    row["the network is faster by"] = f"×{without[TIME] / network[TIME]:.2f}"
                rows.append(row)
    return tables.frame(pd.DataFrame(rows))


def low_precision(table: pd.DataFrame) -> str:
    """Speed and error of bfloat16 and of compiled blocks, beside the network as it is."""
    rows = []
    for (size, batch, passes), part in table[table.family.isin((SURROGATE, LOW, COMPILED))].groupby(
        ["size", "batch", "knob"], sort=True
    ):
        by = part.set_index("family")
        if LOW not in by.index:
            continue
        plain = by.loc[SURROGATE]
        row = {
            "grid": f"{size}×{size}",
            "batch": batch,
            "passes": passes,
            "as it is [ms]": tables.number(plain[TIME]),
        }
        for family, name in ((LOW, "bfloat16"), (COMPILED, "compiled")):
            its = by.loc[family]
            row[f"{name} [ms]"] = f"{tables.number(its[TIME])} (×{plain[TIME] / its[TIME]:.2f})"
        row["bfloat16: error after 50 steps [%]"] = tables.number(by.loc[LOW][ERRORS[2]])
        row["as it is: error after 50 steps [%]"] = tables.number(plain[ERRORS[2]])
        row["compiling [s]"] = tables.number(by.loc[COMPILED][COMPILING] or float("nan"))
        rows.append(row)
    return tables.frame(pd.DataFrame(rows))


def everything(table: pd.DataFrame) -> str:
    """All that was measured; times of all batches in one row."""
    rows = []
    for (size, family, knob), part in table.groupby(["size", "family", "knob"], sort=False):
        row = {
            "grid": f"{size}×{size}",
            "": family,
            "passes, sweeps or iterations": knob or "until converged",
        }
        row |= {_short(e): tables.number(float(part[e].iloc[0])) for e in ERRORS}
        for its in part.to_dict("records"):
            row[f"batch {its['batch']} [ms]"] = f"{its[TIME]:.3g} ± {its['spread [ms]']:.1g}"
        rows.append(row)
    return tables.frame(pd.DataFrame(rows))


def curves(table: pd.DataFrame) -> Figure:
    """Error after 50 steps over time, one panel per size and batch."""
    sizes, batches = sorted(table["size"].unique()), sorted(table.batch.unique())
    families = [f for f in dict.fromkeys(table.family) if f not in (SOLVER, COMPILED)]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.4 * len(batches), 2.8 * len(sizes) + 0.6), layout="constrained")
        axes = figure.subplots(len(sizes), len(batches), sharey=True, squeeze=False)
        for i, size in enumerate(sizes):
            for j, batch in enumerate(batches):
                axis, part = axes[i][j], table[(table["size"] == size) & (table.batch == batch)]
                for colour, family in zip((*SERIES, INK), families, strict=False):
                    its = part[part.family == family].sort_values("knob")
                    axis.plot(its[TIME], its[ERRORS[2]], marker="o", markersize=3, color=colour, label=family)
                axis.axvline(
                    float(part[part.family == SOLVER][TIME].iloc[0]), color=INK, linewidth=0.8, label=SOLVER
                )
                axis.set(xscale="log", yscale="log", title=f"{size}×{size}, batch of {batch}")
                axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axis.xaxis.set_major_formatter("{x:g}")
                axis.xaxis.set_minor_formatter(NullFormatter())
                axis.set_xlabel(TIME)
            axes[i][0].set_ylabel(ERRORS[2])
        handles, labels = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=7)
    return figure


def page(table: pd.DataFrame, made: str) -> str:
    """The Markdown page."""
    return f"""# Surrogate beside Newton's method: error over time

{made}. Processor time; other programs shared the machine, so that ratios mean more than times.

Six cloths as fits of videos have them (regime *fits* of the [model card](../surrogate.md)), BDF2, 0.01 s;
the reference is Newton's method converged to 10⁻⁶ of a vertex's weight, which is also *solver* below. Errors
are mean distances of the vertices, median of the cloths: of one step, from every tenth state of the solver's
motion (mean of these states); and after 10 and 50 steps from rest. Times are per cloth and step, without
derivatives, of cloths in motion. Newton's method starts from its extrapolation and takes the cloths of a
batch one after the other; *stopped* ends after so many iterations. *Line sweeps* are the surrogate's step
with all that is in it but the network.

![Error after 50 steps over time](../{PICTURE.as_posix()})

## Who gets there first

The fastest setting that keeps an error; *solver* keeps all.

{winners(table)}

## bfloat16 and torch.compile

Convolutions under autocast; residual blocks compiled by `torch.compile`, whose first step takes as long as
the last column says; their answers are those of the others to rounding. Compiled whole, the network is cut
into pieces at every kernel that is not torch's.

{low_precision(table)}

## Everything

{everything(table)}
"""


def _fastest(part: pd.DataFrame, error: str, level: float) -> pd.Series | None:
    good = part[part[error] <= level]
    return None if good.empty else good.loc[good[TIME].idxmin()]


def _named(row: pd.Series | None) -> str:
    if row is None:
        return "–"
    return f"{row.family}{f', {row.knob}' if row.knob else ''}: {row[TIME]:.3g} ms"


def _short(error: str) -> str:
    return error.removeprefix("error ").removesuffix(" [% of width]")


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--weights", type=Path, help="file written by toile train; default: the package's")
    parser.add_argument("--quick", action="store_true", help="tiny, to see whether everything works")
    options = parser.parse_args()
    torch.set_num_threads(1)
    # Compilers in this process and nothing from earlier runs, so that their time is known.
    os.environ |= {"TORCHINDUCTOR_COMPILE_THREADS": "1", "TORCHINDUCTOR_FORCE_DISABLE_CACHES": "1"}
    weights = options.weights or packaged_weights()
    try:
        describe_weights(weights)
    except InputError as error:
        sys.exit(f"error: {error}")
    docs = ROOT / "outputs" / "surrogate_tradeoff" if options.quick else ROOT / "docs"
    records = Records(docs / "results" / "surrogate")
    table, made = measured(records, weights, QUICK if options.quick else TradeoffSettings())
    save(curves(table), docs / PICTURE)
    print(f"written: {write_text(docs / 'results' / 'surrogate_tradeoff.md', page(table, made))}")


if __name__ == "__main__":
    main()
