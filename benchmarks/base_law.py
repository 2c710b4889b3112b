"""How far a base law misses cloth without any effect that it has not seen: `make base-law`.

The cloth begins where the truth is, at rest; stiffness, compression ratios and wind are fitted to the first
frames, with no free force at all. What is left is the law's error. Truth is the ``null_twin`` of scenes of an
independent engine (in the data folder), and clips without any effect that Blender and MuJoCo make here (the
extras ``blender`` and ``mujoco``); the fit sees the vertices, so tracking has no share in it. What is found
is kept in outputs/base_law, so that it goes on where it was.

    python benchmarks/base_law.py [--side 32] [--frames 8] [--output docs/results/base_law.md]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from scipy import sparse

from toile.atomic_file import write_text
from toile.diagnosis.base_fit import fit_base
from toile.diagnosis.mechanics import shooting_of, start_material
from toile.diagnosis.model_grid import model_grid
from toile.diagnosis.shooting import ShootingSettings
from toile.diagnosis.tracked import Tracked
from toile.generation.clip_plan import ClipPlan
from toile.generation.out_of_family.from_blender import make_clips_with_blender, why_no_blender
from toile.generation.out_of_family.from_mujoco import make_clips_with_mujoco, why_no_mujoco
from toile.physics.grid_laws import GridLaw, angles, taut, taut_fitted
from toile.reconstruction.scene_cloth import scene_cloth, template
from toile.scenes.native import load_native
from toile.scenes.scene import Scene

TWIN = Path("ground_truth") / "null_twin_vertices.npy"
LAWS: dict[str, tuple[GridLaw, float]] = {
    "angles": (angles, 1.0),
    "diagonals": (partial(taut, edge_compression=1.0, diagonal_compression=1.0), 1e-6),
    "diagonals that only pull": (partial(taut, edge_compression=1.0), 1e-6),
    "taut (0.5, 0.0)": (taut, 1e-6),
    "taut, ratios fitted": (taut_fitted, 1.0),
}
"""Laws, and the prior deviation of the logarithm of their ratios."""
BLENDER_SEEDS = (401, 402, 403)
"""Of nulls, each with a stiffness of its own."""
MUJOCO_SEEDS = (404,)
FOLDER = Path("outputs") / "base_law"
STIFFNESS = (850.0, 2.8, 5.3e-5)
"""Where fits begin: Y [N/m], S per cell area [N/m], B [N·m]; the diagnosis' own."""


def missed(scene: Scene, truth: np.ndarray, law: GridLaw, deviation: float, side: int, frames: int) -> dict:
    """Mean distance over the frames after the start [% of the width], and what was fitted."""
    grid = model_grid(scene, scene_cloth(scene, 0.15, template, law), side)
    positions = np.einsum("mn,fnc->fmc", grid.restrict, truth.reshape(len(truth), -1, 3))[: frames + 1]
    n = positions.shape[1] * 3
    noise = 0.003 * grid.cloth_size[0]
    seen = [sparse.identity(n, np.float32, "csr") * np.float32(noise**-2)] * (frames + 1)
    tracked = Tracked(positions, seen, np.zeros_like(positions), positions)
    settings = ShootingSettings(
        window=frames,
        modes=1,
        start_position=1e-7,
        start_velocity=1e-6,
        boundary=1e-7,
        force=1e-6,
        external=1e-6,
        likelihood_weight=1.0,
        compression=deviation,
    )
    began = time.process_time()
    shooting = shooting_of(scene, grid, tracked, settings, 0.007)
    start = start_material(grid, STIFFNESS)
    fit = fit_base(shooting, positions[0], start, frames + 1, lambda what, cost: None)
    found = np.concatenate([window.positions[:: shooting.substeps][1:] for window in fit.windows])
    away = np.linalg.norm(found - positions[1:], axis=-1) / grid.cloth_size[0] * 100
    names = grid.cloth.energies.parameters.names
    values = dict(zip(names, fit.base.material.tolist(), strict=True))
    return {
        "missed [%]": away.mean(),
        "last frame [%]": away[-1].mean(),
        **values,
        "CPU [s]": time.process_time() - began,
    }


def scenes_of(folder: Path) -> Iterator[tuple[str, Path, int]]:
    """Name, kind and seed of what there is to fit."""
    for one in sorted(f for f in folder.iterdir() if (f / TWIN).exists()) if folder.is_dir() else ():
        yield one.name, one, 0
    reasons = {"Blender": why_no_blender(), "MuJoCo": why_no_mujoco()}
    for engine, seeds in (("Blender", BLENDER_SEEDS), ("MuJoCo", MUJOCO_SEEDS)):
        if reasons[engine]:
            print(f"without {engine}: {reasons[engine]}")
            continue
        for seed in seeds:
            yield f"{engine} {seed}", Path(engine), seed


def scene_and_truth(kind: Path, seed: int, frames: int) -> tuple[Scene, np.ndarray]:
    """A scene from its folder, or one that is made; true positions (F, ..., 3) [m]."""
    if not seed:
        return load_native(kind), np.load(kind / TWIN).astype(np.float64)
    make = make_clips_with_blender if kind.name == "Blender" else make_clips_with_mujoco
    (made,) = make(f"null-{seed}", (), seed, (ClipPlan("release", frames + 4, 25.0, 0),))
    return made.scene, made.vertices.numpy().astype(np.float64)


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    data = Path(os.environ.get("TOILE_DATA", "data"))
    parser.add_argument("--scenes", type=Path, default=data / "independent" / "labelled")
    parser.add_argument("--side", type=int, default=32)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--laws", nargs="+", default=list(LAWS))
    parser.add_argument("--output", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for title, kind, seed in scenes_of(given.scenes):
        known: tuple[Scene, np.ndarray] | None = None
        for name in given.laws:
            kept = FOLDER / f"{title}, {name}, {given.side}, {given.frames}.json"
            if not kept.is_file():
                known = known or scene_and_truth(kind, seed, given.frames)
                law, deviation = LAWS[name]
                found = missed(*known, law, deviation, given.side, given.frames)
                write_text(kept, json.dumps({"scene": title, "law": name, **found}))
            rows.append(json.loads(kept.read_text()))
            print(pd.DataFrame(rows[-1:]).to_string(index=False, header=len(rows) == 1), flush=True)
    if given.output is not None:
        write_text(given.output, page(pd.DataFrame(rows), given.side, given.frames))


def page(table: pd.DataFrame, side: int, frames: int) -> str:
    """The table in short and in full."""
    short = table.pivot_table("missed [%]", "law", "scene", sort=False)
    return "\n".join(
        (
            "# How far base laws miss cloth that they have not seen",
            "",
            f"Made by `make base-law`: {side} × {side} vertices, {frames} frames from rest, no free force "
            "and no effect; stiffness, wind and, in the last row, compression ratios are fitted. Mean "
            "distance over these frames [% of the width]. The base model of a session has the last law.",
            "",
            short.to_markdown(floatfmt=".2f"),
            "",
            "Everything that was fitted:",
            "",
            # Laws without ratios have none.
            table.astype(object).where(table.notna(), "–").to_markdown(index=False, floatfmt=".3g"),
            "",
        )
    )


if __name__ == "__main__":
    main()
