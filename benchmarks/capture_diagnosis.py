"""Which effect a person's garment lacks, from masks alone: `make capture-diagnosis`.

Clips of a skirt on a moving person are made by a finer mesh, more sub-steps and another law of the membrane
than the model has, with one effect or none, and their masks are binary. The model knows the body as it would
be estimated, without the effect. Half the motions teach how wrong a right model is and what evidence is
worth (`src/toile/diagnosis/garment/calibration.json`); the table is of the other half.

Every roll-out's result is kept in outputs/capture_diagnosis, so that a run goes on where it was interrupted.

    python benchmarks/capture_diagnosis.py [--output docs/results/capture_diagnosis]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toile.atomic_file import write_text
from toile.capture.arrays import read_arrays, write_arrays
from toile.capture.body.subject import Subject, load_subject
from toile.capture.data.filming import CameraRing
from toile.capture.garments import Garment, make_skirt
from toile.capture.motion.procedural import make_motion
from toile.diagnosis.garment.bodies import PosedBody, TrackedBody
from toile.diagnosis.garment.diagnosis import SHIPPED, Calibration, MadeWith, diagnose
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.error_model import ErrorModel
from toile.diagnosis.garment.fit import ClipFitting, split
from toile.diagnosis.garment.masks import SmoothedAreas
from toile.diagnosis.garment.responses import Responses, measure_responses
from toile.diagnosis.garment.rollout import SETTLED, Discretisation, RollOuts
from toile.diagnosis.garment.scene import Scene
from toile.diagnosis.garment.verdict import AMBIGUOUS, NONE, DecisionWeights, Verdict
from toile.physics.energies.membrane import Membrane, NeoHookean, StVenantKirchhoff

Floats = NDArray[np.float64]

FPS, FRAMES, VERTICES, SUBSTEPS, SIDE = 30.0, 17, 300, 2, 128
CAMERAS = (1, 4)
WORK = Path("outputs/capture_diagnosis")
FORM = SmoothedAreas()


@dataclass(frozen=True)
class Finer:
    """How a true clip is simulated: mesh as a multiple of the model's, sub-steps, law of the membrane."""

    vertices: float
    substeps: int
    membrane: type[Membrane] = StVenantKirchhoff


FINER = (Finer(1.35, 4), Finer(1.6, 3))
TESTED_FINER = (Finer(1.45, 5), Finer(1.75, 3))
AS_MODELLED = Finer(1.0, SUBSTEPS, NeoHookean)
"""No finer at all: tells what masks do not say from what another mesh hides."""


@dataclass(frozen=True)
class Motion:
    """A motion of the person and its seed."""

    name: str
    seed: int

    @property
    def label(self) -> str:
        """Of its files."""
        return f"{self.name}{self.seed}"


TRAINING = (Motion("walk", 100), Motion("squat", 101), Motion("walk", 102))
TESTS = (Motion("walk", 0), Motion("squat", 1), Motion("twirl", 2))
FRESH = (Motion("walk", 10), Motion("squat", 11), Motion("twirl", 12), Motion("turn", 13))
"""Made once the method was settled: its rules were changed with the nulls of ``TESTS`` in view."""


@dataclass(frozen=True)
class Clip:
    """A true clip: motion, effect (or none), its coefficient in usual sizes, and how it is simulated."""

    motion: Motion
    truth: str
    coefficient: float
    finer: Finer

    @property
    def label(self) -> str:
        """Of its files."""
        return f"{self.motion.label}-{self.truth}{self.coefficient:+g}-{self.finer.vertices:g}"


# Coefficients in usual sizes: twice what friction, stiffness and drag can be within their bounds, either sign
# elsewhere.
TRAINED_SIZES = {
    "mask_bias": (1.5,),
    "body_friction": (4.0,),
    "pose_error": (-2.5,),
    "body_shape": (2.0,),
    "garment_stiffness": (3.0,),
    "waist_slip": (2.0,),
    "air_drag": (6.0,),
}
TESTED_SIZES = {
    "mask_bias": (1.0, -2.0),
    "body_friction": (3.0, -3.0),
    "pose_error": (2.0, -1.5),
    "body_shape": (2.5, -1.5),
    "garment_stiffness": (10 / 3, 6.0),
    "waist_slip": (1.5, 3.0),
    "air_drag": (4.0, 8.0),
}

HARD = ("body_friction", "garment_stiffness", "air_drag")
"""What moves the cloth little: tested with the model's own mesh as well."""


def clips(
    motions: Sequence[Motion], sizes: Mapping[str, tuple[float, ...]], discretisations: Sequence[Finer]
) -> list[Clip]:
    """Nulls with every motion and discretisation; effects shared out among them."""
    found = [Clip(motion, NONE, 0.0, finer) for finer in discretisations for motion in motions]
    number = 0
    for place in range(max(map(len, sizes.values()))):
        for name, coefficients in sizes.items():
            if place < len(coefficients):
                finer = discretisations[number % len(discretisations)]
                found.append(Clip(motions[number % len(motions)], name, coefficients[place], finer))
                number += 1
    return found


class Bench:
    """The model of every motion and the masks of every clip, kept in files."""

    def __init__(self) -> None:
        self.cameras = CameraRing(views=max(CAMERAS), side=SIDE).cameras()

    @cached_property
    def subject(self) -> Subject:
        """Who moves."""
        return load_subject("default")

    @cached_property
    def garment(self) -> Garment:
        """The skirt as it is modelled."""
        return make_skirt(self.subject, vertices=VERTICES)

    def model(self, motion: Motion) -> RollOuts:
        """The skirt as it is modelled, on the body as it would be estimated: vertices alone."""
        top = float(self.garment.rest_vertices[:, 1].max())
        body = self._posed(motion, top).moved(0.0, 0.0)
        tracked = TrackedBody(self.subject, body, top)
        return RollOuts(
            self.subject, self.garment, tracked, self.cameras, FPS, Discretisation(SUBSTEPS), kept=12
        )

    def responses(self, motion: Motion, look: RollOuts) -> Responses:
        """Of the model to all effects."""
        path = WORK / "responses" / f"{motion.label}.npz"
        if not path.is_file():
            measure_responses(look, Scene(), FORM).save(path)
        return Responses.load(path)

    def observed(self, clip: Clip) -> Floats:
        """Smoothed binary masks of a true clip (C, 2, F, h, w)."""
        path = WORK / "observed" / f"{clip.label}.npz"
        if not path.is_file():
            garment = make_skirt(self.subject, vertices=round(clip.finer.vertices * VERTICES))
            body = self._posed(clip.motion, float(garment.rest_vertices[:, 1].max()))
            true = RollOuts(
                self.subject,
                garment,
                body,
                self.cameras,
                FPS,
                Discretisation(clip.finer.substeps, clip.finer.membrane),
            )
            scene = Scene() if clip.truth == NONE else EFFECTS[clip.truth].changed(Scene(), clip.coefficient)
            seen = true(scene)
            masks = FORM((seen.masks > 0.5).astype(np.float64))
            write_arrays(path, {"masks": masks, "converged": np.array(seen.converged)})
        found: Floats = read_arrays(path, "Masks", ("masks",))["masks"]
        return found

    def _posed(self, motion: Motion, top: float) -> PosedBody:
        return PosedBody(self.subject, make_motion(self.subject, motion.name, FRAMES, FPS, motion.seed), top)


def error_models(bench: Bench) -> dict[int, ErrorModel]:
    """What null clips of the training say, by the number of cameras."""
    nulls: dict[int, list[tuple[Floats, Floats]]] = {cameras: [] for cameras in CAMERAS}
    for motion in TRAINING:
        responses = bench.responses(motion, bench.model(motion))
        for clip in clips(TRAINING, {"mask_bias": ()}, FINER):
            if clip.motion == motion:
                observed = bench.observed(clip)
                frames, _ = split(observed.shape[2])
                for cameras, found in nulls.items():
                    error = (observed - responses.base)[:cameras, :, frames].ravel()
                    found.append((error, responses.matrix(cameras, frames)))
    return {cameras: ErrorModel.of(found) for cameras, found in nulls.items()}


def results(bench: Bench, wanted: Sequence[Clip], errors: Mapping[int, ErrorModel]) -> list[dict[str, Any]]:
    """What the fits say of every clip, one or four cameras; those that are there are not made again."""
    rows = []
    # Fits under other errors are other fits.
    text = json.dumps({cameras: model.to_dict() for cameras, model in errors.items()})
    place = WORK / f"fits-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    for motion in dict.fromkeys(clip.motion for clip in wanted):
        look = bench.model(motion)
        responses = bench.responses(motion, look)
        for clip in (clip for clip in wanted if clip.motion == motion):
            for cameras in CAMERAS:
                path = place / f"{clip.label}-{cameras}.json"
                begin = time.process_time()
                if not path.is_file():
                    observed = bench.observed(clip)[:cameras]
                    fitting = ClipFitting(look, Scene(), responses, observed, errors[cameras], FORM)
                    # Probabilities are made of the evidence afterwards: these weights are not used.
                    found = diagnose(fitting, DecisionWeights(0.0, 1.0)).to_dict()
                    write_text(path, json.dumps(found, indent=1) + "\n")
                    spent = time.process_time() - begin
                    print(f"{clip.label}, {cameras} cameras: {spent:.0f} s of the processor", flush=True)
                row = json.loads(path.read_text(encoding="utf-8"))
                rows.append({"clip": clip, "cameras": cameras, "found": row})
    return rows


def evidence(found: Mapping[str, Any]) -> dict[str, float]:
    """Log evidence by effect."""
    return {name: float(values["evidence_nats"]) for name, values in found["effects"].items()}


def learnt(bench: Bench) -> Calibration:
    """Errors and weights that the training clips give."""
    errors = error_models(bench)
    rows = results(bench, clips(TRAINING, TRAINED_SIZES, FINER), errors)
    weights = DecisionWeights.learnt([(row["clip"].truth, evidence(row["found"])) for row in rows])
    made_with = MadeWith(SIDE, FRAMES, FPS, len(bench.garment.rest_vertices), bench.garment.name, SUBSTEPS)
    names = ", ".join(motion.label for motion in TRAINING)
    source = f"make capture-diagnosis: {len(rows) // len(CAMERAS)} clips ({names}), one and four cameras"
    return Calibration(errors, weights, made_with, source)


def table(rows: Sequence[Mapping[str, Any]], weights: DecisionWeights) -> pd.DataFrame:
    """One row per clip and number of cameras; sizes in the units of the effects."""
    lines = []
    for row in rows:
        clip, found = row["clip"], row["found"]
        nats = evidence(found)
        verdict = Verdict.of(weights.probabilities(nats))
        best = max(nats, key=lambda name: nats[name])
        # Of the true effect; of the best one where there is none.
        asked = best if clip.truth == NONE else clip.truth
        values, shrink = found["effects"][asked], found["shrink"]
        lines.append(
            {
                "motion": clip.motion.label,
                "mesh": clip.finer.vertices,
                "truth": clip.truth,
                "size": 0.0 if clip.truth == NONE else EFFECTS[clip.truth].in_units(clip.coefficient),
                "cameras": row["cameras"],
                "answer": verdict.answer,
                "candidates": " ".join(verdict.candidates),
                "probability_of_truth": verdict.probabilities[clip.truth],
                "best": best,
                "evidence_best": nats[best],
                "evidence_asked": nats[asked],
                "asked": asked,
                "estimate": values["change"],
                "low": values["low"],
                "high": values["high"],
                "unit": EFFECTS[asked].unit,
                "shrink": shrink["share"],
                "placebo": shrink["placebo"],
                "excess": found["excess"],
            }
        )
    return pd.DataFrame(lines)


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Counts by the number of cameras."""
    lines = []
    for cameras, part in rows.groupby("cameras"):
        effects, nulls = part[part.truth != NONE], part[part.truth == NONE]
        in_set = [row.truth in row.candidates.split() for row in part.itertuples()]
        covered = (effects.low <= effects["size"]) & (effects["size"] <= effects.high)
        named = effects.answer == effects.truth
        more = effects.shrink > effects.placebo
        wrong = ~named & ~effects.answer.isin([NONE, AMBIGUOUS])
        lines.append(
            {
                "cameras": cameras,
                "named rightly": f"{named.sum()} of {len(effects)}",
                "named wrongly": f"{wrong.sum()} of {len(effects)}",
                "ambiguous": f"{(effects.answer == AMBIGUOUS).sum()} of {len(effects)}",
                "taken for none": f"{(effects.answer == NONE).sum()} of {len(effects)}",
                "most evidence for the truth": f"{(effects.best == effects.truth).sum()} of {len(effects)}",
                "false alarms on nulls": f"{(~nulls.answer.isin([NONE, AMBIGUOUS])).sum()} of {len(nulls)}",
                "nulls called none": f"{(nulls.answer == NONE).sum()} of {len(nulls)}",
                "truth within the 90 % set": f"{sum(in_set)} of {len(part)}",
                "size of the set": f"{part.candidates.str.split().str.len().mean():.1f}",
                "truth within the 90 % interval": f"{covered.sum()} of {len(effects)}",
                "named rightly, and shrink above placebo": f"{(named & more).sum()} of {named.sum()}",
            }
        )
    return pd.DataFrame(lines)


def shown(rows: pd.DataFrame) -> str:
    """One line per clip, as Markdown."""
    lines = [
        {
            "motion": row.motion,
            "truth": row.truth,
            "size": "" if row.truth == NONE else f"{row.true_size:+.3g} {row.unit}",
            "cameras": row.cameras,
            "answer": row.answer,
            "candidates": row.candidates.replace(" ", ", "),
            "P(truth)": f"{row.probability_of_truth:.2f}",
            "best": row.best,
            "nats": f"{row.evidence_best:.1f}",
            "nats of the truth": f"{row.evidence_asked:.1f}" if row.truth != NONE else "0",
            "estimate": f"{row.estimate:+.2g} ({row.low:+.2g} to {row.high:+.2g})",
            "shrink": f"{row.shrink:.2f}",
            "placebo": f"{row.placebo:.2f}",
        }
        for row in rows.rename(columns={"size": "true_size"}).itertuples()
    ]
    return str(pd.DataFrame(lines).to_markdown(index=False, disable_numparse=True))


def page(rows: pd.DataFrame, training: pd.DataFrame, own: pd.DataFrame, calibration: Calibration) -> str:
    """The tables as Markdown."""
    errors = pd.DataFrame(
        [
            {
                "cameras": cameras,
                "numbers that count as one": f"{model.alike:.0f}",
                **{name: f"{EFFECTS[name].in_units(value):.2g}" for name, value in model.usual.items()},
            }
            for cameras, model in calibration.errors.items()
        ]
    )
    tests = ", ".join(f"{motion.name} (seed {motion.seed})" for motion in TESTS)
    taught = ", ".join(f"{motion.name} (seed {motion.seed})" for motion in TRAINING)
    meshes, others = (", ".join(f"{finer.vertices:g}" for finer in kinds) for kinds in (TESTED_FINER, FINER))
    steps = ", ".join(str(finer.substeps) for finer in TESTED_FINER)
    lines = [
        "# Which effect a garment lacks, from masks alone",
        "",
        f"`make capture-diagnosis`: a skirt of {VERTICES} vertices, {FRAMES} frames at {FPS:g} frames a "
        f"second of which the first {SETTLED} are left out, one or four cameras of {SIDE} px, binary masks "
        f"of person and garment. Observed clips have finer meshes ({meshes} times the vertices), more "
        f"sub-steps ({steps} instead of {SUBSTEPS}) and St. Venant–Kirchhoff instead of neo-Hookean. "
        f"Tested: {tests}. Errors and weights are learnt on {taught}, with other meshes ({others} times). "
        "The body is known but for the effect. Fits see the first two thirds of the frames; shrink and "
        "placebo are of the last third. Deterministic but for the seeds of the motions.",
        "",
        "## Summary",
        "",
        summary(rows).set_index("cameras").T.to_markdown(),
        "",
        "The same of the clips that taught the weights, which is no test:",
        "",
        summary(training).set_index("cameras").T.to_markdown(),
        "",
        f"Log odds against none are (evidence - {calibration.weights.threshold:.2f}) / "
        f"{calibration.weights.temperature:.2f}.",
        "",
        "## What a right model is wrong by",
        "",
        "Learnt on null clips: how many numbers of the smoothed masks count as one, and by how much of every "
        "effect another mesh, time step and law pass for it (deviation, in its unit). What is not larger "
        "cannot be told from none.",
        "",
        errors.to_markdown(index=False, disable_numparse=True),
        "",
        "## Clips",
        "",
        "`nats`: of the effect with most evidence (`best`), against none. Estimates, with intervals of 90 %, "
        "are of the true effect; in null clips, of the best. Shrink: share of the root mean square error of "
        "held-out smoothed masks that `best` takes away; placebo: the most that its opposite or the next "
        "best effect takes away.",
        "",
        shown(rows),
        "",
        "## With the model's own mesh, steps and law in place of others",
        "",
        "The same errors and weights. What is named here and not above, another mesh hides; what is not "
        "named here either, the masks do not say under those errors.",
        "",
        shown(own),
        "",
    ]
    return "\n".join(lines)


def fresh(bench: Bench, output: Path) -> None:
    """Clips that had no part in anything, by the calibration of the package."""
    calibration = Calibration.load()
    chosen = clips(FRESH, TESTED_SIZES, TESTED_FINER)
    rows = table(results(bench, chosen, calibration.errors), calibration.weights)
    write_text(output.with_suffix(".csv"), rows.to_csv(index=False, float_format="%.4g"))
    motions = ", ".join(f"{motion.name} (seed {motion.seed})" for motion in FRESH)
    lines = [
        "# Which effect a garment lacks: motions that had no part in the method",
        "",
        f"`python benchmarks/capture_diagnosis.py --fresh`: {motions}, by the shipped calibration, made once "
        "after all rules were settled; otherwise as [capture_diagnosis.md](capture_diagnosis.md).",
        "",
        summary(rows).set_index("cameras").T.to_markdown(),
        "",
        shown(rows),
        "",
    ]
    write_text(output.with_suffix(".md"), "\n".join(lines))


def main() -> None:
    """Make what is missing, learn, test, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=Path("docs/results/capture_diagnosis"))
    parser.add_argument("--fresh", action="store_true", help="other seeds by the shipped calibration, alone")
    given = parser.parse_args()
    bench = Bench()
    if given.fresh:
        fresh(bench, given.output.with_name(f"{given.output.name}_fresh"))
        return
    calibration = learnt(bench)
    write_text(SHIPPED, calibration.to_json())
    training = table(
        results(bench, clips(TRAINING, TRAINED_SIZES, FINER), calibration.errors), calibration.weights
    )
    tested = results(bench, clips(TESTS, TESTED_SIZES, TESTED_FINER), calibration.errors)
    rows = table(tested, calibration.weights)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    csv = given.output.with_suffix(".csv")
    write_text(csv, rows.to_csv(index=False, float_format="%.4g"))
    hard = {name: TESTED_SIZES[name] for name in HARD}
    as_modelled = [clip for clip in clips(TESTS, hard, (AS_MODELLED,)) if clip.truth != NONE]
    own = table(results(bench, as_modelled, calibration.errors), calibration.weights)
    write_text(given.output.with_suffix(".md"), page(rows, training, own, calibration))
    print(csv, flush=True)


if __name__ == "__main__":
    main()
