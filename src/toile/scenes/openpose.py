"""2D landmarks as OpenPose writes them: one JSON file per camera and frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from toile.errors import InputError
from toile.json_file import read_json_object
from toile.scenes.views import BODY_25

KEYPOINTS = "pose_keypoints_2d"


def read_openpose(paths: Sequence[Path]) -> tuple[Tensor, int]:
    """Landmarks of the person that each file is most sure of.

    OpenPose counts pixels from the centre of the top-left one; half a pixel is added.

    Args:
        paths: one file per frame.

    Returns:
        (F, 25, 3), float32, x, y [px] and confidence in the order of BODY_25, zeros where nobody was found;
        and the number of frames that show several people.

    Raises:
        InputError: a file is missing, no such JSON, or of another skeleton.
    """
    frames = []
    crowded = 0
    for path in paths:
        people = [_person(path, person) for person in _people(path)]
        crowded += len(people) > 1
        chosen = max(people, key=lambda person: float(person[:, 2].sum()), default=torch.zeros(25, 3))
        seen = chosen[:, 2:] > 0
        shifted = torch.where(seen, chosen[:, :2] + 0.5, 0.0)
        frames.append(torch.cat((shifted, chosen[:, 2:]), 1))
    return (torch.stack(frames) if frames else torch.zeros(0, len(BODY_25), 3)), crowded


def _people(path: Path) -> list[dict[str, object]]:
    try:
        people = read_json_object(path)["people"]
        if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
            raise ValueError("people is no list of objects")
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            "Landmarks cannot be read",
            where=str(path),
            expected=f'OpenPose\'s JSON: {{"people": [{{"{KEYPOINTS}": [...]}}]}}',
            got=f"{type(error).__name__}: {error}",
        ) from error
    return people


def _person(path: Path, person: dict[str, object]) -> Tensor:
    numbers = person.get(KEYPOINTS)
    if not isinstance(numbers, list) or not all(isinstance(x, int | float) for x in numbers):
        raise InputError(
            "Landmarks cannot be read",
            where=f"{path}: {KEYPOINTS}",
            expected="a list of numbers x, y, confidence, ...",
            got=str(numbers)[:80],
        )
    if len(numbers) != 3 * len(BODY_25):
        raise InputError(
            "Landmarks are of another skeleton",
            where=f"{path}: {KEYPOINTS}",
            expected=f"BODY_25, {len(BODY_25)} landmarks of x, y, confidence",
            got=f"{len(numbers)} numbers, {len(numbers) / 3:g} landmarks",
        )
    return torch.tensor(numbers, dtype=torch.float32).reshape(-1, 3)
