"""The model card's numbers of the learned decision: docs/results/learned_decision.csv and its tables.

    toile blind train                                     # makes the training set and the weights
    python benchmarks/learned_decision.py transfer        # clips of the fine-grid generator, true vertices
    python benchmarks/learned_decision.py measure         # curve, ablation, sessions, transfer

Clips of ``transfer`` come from another simulator (BDF2, twice as fine a grid, other forms), without a film.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator
from pathlib import Path

import toile.cli  # noqa: F401  # isort: skip  # first, because it sets the number of threads

import numpy as np

from toile.atomic_file import write_text, written_atomically
from toile.cli.blind_train import SHARES, as_csv
from toile.diagnosis.learned.decision import LearnedDecision
from toile.diagnosis.learned.examples import Examples, examples_of
from toile.diagnosis.learned.measures import Row, measured, probabilities, scored, session_probabilities
from toile.diagnosis.learned.training import TrainingSettings, trained
from toile.diagnosis.learned.training_set import TrainingSet, split
from toile.generation.fast.clips import LabelledClip
from toile.generation.fast.effects import LABELS, NONE, OUTSIDE
from toile.generation.out_of_family.base_scene import OutOfFamilySettings, draw_base
from toile.generation.out_of_family.catalogue import out_of_family_effect
from toile.generation.out_of_family.making import ClipMaker, SceneRequest
from toile.generation.refinement import coarsen
from toile.physics.simulator import SimulationError

TRANSFER_SEED = 4321
SIZES = (2.0, 3.5, 6.0)  # % of the width
PER_BASE = 4  # effects on one cloth
NAMES = [label for label in LABELS if label not in (NONE, OUTSIDE)]

_log = logging.getLogger(__name__)


def transfer_clips(base_number: int) -> Iterator[LabelledClip]:
    """The null clip and clips with effects of one cloth of the fine-grid generator."""
    # No fit on a coarse grid comes after this, so how far one strays does not matter.
    setup = OutOfFamilySettings(
        grid=(12, 12), templates=(), substeps=5, coarse_substeps=4, largest_grid_share=100.0
    )
    base = draw_base(setup, np.random.default_rng([TRANSFER_SEED, base_number, 1]))
    seed = 9000 + base_number
    maker = ClipMaker(setup, base, SceneRequest("transfer", (("air_drag", "medium"),), seed), 0)
    twin = maker.twin()
    settings = maker.settings

    def frames(motion: object) -> np.ndarray:
        return coarsen(motion[:: settings.substeps], settings.refinement).numpy()  # type: ignore[index]

    def clip(effect: str, positions: np.ndarray, size: float) -> LabelledClip:
        return LabelledClip(
            label=effect,
            effect=effect,
            size=size,
            scene=base_number,
            motion="",
            positions=positions,
            pinned=tuple(maker.start.pinned),
            fps=settings.fps,
            gravity=np.array(settings.gravity),
            cloth_size=maker.start.cloth_size,
        )

    null = frames(twin)
    yield clip(NONE, null, 0.0)
    for j in range(PER_BASE):
        name = NAMES[(PER_BASE * base_number + j) % len(NAMES)]
        shape = out_of_family_effect(name)(maker.rng, maker.reference)
        try:
            effect = maker.of_size(shape, SIZES[(base_number + j) % len(SIZES)])
            moved = frames(maker.moved((effect,), twin))
        except SimulationError as error:
            _log.warning("cloth %d, %s: %s", base_number, name, error)
            continue
        begin = len(null) * 2 // 3
        distance = np.linalg.norm(moved[begin:] - null[begin:], axis=-1).mean()
        yield clip(name, moved, float(100 * distance / maker.reference.width))


def make_transfer(folder: Path, minutes: float, cloths: int) -> None:
    """Write a file per cloth until the minutes are over."""
    end = time.monotonic() + 60 * minutes
    for number in range(cloths):
        path = folder / f"transfer_{number:03d}.npz"
        if path.is_file() or time.monotonic() > end:
            continue
        try:
            clips = list(transfer_clips(number))
        except SimulationError as error:
            _log.warning("cloth %d: %s", number, error)
            continue
        with written_atomically(path) as temporary:
            np.savez(
                temporary,
                positions=np.stack([c.positions for c in clips]),
                labels=np.array([c.label for c in clips]),
                sizes=np.array([c.size for c in clips]),
                pinned=np.array(clips[0].pinned),
                fps=np.array(clips[0].fps),
                gravity=clips[0].gravity,
                cloth_size=np.array(clips[0].cloth_size),
            )


def read_transfer(folder: Path) -> list[LabelledClip]:
    """What make_transfer wrote."""
    clips = []
    for path in sorted(folder.glob("transfer_*.npz")):
        with np.load(path, allow_pickle=False) as file:
            clips += [
                LabelledClip(
                    label=str(label),
                    effect=str(label),
                    size=float(size),
                    scene=int(path.stem[-3:]),
                    motion="",
                    positions=positions,
                    pinned=tuple(int(k) for k in file["pinned"]),
                    fps=float(file["fps"]),
                    gravity=file["gravity"],
                    cloth_size=(float(file["cloth_size"][0]), float(file["cloth_size"][1])),
                )
                for label, size, positions in zip(
                    file["labels"], file["sizes"], file["positions"], strict=True
                )
            ]
    return clips


def curve(growing: Examples, held_out: Examples, settings: TrainingSettings) -> Iterator[Row]:
    """Accuracy by number of clips."""
    for share in (0.125, 0.25, 0.5):
        part = split(growing, (share, 1 - share), 1)[0]
        yield from few(trained(part, settings), held_out, f"grown on {len(part)} clips")


def ablation(growing: Examples, held_out: Examples, settings: TrainingSettings) -> Iterator[Row]:
    """Accuracy without groups of features."""
    groups = {
        "balance of forces": ("balance",),
        "torque and energy": ("torque", "energy"),
        "strain and curvature": ("shape",),
        "modes, reach and first moves": ("modes", "extent", "early"),
        "holders": ("holders",),
    }
    yield from few(trained(growing, settings), held_out, "all features, short growth")
    for title, starts in groups.items():
        names = [n for n in growing.names if n.partition(".")[0] not in starts]
        yield from few(trained(growing, settings, names), held_out, f"without {title}")


def few(decision: LearnedDecision, examples: Examples, subset: str) -> list[Row]:
    """The main measures."""
    rows = scored(decision, probabilities(decision, examples), examples.labels, subset)
    return [r for r in rows if r.measure in ("top-1 among effects", "top-3 among effects", "right")]


def measure(training_set: TrainingSet, weights: Path, *, whole: bool) -> list[Row]:
    """All measures of weights and of their training set."""
    clips, sessions = training_set.read()
    growing, _, held_out = split(clips, SHARES, 0)
    decision = LearnedDecision.load(weights)
    rows = measured(decision, held_out)
    others = sessions[len(sessions) // 2 :]
    for n in (1, 2, 3) if others else ():
        causes = np.array([s.labels[0] for s in others])
        rows += scored(decision, session_probabilities(decision, others, n), causes, f"sessions, {n} clips")
    transfer = read_transfer(training_set.folder)
    if transfer:
        for noise in (0.3, 1.0):
            examples = examples_of(transfer, (TRANSFER_SEED,), (noise, noise))
            p = probabilities(decision, examples)
            rows += scored(decision, p, examples.labels, f"fine-grid clips, noise {noise} %")
    if whole:
        settings = TrainingSettings(iterations=50, rate=0.12)
        rows += list(curve(growing, held_out, settings))
        rows += list(ablation(growing, held_out, settings))
    return rows


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("action", choices=("transfer", "measure"))
    parser.add_argument("--folder", type=Path, default=Path("outputs/learned"))
    parser.add_argument("--weights", type=Path, default=None)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--cloths", type=int, default=12)
    parser.add_argument("--clips", type=int, default=10_050)
    parser.add_argument("--sessions", type=int, default=98)
    parser.add_argument("--short", action="store_true", help="neither curve nor ablation")
    parser.add_argument("--output", type=Path, default=Path("docs/results/learned_decision.csv"))
    options = parser.parse_args()
    if options.action == "transfer":
        make_transfer(options.folder, options.minutes, options.cloths)
        return
    training_set = TrainingSet(options.folder, options.clips, options.sessions)
    weights = options.weights or options.folder / "weights.npz"
    write_text(options.output, as_csv(measure(training_set, weights, whole=not options.short)))


if __name__ == "__main__":
    main()
