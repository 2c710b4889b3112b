"""Whether the files of a set tell what their labels say, without any look at the cloth.

A linear classifier on statistics of whole files (sizes, time stamps, entries of scene.json, brightness,
motion energy, mask area) is trained and tested by cross-validation. Near chance it shows that nulls and
effects are matched; what it finds above chance, a diagnosis could have had without understanding anything.
Whether it would find a leak at all is measured with leaks that are planted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.linear_model import RidgeClassifier
from sklearn.model_selection import StratifiedKFold, cross_val_score, permutation_test_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from toile.blind.sealing import BlindSet, SealKey
from toile.errors import InputError
from toile.json_file import read_json_object
from toile.scenes.images import numbered_files, read_mask, read_rgb

Array = NDArray[np.float64]

# Classes weigh the same whatever their size.
_CLASSIFIER = make_pipeline(StandardScaler(), RidgeClassifier(3.0, class_weight="balanced"))
_SCORE = "balanced_accuracy"


@dataclass(frozen=True)
class Leak:
    """How well the classifier does.

    Attributes:
        question: what it was asked.
        accuracy: cross-validated, mean over classes (balanced) and folds.
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
    files = [p for p in folder.rglob("*") if p.is_file()]
    stamps = np.array([p.stat().st_mtime for p in files], np.float64)
    values = read_json_object(folder / "scene.json")
    return {
        "files": float(len(files)),
        "time_stamp": float(np.median(stamps)),
        "time_stamp_spread": float(stamps.std()),
        "json_keys": float(_keys(values)),
        "fps": float(values["fps"]),
        "focal_length": float(values["K"][0][0]) / float(images.shape[2]),
        "gravity_down": float(values["gravity"][1]),
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
    folds = max(folds, 2)
    names, index, counts = np.unique(np.array(classes), return_inverse=True, return_counts=True)
    kept = np.isin(index, np.flatnonzero(counts >= folds))
    if (counts >= folds).sum() < 2:
        raise InputError(
            "Too few scenes to look for a leak",
            where=question,
            expected=f"two classes of at least {folds} scenes",
            got=", ".join(f"{n}: {c}" for n, c in zip(names, counts, strict=True)),
        )
    accuracy, chance, p_value = permutation_test_score(
        _CLASSIFIER,
        statistics[kept],
        index[kept],
        cv=StratifiedKFold(folds, shuffle=True, random_state=seed),
        n_permutations=permutations,
        random_state=seed,
        scoring=_SCORE,
    )
    low, high = np.quantile(chance, (0.025, 0.975))
    return Leak(question, float(accuracy), float(low), float(high), float(p_value), int(kept.sum()))


def leaks_of(
    sets: Sequence[tuple[BlindSet, SealKey]], *, seed: int = 0, permutations: int = 200
) -> pd.DataFrame:
    """Leaks of sets taken together, see leaks.

    Opens the labels: for sets that have been graded, or for development.
    """
    scenes = [(blind, key, name) for blind, key in sets for name in sorted(blind.names())]
    labels = [blind.open(key, name).label for blind, key, name in scenes]
    statistics = pd.DataFrame([file_statistics(blind.scenes / name) for blind, _, name in scenes])
    truth = pd.DataFrame(
        {
            "generator": [label.get("generator", "?") for label in labels],
            "effect": [label["effect"] for label in labels],
            "stage": [label["stage"] for label in labels],
        }
    )
    return leaks(statistics, truth, seed=seed, permutations=permutations)


def leaks(
    statistics: pd.DataFrame, truth: pd.DataFrame, *, seed: int = 0, permutations: int = 200
) -> pd.DataFrame:
    """What the classifier finds, one row per generator and question; those with too few scenes are left out.

    Generators make different scenes, so each is a question of its own: effect or none, which stage, and,
    where an effect comes at least twice, which effect.

    Args:
        statistics: of file_statistics, one row per scene.
        truth: ``generator``, ``effect`` and ``stage`` of the same scenes; "none" for nulls.
        seed: of folds and permutations.
        permutations: of the labels.
    """
    any_effect = np.where(truth["effect"] == "none", "none", "effect")
    # Folds at most: as many as keep most classes in.
    questions: dict[str, tuple[Sequence[str], int]] = {
        "effect or none": (any_effect.tolist(), 5),
        "stage": (truth["stage"].tolist(), 3),
        "effect": (truth["effect"].tolist(), 2),
    }
    rows = []
    for generator in sorted(truth["generator"].unique()):
        chosen = (truth["generator"] == generator).to_numpy()
        for question, (classes, most) in questions.items():
            folds = _folds(any_effect[chosen], most) if question == "effect or none" else most
            try:
                found = leak(
                    question,
                    statistics[chosen].to_numpy(np.float64),
                    [c for c, inside in zip(classes, chosen, strict=True) if inside],
                    seed=seed,
                    permutations=permutations,
                    folds=folds,
                )
            except InputError:
                continue
            rows.append({"generator": generator, **vars(found)})
    columns = ["generator", "question", "accuracy", "chance_low", "chance_high", "p_value", "scenes"]
    return pd.DataFrame(rows, columns=columns)


PLANTED: Mapping[str, tuple[str, float]] = {
    "nothing (shuffled labels)": ("files", 0.0),
    "one more key in scene.json": ("json_keys", 1.0),
    "files made 1 s later": ("time_stamp", 1.0),
    "images 20 % brighter": ("brightness", 0.2),
    "images 60 % brighter": ("brightness", 0.6),
    "masks 60 % larger": ("mask_area", 0.6),
}
"""Leaks to plant: a statistic and what scenes with an effect have more of it; shares for those of images."""

_SHARES = ("brightness", "mask_area")


def power(
    statistics: pd.DataFrame,
    truth: pd.DataFrame,
    *,
    seed: int = 0,
    draws: int = 30,
    permutations: int = 2,
    level: float = 0.05,
) -> pd.DataFrame:
    """How often the classifier tells effect from none where a leak is planted, and where there is none.

    In every draw the labels are shuffled first, so that nothing but what is planted can be found. What is
    reached by chance is the same in all draws, so each is compared with the permutations of all.

    Args:
        statistics: see leaks.
        truth: see leaks.
        seed: of everything random.
        draws: of labels.
        permutations: of the labels in every draw.
        level: p-value below which a leak counts as found.

    Returns:
        Columns: generator, planted, found (share of the draws), accuracy (mean), scenes, draws.
    """
    rows = []
    for generator in sorted(truth["generator"].unique()):
        chosen = (truth["generator"] == generator).to_numpy()
        table = statistics[chosen].reset_index(drop=True)
        classes = np.where(truth["effect"][chosen] == "none", "none", "effect")
        folds = _folds(classes, 5)
        if folds < 2:
            continue
        for planted, (column, amount) in PLANTED.items():
            rng = np.random.default_rng(seed)
            reached, chance = [], []
            for _ in range(draws):
                labels = rng.permutation(classes)
                changed = table.copy()
                more = amount * (changed[column] if column in _SHARES else 1.0)
                changed[column] = changed[column] + more * (labels == "effect")
                shuffled = [labels, *(rng.permutation(labels) for _ in range(permutations))]
                first, *others = (_accuracy(changed.to_numpy(np.float64), y, folds, rng) for y in shuffled)
                reached.append(first)
                chance += others
            at_least = (np.array(chance) >= np.array(reached)[:, None]).sum(1)
            p_values = (1 + at_least) / (1 + len(chance))
            rows.append(
                {
                    "generator": generator,
                    "planted": planted,
                    "found": float((p_values < level).mean()),
                    "accuracy": float(np.mean(reached)),
                    "scenes": len(table),
                    "draws": draws,
                }
            )
    return pd.DataFrame(rows, columns=["generator", "planted", "found", "accuracy", "scenes", "draws"])


def _folds(classes: NDArray[np.str_], most: int) -> int:
    """Folds that leave neither of two classes out; 2 at least, unless one has a single scene or none."""
    fewest = min(int((classes == name).sum()) for name in ("none", "effect"))
    return min(most, fewest)


def _keys(values: Any) -> int:
    """Number of keys in JSON values, nested ones included."""
    if isinstance(values, dict):
        return len(values) + sum(_keys(v) for v in values.values())
    return 0


def _accuracy(x: Array, y: NDArray[np.str_], folds: int, rng: np.random.Generator) -> float:
    """Cross-validated accuracy of the classifier."""
    cv = StratifiedKFold(folds, shuffle=True, random_state=int(rng.integers(2**31)))
    return float(cross_val_score(_CLASSIFIER, x, y, cv=cv, scoring=_SCORE).mean())
