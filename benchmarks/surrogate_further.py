"""Does a further training make better weights? Chosen on validation cloths, measured on held-out ones.

    toile train training=further weights=packaged hydra.run.dir=outputs/surrogate_further
    python benchmarks/surrogate_further.py outputs/surrogate_further    # docs/results/surrogate_further.md

Weights of single epochs are compared on cloths that neither training nor the model card has, and with what
was before. Every part is written to docs/results/surrogate/ and not measured again with the same weights and
settings.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

# Sets the number of BLAS threads before NumPy is loaded.
import toile.cli  # noqa: F401

# isort: split
import pandas as pd
import torch
import yaml
from surrogate import tables
from surrogate.accuracy import MOTION
from surrogate.further import (
    AFTER,
    BEFORE,
    Extent,
    at_rest,
    choice,
    directions,
    held_out,
    motions_to_rest,
    score,
)
from surrogate.gradients import GROUPS
from surrogate.records import Records, fingerprint
from surrogate.stability import REST, StabilitySettings

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.physics.surrogate.surrogate import STEP
from toile.physics.surrogate.weights import (
    describe_weights,
    load_weights,
    packaged_weights,
    save_weights,
)

ROOT = Path(__file__).resolve().parent.parent
QUICK = Extent(
    grid=(8, 8),
    steps=4,
    validation=(("fits", 1), ("box", 2)),
    held_out=(("fits", 1), ("box", 2)),
    passes=(1,),
    stability=StabilitySettings(grid=(8, 8), steps=20, every=5, levels=2),
    gradient_seeds=1,
    gradient_steps=3,
)


def measured(
    records: Records, folder: Path, extent: Extent, cache: Path, *, without_rest: bool = False
) -> str:
    """Measure what is missing, and make the page of it."""
    before = packaged_weights()
    candidates = {BEFORE: before} | {path.stem: path for path in sorted((folder / "epochs").glob("*.pt"))}
    about = {"before": fingerprint(before), "step": STEP, **asdict(extent)}
    prints = {name: fingerprint(path) for name, path in candidates.items()}
    records.measure(
        "further_choice", {**about, "candidates": prints}, lambda: choice(candidates, extent, cache)
    )
    chosen = _record(records, "further_choice")
    scores = score(chosen).reindex(candidates)
    best = str(scores.drop(BEFORE).idxmin())
    both = {BEFORE: before, AFTER: candidates[best]}
    about |= {"after": prints[best]}
    records.measure("further_held_out", about, lambda: held_out(both, extent, cache))
    records.measure("further_directions", about, lambda: directions(both, extent))
    if not without_rest:
        own = records.read("stability_1")
        known = own is not None and own.about["settings"].get("sha256") == fingerprint(before)
        earlier = own.table if known and own is not None else None
        records.measure("further_stability", about, lambda: motions_to_rest(both[AFTER], extent, earlier))
    first = records.read("further_choice")
    assert first is not None
    planned = int(yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8"))["training"]["epochs"])
    run = f"which had made {len(candidates) - 1} of its {planned} epochs"
    made = f"`make surrogate-further` on {first.about['machine']}, {first.about['threads']} thread"
    return page(records, scores, best, extent, made, candidates[best], run)


def page(
    records: Records, scores: pd.Series, best: str, extent: Extent, made: str, after: Path, run: str
) -> str:
    """The Markdown page."""
    described = "; ".join(f"{key} {value}" for key, value in describe_weights(after).items())
    verdict = "lower" if scores[best] < scores[BEFORE] else "not lower"
    return f"""# A further training of the surrogate

{made}. Weights *before* are the package's, sha256 {fingerprint(packaged_weights())}…; *after* is {best}
({described}), sha256 {fingerprint(after)}…, of `toile train training=further weights=packaged`,
{run}.

## The choice

Mean decimal logarithm of the vertex error [% of width] over validation cloths that nothing else is measured
on ({_counts(extent.validation)}; {extent.steps} steps, two passes). The best epoch is {verdict} than before.

{tables.frame(_choice_table(records, scores))}

## Held-out cloths

Vertex error [% of width] over {extent.steps} steps, median / 95th percentile / worst of the model card's
cloths ({_counts(extent.held_out)}), and on how many of them it is smaller after.

{tables.frame(_held_out_table(_record(records, "further_held_out"), extent))}

## At rest

The materials of the model card on stability, one pass a step; at rest is below {REST:g} edges a step
at the end. After, only those are moved that did not come to rest before; all of them, with the weights of the
package: the [model card](../surrogate.md#stability).

{_rest(records, extent, fingerprint(after))}

## Directions of gradients over {extent.gradient_steps} steps

Cosine with the solver's gradient, median (smallest) of {extent.gradient_seeds} seeds, implicit derivative.

{tables.frame(_direction_table(_record(records, "further_directions")))}
"""


def _record(records: Records, part: str) -> pd.DataFrame:
    found = records.read(part)
    assert found is not None
    return found.table


def _counts(cloths: tuple[tuple[str, int], ...]) -> str:
    return ", ".join(f"{count} *{regime}*" for regime, count in cloths)


def _choice_table(records: Records, scores: pd.Series) -> pd.DataFrame:
    errors = _record(records, "further_choice")
    rows = []
    for name, value in scores.items():
        row: dict[str, object] = {"weights": name, "mean log10 error": f"{value:.3f}"}
        for regime, part in errors[errors.contender == name].groupby("regime", sort=False):
            row[f"{regime}: median / 95 % / worst"] = tables.spread(part[MOTION])
        rows.append(row)
    return pd.DataFrame(rows)


def _held_out_table(errors: pd.DataFrame, extent: Extent) -> pd.DataFrame:
    rows = []
    for regime, part in errors.groupby("regime", sort=False):
        by = part.pivot_table(index="seed", columns="contender", values=MOTION)
        for name in [c for c in dict.fromkeys(part.contender) if c.startswith(BEFORE)]:
            other = name.replace(BEFORE, AFTER, 1)
            rows.append(
                {
                    "regime": regime,
                    "": name.removeprefix(f"{BEFORE}, "),
                    BEFORE: tables.spread(by[name]),
                    AFTER: tables.spread(by[other]),
                    "smaller after": f"{int((by[other] < by[name]).sum())} of {len(by)}",
                }
            )
    return pd.DataFrame(rows)


def _rest(records: Records, extent: Extent, after: str) -> str:
    """How many materials come to rest; what was before is read from the card's own table."""
    found = {BEFORE: records.read("stability_1"), AFTER: records.read("further_stability")}
    wanted = {BEFORE: ("sha256", fingerprint(packaged_weights())), AFTER: ("after", after)}
    rows, moving = [], []
    for name, record in found.items():
        key, value = wanted[name]
        if record is None or record.about["settings"].get(key) != value:
            rows.append({"": name, "steps": "not measured", "at rest": "–", "largest speed": "–"})
            continue
        rest = at_rest(record.table)
        rows.append(
            {
                "": name,
                "steps": f"{int(record.table.step.max()):,}",
                "at rest": f"{int(rest.rest.sum())} of {len(rest)}",
                "largest speed": tables.number(rest.speed.max()),
            }
        )
        moving += [
            f"{name}, Y {row.Y:g}, S {row.S:.2g}, B {row.B:g} ({tables.number(row.speed)})"
            for row in rest[~rest.rest].itertuples()
        ]
    return f"{tables.frame(pd.DataFrame(rows))}\n\nNot at rest: {'; '.join(moving) or 'none'}."


def _direction_table(found: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for name, part in found.groupby("contender", sort=False):
        row: dict[str, object] = {"": name}
        for group in GROUPS:
            its = part[part.group == group].cosine
            row[group] = f"{its.median():.3f} ({its.min():.3f})" if len(its) else "–"
        rows.append(row)
    return pd.DataFrame(rows)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="of the training")
    parser.add_argument("--quick", action="store_true", help="tiny, to see whether everything works")
    parser.add_argument("--without-rest", action="store_true", help="leave out the long motions (minutes)")
    parser.add_argument(
        "--ship", action="store_true", help="put the chosen epoch into the package if it is better"
    )
    options = parser.parse_args()
    if not list((options.folder / "epochs").glob("*.pt")):
        sys.exit(f"error: no weights: {options.folder / 'epochs'}: expected those of a training, got none")
    torch.set_num_threads(1)
    outputs = ROOT / "outputs" / "surrogate_further_card"
    docs = outputs if options.quick else ROOT / "docs"
    records = Records(docs / "results" / "surrogate")
    try:
        extent = QUICK if options.quick else Extent()
        cache = outputs / "solver"
        text = measured(records, options.folder, extent, cache, without_rest=options.without_rest)
    except InputError as error:
        sys.exit(f"error: {error}")
    print(f"written: {write_text(docs / 'results' / 'surrogate_further.md', text)}")
    if options.ship:
        ship(records, options.folder)


def ship(records: Records, folder: Path) -> None:
    """Put the chosen epoch into the package, with how it was made; not where none is better than before."""
    scores = score(_record(records, "further_choice"))
    best = str(scores.idxmin())
    if best == BEFORE:
        print("the package keeps its weights: no epoch is better")
        return
    epoch, run = folder / "epochs" / f"{best}.pt", describe_weights(folder / "surrogate.pt")
    before = describe_weights()
    chosen = describe_weights(epoch)
    about = {
        **run,
        "chosen": f"epoch {chosen['epoch']}, {chosen['steps']} of {run['steps'].split()[0]} steps",
        "from": f"{before['command']}, sha256 {fingerprint(packaged_weights())}",
    }
    save_weights(packaged_weights(), load_weights(epoch), about)
    print(f"written: {packaged_weights()}, sha256 {fingerprint(packaged_weights())}")


if __name__ == "__main__":
    main()
