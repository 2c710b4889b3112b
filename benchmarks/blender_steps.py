"""How far Blender's cloth depends on its steps and its grid: docs/results/blender_steps.md.

    python benchmarks/blender_steps.py [--seeds 301 411 ...]

First clips of sessions without any effect, as blind sets have them. Needs the extra ``blender``; some six
minutes of the processor a seed.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toile.atomic_file import write_text
from toile.generation.blender import process
from toile.generation.blender.balance import balanced
from toile.generation.blender.settings import BlenderSettings
from toile.generation.blender.world import simulation
from toile.generation.clip_plan import DEFAULT_CLIPS
from toile.generation.out_of_family.from_blender import clip_settings

RESULT = Path("docs") / "results" / "blender_steps.md"
STEPS = (12, 24, 48, 96)
"""Per frame of 1/50 s; the last ones are what the others are compared with."""
ASIDE = 48
"""Steps with which the grid and the material are changed."""

Array = NDArray[np.float64]


def moved(settings: BlenderSettings, tension: float = 1.0) -> Array:
    """Motion (F, H, W, 3) [m] at the vertices of a scene.

    Args:
        settings: of the scene.
        tension: factor on the stiffness of threads.
    """
    request: dict[str, Any] = simulation(settings, "cloth", with_effect=False)
    for kind in ("tension", "compression"):
        request["cloth"][f"{kind}_stiffness"] *= tension
    with tempfile.TemporaryDirectory() as work:
        process.run({"threads": settings.threads, "simulations": [request]}, Path(work), settings.python)
        found = np.load(Path(work) / "cloth.npy").astype(np.float64)
    every = settings.refinement
    return found[:, ::every, ::every]


def row(seed: int) -> dict[str, object]:
    """One cloth."""
    usual = clip_settings("steps", (), seed, 0, DEFAULT_CLIPS[0])
    width = usual.cloth_size[0]

    def apart(a: Array, b: Array) -> str:
        distance = np.linalg.norm(a - b, axis=-1).mean((1, 2))
        return f"{100 * distance[2 * len(distance) // 3 :].mean() / width:.2f}"

    with tempfile.TemporaryDirectory() as work:
        used = balanced(usual, Path(work), with_effect=False).steps
    motions = {steps: moved(replace(usual, steps=steps)) for steps in STEPS}
    *fewer, most = STEPS
    aside = replace(usual, steps=ASIDE)
    changed: dict[str, Callable[[], Array]] = {
        "twice as many vertices along each side": lambda: moved(
            replace(aside, refinement=2 * usual.refinement)
        ),
        "threads 1 % stiffer": lambda: moved(aside, 1.01),
        "threads twice as stiff": lambda: moved(aside, 2.0),
    }
    return {
        "seed": seed,
        "steps that its balance needs": used,
        **{f"{steps} steps, off those of {most}": apart(motions[steps], motions[most]) for steps in fewer},
        **{what: apart(make(), motions[ASIDE]) for what, make in changed.items()},
    }


def page(rows: Sequence[dict[str, object]]) -> str:
    """The table and what it means."""
    return "\n".join(
        [
            "# How far Blender's cloth depends on its steps and its grid",
            "",
            "Made by `python benchmarks/blender_steps.py`. First clips of sessions without any effect; mean "
            "distance of the vertices in the last third of the clip, for which sizes of effects are asked "
            f"[% of the width]. Steps are per frame of 1/50 s; grid and material are changed with {ASIDE} of "
            "them.",
            "",
            pd.DataFrame(rows).set_index("seed").T.to_markdown(disable_numparse=True),
            "",
        ]
    )


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[301, 411])
    given = parser.parse_args()
    rows = []
    for seed in given.seeds:
        rows.append(row(seed))
        print(rows[-1], flush=True)
        write_text(RESULT, page(rows))


if __name__ == "__main__":
    main()
