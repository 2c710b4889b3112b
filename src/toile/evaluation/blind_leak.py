"""Whether the files of a set tell what their labels say, without any look at the cloth.

A linear classifier on statistics of whole files (sizes, brightness, motion energy, mask area) is trained and
tested by cross-validation. Near chance it shows that nulls and effects are matched; what it finds above
chance, a diagnosis could have had without understanding anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toile.errors import InputError
from toile.evaluation.blind_sealing import BlindSet, SealKey
from toile.scenes.images import numbered_files, read_mask, read_rgb

Array = NDArray[np.float64]

_RIDGE = 3.0


@dataclass(frozen=True)
class Leak:
    """How well the classifier does.

    Attributes:
        question: what it was asked.
        accuracy: cross-validated, mean over classes (balanced).
        chance_low, chance_high: 95 % of what it reaches on permuted labels.
        p_value: share of permutations that do at least as well.
        scenes: number of scenes.
    """

    question: str
    accuracy: float
    chance_low: float
    chance_high: float
    p_value: float
    scenes: int


def file_statistics(folder: Path) -> dict[str, float]:
    """Statistics of the files of one scene in the native layout."""
    frames = list(numbered_files(folder / "rgbs", "rgb_").values())
    masks = list(numbered_files(folder / "masks", "mask_").values())
    images = np.stack([read_rgb(p).numpy().mean(-1) for p in frames]).astype(np.float64) / 255
    areas = np.stack([read_mask(p).numpy() > 127 for p in masks])
    area = areas.mean((1, 2))
    brightness = images.sum((1, 2)) / np.maximum(areas.sum((1, 2)), 1)
    moved = np.abs(np.diff(images, axis=0)).mean((1, 2))
    changed = (areas[1:] != areas[:-1]).mean((1, 2))
    sizes = np.array([p.stat().st_size for p in frames], np.float64)
    mask_sizes = np.array([p.stat().st_size for p in masks], np.float64)
    third = max(1, len(images) // 3)
    return {
        "n_frames": float(len(frames)),
        "height": float(images.shape[1]),
        "width": float(images.shape[2]),
        "scene_json": float((folder / "scene.json").stat().st_size),
        "template": float((folder / "template.obj").stat().st_size),
        "rgb_size": float(np.log(sizes.mean())),
        "rgb_size_spread": float(sizes.std() / sizes.mean()),
        "mask_size": float(np.log(mask_sizes.mean())),
        "brightness": float(brightness.mean()),
        "brightness_spread": float(brightness.std()),
        "brightness_drift": float(brightness[-third:].mean() - brightness[:third].mean()),
        "contrast": float(images[0][areas[0]].std()) if areas[0].any() else 0.0,
        "motion": float(moved.mean()),
        "motion_spread": float(moved.std()),
        "mask_area": float(area.mean()),
        "mask_area_spread": float(area.std()),
        "mask_motion": float(changed.mean()),
    }


def leak(
    question: str,
    statistics: Array,
    classes: Sequence[str],
    *,
    seed: int = 0,
    permutations: int = 200,
    folds: int = 5,
) -> Leak:
    """Cross-validated accuracy of a ridge classifier, beside what it reaches by chance.

    Args:
        question: for the table.
        statistics: (n, k), one row per scene.
        classes: of the scenes (n,); classes of fewer than ``folds`` scenes are left out.
        seed: of folds and permutations.
        permutations: of the labels.
        folds: of the cross-validation.

    Raises:
        InputError: fewer than two classes of enough scenes.
    """
    names, index, counts = np.unique(np.array(classes), return_inverse=True, return_counts=True)
    kept = np.isin(index, np.flatnonzero(counts >= folds))
    if (counts >= folds).sum() < 2:
        raise InputError(
            "Too few scenes to look for a leak",
            where=question,
            expected=f"two classes of at least {folds} scenes",
            got=", ".join(f"{n}: {c}" for n, c in zip(names, counts, strict=True)),
        )
    x = statistics[kept]
    y = np.unique(index[kept], return_inverse=True)[1]
    spread = x.std(0)
    x = (x - x.mean(0)) / np.where(spread > 0, spread, 1.0)
    rng = np.random.default_rng(seed)
    accuracy = _accuracy(x, y, folds, np.random.default_rng(seed))
    chance = np.array([_accuracy(x, rng.permutation(y), folds, rng) for _ in range(permutations)])
    low, high = (float(np.quantile(chance, q)) for q in (0.025, 0.975))
    p = float((1 + (chance >= accuracy).sum()) / (1 + permutations))
    return Leak(question, accuracy, low, high, p, len(y))


def leaks_of(blind: BlindSet, key: SealKey, *, seed: int = 0, permutations: int = 200) -> pd.DataFrame:
    """Leaks of a set by generator: effect or none, and the stage; one row per question.

    Opens the labels: for sets that have been graded, or for development.
    """
    names = sorted(blind.names())
    labels = [blind.open(key, name).label for name in names]
    table = pd.DataFrame([file_statistics(blind.scenes / name) for name in names])
    generators = np.array([label.get("generator", "?") for label in labels])
    answers = {
        "effect or none": ["none" if label["effect"] == "none" else "effect" for label in labels],
        "stage": [label["stage"] for label in labels],
    }
    rows = []
    for generator in np.unique(generators):
        chosen = generators == generator
        for question, classes in answers.items():
            try:
                found = leak(
                    f"{question} ({generator})",
                    table[chosen].to_numpy(np.float64),
                    [c for c, inside in zip(classes, chosen, strict=True) if inside],
                    seed=seed,
                    permutations=permutations,
                )
            except InputError:
                continue
            rows.append(vars(found))
    return pd.DataFrame(rows)


def _accuracy(x: Array, y: NDArray[np.int64], folds: int, rng: np.random.Generator) -> float:
    """Balanced accuracy by stratified cross-validation."""
    fold = np.zeros(len(y), np.int64)
    for c in np.unique(y):
        members = np.flatnonzero(y == c)
        fold[rng.permutation(members)] = np.arange(len(members)) % folds
    guess = np.zeros_like(y)
    for k in range(folds):
        train = fold != k
        coefficients = _fit(x[train], y[train], int(y.max()) + 1)
        guess[~train] = (_with_ones(x[~train]) @ coefficients).argmax(1)
    return float(np.mean([(guess[y == c] == c).mean() for c in np.unique(y)]))


def _fit(x: Array, y: NDArray[np.int64], n_classes: int) -> Array:
    """Least squares on class indicators with a ridge; classes weigh the same whatever their size."""
    ones = _with_ones(x)
    weights = 1 / np.bincount(y, minlength=n_classes)[y]
    weights *= len(y) / weights.sum()
    penalty = _RIDGE * np.eye(ones.shape[1])
    penalty[-1, -1] = 1e-9
    gram = ones.T @ (weights[:, None] * ones) + penalty
    right = ones.T @ (weights[:, None] * np.eye(n_classes)[y])
    return np.asarray(np.linalg.solve(gram, right), np.float64)


def _with_ones(x: Array) -> Array:
    return np.concatenate((x, np.ones((len(x), 1))), 1)
