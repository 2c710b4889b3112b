"""Scenes with open labels that the diagnosis is developed and calibrated on: make, diagnose, tabulate.

    make development

They come from the same generators as the blind sets, under seeds of their own, and are no test of anything.
Everything lies in ``outputs/development`` and is kept: ``scenes``, ``truth`` (vertices and label), ``runs``,
``labels.json`` for ``toile calibrate``. The table is ``docs/results/diagnosis_development.md``.
"""

from __future__ import annotations

import argparse
import json
import traceback
from pathlib import Path

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import numpy as np
import pandas as pd

from toile.atomic_file import write_text, written_atomically
from toile.blind.calibration import evidence_of, verdict_by
from toile.cli.diagnose import diagnose_scene
from toile.diagnosis.arrays import SCREENING_FILE
from toile.diagnosis.decision import Calibration, Weights, probabilities
from toile.diagnosis.record import DIAGNOSIS_FILE, GapReport
from toile.diagnosis.settings import DiagnosisSettings
from toile.diagnosis.stages import TRACKED_FILE
from toile.generation.out_of_family.base_scene import OutOfFamilySettings
from toile.generation.out_of_family.blind_set import PlannedScene, write_opaque
from toile.generation.out_of_family.from_blender import make_with_blender, why_no_blender
from toile.generation.out_of_family.making import SceneRequest, make_scene

FOLDER = Path("outputs/development")
TABLE = Path("docs/results/diagnosis_development.md")

_MOVING = (
    "air_drag",
    "gusts",
    "internal_damping",
    "frame_rate",
    "gravity_tilt",
    "rest_curvature",
    "nonuniform_stiffness",
    "nonuniform_density",
    "anisotropic_stiffness",
    "strain_stiffening",
)
_OUTSIDE = (("vortex", "vortex_field"), ("creases", "plastic_creases"), ("press", "internal_pressure"))
_OUT_OF_FAMILY = OutOfFamilySettings(templates=tuple(f"R{k}" for k in range(2, 10)))  # as in the blind sets
_BLENDER = ("air_drag", "gusts", "internal_damping", "frame_rate", "gravity_tilt")


def planned() -> list[PlannedScene]:
    """Those of the package's out-of-family generator first."""
    own = [(f"n{k}", (), 9200 + k) for k in (1, 2, 3, 4)]
    own += [(f"{e}_m", ((e, "medium"),), 9100 + k) for k, e in enumerate(_MOVING)]
    own += [(f"{e}_s", ((e, "strong"),), 9110 + k) for k, e in enumerate((*_MOVING, "anchor_slip"))]
    own += [("air_drag_w", (("air_drag", "weak"),), 9301), ("gusts_w", (("gusts", "weak"),), 9302)]
    own += [(f"{n}_s", ((e, "strong"),), 9401 + k) for k, (n, e) in enumerate(_OUTSIDE)]
    other = [(f"bn{k}", (), 7000 + k) for k in (1, 2, 3, 4)]
    medium = (*_BLENDER, "nonuniform_stiffness")
    other += [(f"b_{e}_m", ((e, "medium"),), 7010 + k) for k, e in enumerate(medium)]
    other += [(f"b_{e}_s", ((e, "strong"),), 7016 + k) for k, e in enumerate(_BLENDER)]
    return [PlannedScene(*item) for item in own] + [PlannedScene(*item, "blender") for item in other]


def make(scene: PlannedScene) -> None:
    """Make a scene and its truth, unless they are there."""
    if (FOLDER / "truth" / f"{scene.name}.json").is_file():
        return
    if scene.generator == "blender":
        made = make_with_blender(scene, small=False)
    else:
        made = make_scene(_OUT_OF_FAMILY, SceneRequest(scene.name, scene.effects, scene.seed))
    if not (FOLDER / "scenes" / scene.name).exists():
        write_opaque(made.scene, FOLDER / "scenes" / scene.name)
    path = FOLDER / "truth" / f"{scene.name}.npz"
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, vertices=made.vertices.float().numpy())
    write_text(path.with_suffix(".json"), json.dumps(made.label, indent=1) + "\n")


def is_done(run: Path) -> bool:
    """Whether there is a diagnosis, and of a version that measured what the table shows."""
    if not (run / DIAGNOSIS_FILE).is_file() or not (run / SCREENING_FILE).is_file():
        return False
    with np.load(run / SCREENING_FILE) as stored:
        return {"in_sample", "prediction_gain", "size"} <= set(stored.files)


def row(scene: PlannedScene, runs: Path) -> dict[str, object]:
    """One line of the table."""
    report = GapReport.read(runs / scene.name / DIAGNOSIS_FILE)
    truth = scene.effects[0][0] if scene.effects else "none"
    label = json.loads((FOLDER / "truth" / f"{scene.name}.json").read_text())
    with np.load(FOLDER / "truth" / f"{scene.name}.npz") as stored:
        true = stored["vertices"].astype(float)
    with np.load(runs / scene.name / TRACKED_FILE) as stored:
        off = stored["positions"].reshape(true.shape) - true
    evidence = evidence_of(runs / scene.name, Weights(), DiagnosisSettings().usual_cost)
    calibration = Calibration.load()
    chances, verdict = probabilities(evidence, calibration), verdict_by(evidence, calibration)
    with np.load(runs / scene.name / SCREENING_FILE) as stored:
        seen = {
            name: f"{name} {float(in_sample):.1f} / {float(gain):.2f} / {100 * float(size):.2f}".replace(
                "nan", "-"
            )
            for name, in_sample, gain, size in zip(
                *(stored[key].tolist() for key in ("names", "in_sample", "prediction_gain", "size")),
                strict=True,
            )
        }
        in_sample = dict(zip(stored["names"].tolist(), stored["in_sample"].tolist(), strict=True))
    order = sorted(_MOVING, key=lambda name: -evidence[name])
    return {
        "scene": scene.name,
        "engine": "Blender" if scene.generator == "blender" else "ours",
        "effect": truth,
        "motion it causes [% of width]": f"{label['magnitude'].get('mean_last_third', 0):.1f}",
        "tracking error [mm]": f"{1e3 * np.linalg.norm(off, axis=-1).mean():.0f}",
        "in the image plane [mm]": f"{1e3 * np.linalg.norm(off[..., :2], axis=-1).mean():.1f}",
        "answer": verdict.effect,
        "candidates": ", ".join(verdict.candidates),
        "probability of the truth": f"{chances[truth]:.2f}" if truth in chances else "",
        "rank of its evidence": str(order.index(truth) + 1) if truth in order else "",
        "strongest that moves": f"{order[0]} {evidence[order[0]]:.1f}",
        "truth: in-sample log Bayes factor / prediction gain / size [% of width]": seen.get(truth, ""),
        "largest in-sample log Bayes factor of those that move": seen[
            max(_MOVING, key=lambda name: in_sample[name])
        ],
        "naive answer": report.protocol.naive,
    }


def table(scenes: list[PlannedScene], runs: Path) -> str:
    """The document."""
    rows = pd.DataFrame([row(s, runs) for s in scenes])
    single = rows[rows["effect"].isin(_MOVING)]
    null = rows[rows["effect"] == "none"]
    named = int((single["answer"] == single["effect"]).sum())
    first = int((single["rank of its evidence"] == "1").sum())
    within = sum(t in c.split(", ") for t, c in zip(single["effect"], single["candidates"], strict=True))
    left = len(planned()) - len(scenes)
    naive = int((single["naive answer"] == single["effect"]).sum())
    return (
        "# The diagnosis on the scenes it was developed on\n\n"
        "Made by `make development`; the scenes come from the generators of the blind sets under seeds of "
        "their own (`benchmarks/development.py`). They chose settings and calibration: "
        "**they are no test.**\n\n"
        f"Of {len(single)} scenes with one effect that moves the cloth, {named} are named (naive: {naive}), "
        f"{within} have it in the 90 % set, and in {first} its evidence is the strongest of them; of "
        f"{len(null)} nulls {int((null['answer'] == 'none').sum())} are `none`. {left} of the planned scenes "
        "were not run.\n\n" + rows.to_markdown(index=False) + "\n"
    )


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="*", help="names of scenes; default: all")
    parser.add_argument("--settings", nargs="*", default=[], help="of toile diagnose; with --runs")
    parser.add_argument("--runs", default="runs", help="their folder; another one has its own table.md")
    parser.add_argument("--table", action="store_true", help="of what is there; make and diagnose nothing")
    arguments = parser.parse_args()
    runs = FOLDER / arguments.runs
    scenes = [s for s in planned() if not arguments.only or s.name in arguments.only]
    reason = why_no_blender()
    if reason and not arguments.table:
        print(f"no scenes by Blender: {reason}")
        scenes = [s for s in scenes if s.generator != "blender"]
    labels = {s.name: s.effects[0][0] if s.effects else "none" for s in planned()}
    write_text(FOLDER / "labels.json", json.dumps(labels, indent=1) + "\n")
    for scene in [] if arguments.table else scenes:
        run = runs / scene.name
        if is_done(run):
            continue
        print(scene.name, flush=True)
        try:
            make(scene)
            diagnose_scene(FOLDER / "scenes" / scene.name, run, ["workers=2", *arguments.settings])
        except Exception:  # the other scenes are worth having
            traceback.print_exc()
    done = [s for s in scenes if is_done(runs / s.name)]
    print(write_text(TABLE if arguments.runs == "runs" else runs / "table.md", table(done, runs)))


if __name__ == "__main__":
    main()
