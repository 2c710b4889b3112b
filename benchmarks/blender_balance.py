"""Whether Blender's cloth keeps the balance of torques, by effect and steps: docs/results/blender_balance.md.

    python benchmarks/blender_balance.py [--seeds 307 ...] [--effects none rest_curvature ...]

First clips of sessions as blind sets have them, effects within the cloth of 3 % of its width. Needs the extra
``blender``.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from toile.atomic_file import write_text
from toile.generation.blender.balance import LARGEST_IMBALANCE, balanced, imbalance_of
from toile.generation.blender.effects import EFFECTS, WITHIN
from toile.generation.blender.scene import matched
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.generation.out_of_family.from_blender import clip_settings
from toile.physics.simulator import SimulationError

RESULT = Path("docs") / "results" / "blender_balance.md"
SIZE = 3.0
"""Of every effect [% of the width]."""
FACTORS = (1, 2, 4, 8)
"""Of the usual number of steps."""


def row(seed: int, name: str) -> dict[str, object]:
    """One effect of one session."""
    effects = () if name == "none" else ((name, SIZE),)
    usual = clip_settings("balance", effects, seed, 0, DEFAULT_CLIPS[0])
    about: dict[str, object] = {"seed": seed, "effect": name}
    with tempfile.TemporaryDirectory() as work:
        try:
            sized = matched(usual, SIZE / 100) if effects else usual
            used = balanced(sized, Path(work), with_effect=True)
        except SimulationError as error:
            return {**about, "strength": f"none: {error}"}
        about["strength"] = ", ".join(f"{key} {value:.3g}" for key, value in used.parameters.items())
        for factor in FACTORS:
            tried = replace(used, steps=usual.steps * factor)
            found = imbalance_of(tried, Path(work), with_effect=True)
            about[f"{tried.steps} steps"] = f"{found:.3f}"
        about["steps used"] = used.steps
    return about


def page(rows: Sequence[dict[str, object]]) -> str:
    """The table and what it means."""
    table = pd.DataFrame(rows).fillna("–")
    return "\n".join(
        [
            "# Does Blender's cloth keep the balance of torques?",
            "",
            "Made by `python benchmarks/blender_balance.py`. Blender's solver stops where what is left is a "
            "hundredth of all forces that it solves for, those within the cloth included. What is left acts "
            "like a force from nowhere, and swings the cloth about the line through its corners, which no "
            "force within it can. Root mean square of the torque about that line that gravity does not "
            "account for, as an acceleration [m/s²]; the cloth let go in a vacuum, its corners still, by "
            f"steps a frame of 1/50 s. Effects within the cloth of {SIZE:g} % of its width, at the strength "
            "that comes nearest to it in as many steps as are used: the fewest with "
            f"{LARGEST_IMBALANCE:g} m/s² and less.",
            "",
            table.to_markdown(index=False, disable_numparse=True),
            "",
        ]
    )


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[307])
    in_catalogue = [name for name in WITHIN if EFFECTS[name].in_catalogue]
    parser.add_argument("--effects", nargs="+", choices=["none", *WITHIN], default=["none", *in_catalogue])
    given = parser.parse_args()
    rows = []
    for seed in given.seeds:
        for name in given.effects:
            rows.append(row(seed, name))
            print(rows[-1], flush=True)
            write_text(RESULT, page(rows))


if __name__ == "__main__":
    main()
