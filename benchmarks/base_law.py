"""How far a base law misses cloth without any effect that it has not seen: `make base-law`.

The cloth begins where the truth is, at rest; stiffness, compression ratios and wind are fitted to the first
frames, with no free force at all. What is left is the law's error. Truth is the ``null_twin`` of scenes of an
independent engine (in the data folder); the fit sees the vertices, so tracking has no share in it.

    python benchmarks/base_law.py [--side 32] [--frames 8] [--output docs/results/base_law.md]
"""

from __future__ import annotations

import argparse
import os
import time
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
from toile.physics.grid_laws import GridLaw, angles, taut
from toile.reconstruction.scene_cloth import scene_cloth, template
from toile.scenes.native import load_native
from toile.scenes.scene import Scene

TWIN = Path("ground_truth") / "null_twin_vertices.npy"
LAWS: dict[str, tuple[GridLaw, float]] = {
    "angles": (angles, 1.0),
    "diagonals": (partial(taut, edge_compression=1.0, diagonal_compression=1.0), 1e-6),
    "diagonals that only pull": (partial(taut, edge_compression=1.0), 1e-6),
    "taut (0.5, 0.0)": (taut, 1e-6),
    "taut, ratios fitted": (partial(taut, edge_compression=0.5, diagonal_compression=0.1), 1.0),
}
"""Laws, and the prior deviation of the logarithm of their ratios."""
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
    for folder in sorted(f for f in given.scenes.iterdir() if (f / TWIN).exists()):
        scene, truth = load_native(folder), np.load(folder / TWIN).astype(np.float64)
        for name in given.laws:
            law, deviation = LAWS[name]
            found = missed(scene, truth, law, deviation, given.side, given.frames)
            rows.append({"scene": folder.name, "law": name, **found})
            print(pd.DataFrame(rows[-1:]).to_string(index=False, header=len(rows) == 1), flush=True)
    table = pd.DataFrame(rows)
    print(table.pivot_table("missed [%]", "law", "scene").to_markdown(floatfmt=".2f"))
    if given.output is not None:
        write_text(given.output, table.to_markdown(index=False, floatfmt=".3g") + "\n")


if __name__ == "__main__":
    main()
