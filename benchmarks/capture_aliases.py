"""What one camera can tell apart in a person's garment: `make capture-aliases`.

A skirt is simulated on a person who walks and squats, once as it is and twice for every effect, with some
more and some less of it. The central difference is how the masks of person and garment answer to it, and
how the garment's vertices do. Two effects whose answers point the same way cannot be told apart: the tables
have the cosine of every pair, seen by one camera, by four, and with the vertices known; and for every effect
the share of its answer that no mixture of the others explains.

Sizes of the differences are in ``EFFECTS``; cosines and shares do not depend on them as long as the answer is
linear, which ``linearity`` measures: the cosine of the two one-sided answers.

    python benchmarks/capture_aliases.py [--frames 14] [--output docs/results/capture_aliases]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toile.atomic_file import write_text
from toile.capture.body.subject import load_subject
from toile.capture.data.filming import CameraRing
from toile.capture.garments.patterns import make_skirt
from toile.capture.motion.procedural import make_motion
from toile.diagnosis.garment.bodies import PosedBody
from toile.diagnosis.garment.effects import EFFECTS
from toile.diagnosis.garment.rollout import Discretisation, RollOuts
from toile.diagnosis.garment.scene import Scene

Floats = NDArray[np.float64]

FPS, SUBSTEPS, VERTICES, SEED = 30.0, 2, 300, 0
MOTIONS = ("walk", "squat")
CAMERAS, SIDE = 4, 128


def stage(motion: str, frames: int) -> RollOuts:
    """A motion of the default person, in a skirt, before a ring of cameras; its first frames are left out."""
    subject = load_subject("default")
    garment = make_skirt(subject, vertices=VERTICES)
    poses = make_motion(subject, motion, frames, FPS, SEED)
    body = PosedBody(subject, poses, float(garment.rest_vertices[:, 1].max()))
    cameras = CameraRing(views=CAMERAS, side=SIDE).cameras()
    return RollOuts(subject, garment, body, cameras, FPS, Discretisation(SUBSTEPS))


def answers(
    look: RollOuts, report: Callable[[str], None]
) -> tuple[dict[str, dict[str, Floats]], pd.DataFrame]:
    """What each kind of observation answers to each effect, (n,) per unit size; and notes on every effect."""
    plain = look(Scene())
    found: dict[str, dict[str, Floats]] = {"one camera": {}, "four cameras": {}, "vertices": {}}
    notes = []
    for name, effect in EFFECTS.items():
        begin = time.process_time()
        more, less = (look(effect.changed(Scene(), sign)) for sign in (1, -1))
        up, down = more.masks - plain.masks, plain.masks - less.masks
        masks = (more.masks - less.masks) / 2
        found["one camera"][name] = masks[0].ravel()
        found["four cameras"][name] = masks.ravel()
        moved = (more.vertices - less.vertices) / 2
        found["vertices"][name] = moved.ravel()
        notes.append(
            {
                "effect": name,
                "vertices_mm": 1e3 * float(np.sqrt(np.square(moved).sum(-1).mean())),
                "pixels_one_camera": float(np.abs(masks[0]).sum((-2, -1)).mean()),
                "linearity_one_camera": cosine(up[0].ravel(), down[0].ravel()),
                "converged": min(more.converged, less.converged),
            }
        )
        report(f"{name}: {time.process_time() - begin:.0f} s of the processor")
    return found, pd.DataFrame(notes)


def cosine(first: Floats, second: Floats) -> float:
    """Of two answers; 0 where one of them is none."""
    length = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / length if length else 0.0


def own_share(found: dict[str, Floats], name: str) -> float:
    """Length of what is left of an answer when the others have explained what they can, of its length."""
    answer = found[name]
    length = float(np.linalg.norm(answer))
    if not length:
        return 0.0
    others = np.stack([v / max(float(np.linalg.norm(v)), 1e-30) for k, v in found.items() if k != name], 1)
    left = answer - others @ np.linalg.lstsq(others, answer, rcond=None)[0]
    return float(np.linalg.norm(left)) / length


def together(parts: Sequence[dict[str, dict[str, Floats]]]) -> dict[str, dict[str, Floats]]:
    """The answers of several motions as one, the effects the same in all."""
    return {
        kind: {name: np.concatenate([part[kind][name] for part in parts]) for name in EFFECTS}
        for kind in parts[0]
    }


def tables(found: dict[str, dict[str, Floats]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Cosines of all pairs, and own shares of all effects, by what is observed."""
    names = list(EFFECTS)
    pairs = [
        {"effect": a, "other": b, **{kind: cosine(found[kind][a], found[kind][b]) for kind in found}}
        for i, a in enumerate(names)
        for b in names[i + 1 :]
    ]
    shares = [{"effect": name, **{kind: own_share(found[kind], name) for kind in found}} for name in names]
    return pd.DataFrame(pairs), pd.DataFrame(shares)


def main() -> None:
    """Roll out, compare, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=14, help="of each motion, six or more")
    parser.add_argument("--output", type=Path, default=Path("docs/results/capture_aliases"))
    given = parser.parse_args()
    if given.frames < 6:
        parser.error(f"--frames: expected 6 or more, got {given.frames}")
    found, notes = [], []
    for motion in MOTIONS:

        def say(line: str, motion: str = motion) -> None:
            print(f"{motion}, {line}", flush=True)

        part, note = answers(stage(motion, given.frames), say)
        found.append(part)
        notes.append(note.assign(motion=motion))
        # What is there so far: the next motion may take a while.
        pairs, shares = tables(together(found))
        given.output.parent.mkdir(parents=True, exist_ok=True)
        csv = given.output.with_suffix(".csv")
        write_text(csv, pairs.to_csv(index=False, float_format="%.4f"))
        text = page(pairs, shares, pd.concat(notes), given.frames)
        write_text(given.output.with_suffix(".md"), text)
        print(csv, flush=True)


def page(pairs: pd.DataFrame, shares: pd.DataFrame, notes: pd.DataFrame, frames: int) -> str:
    """The tables as Markdown."""
    worst = (
        pairs.assign(size=pairs["one camera"].abs()).sort_values("size", ascending=False).drop(columns="size")
    )
    sizes = "; ".join(f"`{name}` {effect.words}" for name, effect in EFFECTS.items())
    lines = [
        "# What one camera can tell apart in a garment",
        "",
        f"`make capture-aliases`: a skirt of {VERTICES} vertices on the default person, "
        f"{' and '.join(notes.motion.unique())} of {frames} frames, {SUBSTEPS} sub-steps, seed {SEED}, "
        f"{CAMERAS} cameras of {SIDE} px; central differences. Sizes: {sizes}. "
        "Deterministic: there is no spread over seeds.",
        "",
        "## Cosines of the answers",
        "",
        "Near 1 or -1: the two cannot be told apart by what is observed (masks of person and garment in one "
        "camera or in four, or the garment's vertices). The bias of masks does not move vertices.",
        "",
        worst.to_markdown(index=False, floatfmt=".2f"),
        "",
        "## What is left of an effect's answer",
        "",
        "when the six others have explained what they can, as a share of its length. 0: it cannot be told "
        "from a mixture of the others; 1: nothing is like it.",
        "",
        shares.to_markdown(index=False, floatfmt=".2f"),
        "",
        "## The answers themselves",
        "",
        "Root mean square of how far vertices move [mm]; area of the masks that changes [px], mean over "
        "masks and frames of the first camera; cosine of the answers to more and to less of it, which is 1 "
        "where the answer is linear; share of the layer's steps that converged.",
        "",
        notes[["motion", *(c for c in notes if c != "motion")]].to_markdown(index=False, floatfmt=".3g"),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
