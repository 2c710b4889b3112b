"""Making a data set clip by clip: each appears when it is complete, and what is there is not made again."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

from toile.atomic_file import write_text
from toile.capture.data.clips import TRUTH_FILE, Domain, PlannedClip
from toile.errors import InputError
from toile.json_file import read_json_object
from toile.progress import Report, silent
from toile.scenes.atomic_folder import folder_written_atomically
from toile.scenes.native import write_multi_view_description
from toile.scenes.native_views import view_files
from toile.workers import ALONE, Workers

DATA_FILE = "data.json"
FORMAT = 1


def make_data(domain: Domain, folder: Path, report: Report = silent, workers: Workers = ALONE) -> Path:
    """Make a data set, or what is missing of one that was interrupted.

    ::

        data.json                  format, description, names of the clips
        subject.npz, garment.npz   what all clips share
        000-walk/scene.json        cameras and landmark names (native layout)
        000-walk/truth.npz         see clips.Truth
        000-walk/views/<camera>/   rgb_000.png, mask_000.png, garment_mask_000.png, ..., landmarks.npy

    A clip follows from the description and its number alone, so that an interrupted set is completed with
    the bytes that it would have had.

    Args:
        domain: see Domain.
        folder: target; may hold a part of the same set.
        report: progress.
        workers: make clips beside each other; where there are several, the domain goes to them.

    Returns:
        The folder.

    Raises:
        InputError: the folder holds something else, or a set of another description.
    """
    plans = domain.plans()
    description = _plain({"format": FORMAT, **domain.describe(), "clips": [plan.folder for plan in plans]})
    _claim(folder, description)
    domain.share(folder)
    missing = [plan for plan in plans if not (folder / plan.folder).exists()]
    # What a killed run leaves behind beside its targets.
    for plan in plans:
        for scrap in folder.glob(f".{plan.folder}.*"):
            shutil.rmtree(scrap)
    there = len(plans) - len(missing)
    report("clips", there, len(plans))
    for done, _ in enumerate(workers.map(partial(_make_clip, domain, folder), missing), there + 1):
        report("clips", done, len(plans))
    return folder


def clips_of(folder: Path) -> list[Path]:
    """Folders of the finished clips of a data set; the folder itself if it is one clip.

    Raises:
        InputError: it is no data set.
    """
    if (folder / TRUTH_FILE).is_file():
        return [folder]
    try:
        names = [str(name) for name in read_json_object(folder / DATA_FILE)["clips"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            "Folder is no data set",
            where=str(folder),
            expected=f"{DATA_FILE}, as toile capture data writes it, or one clip with {TRUTH_FILE}",
            got=f"{type(error).__name__}: {error}",
        ) from error
    return [folder / name for name in names if (folder / name / TRUTH_FILE).is_file()]


def _make_clip(domain: Domain, folder: Path, plan: PlannedClip) -> None:
    """One clip; it appears when it is complete."""
    target = folder / plan.folder
    truth = domain.truth(plan)
    with folder_written_atomically(target, overwrite=False) as new:
        new.mkdir()
        recording = domain.film(plan, truth, new)
        files = [view_files(view, f"views/{view.name}") for view in recording.views]
        write_multi_view_description(recording, new, files)
        truth.save(new / TRUTH_FILE, recording)


def _claim(folder: Path, description: dict[str, Any]) -> None:
    """Write the description into a new folder, or check that of an old one."""
    path = folder / DATA_FILE
    if path.is_file():
        try:
            there = read_json_object(path)
        except ValueError as error:
            there = {"data.json": str(error)}
        if there != description:
            differing = [k for k in (*description, *there) if there.get(k) != description.get(k)]
            raise InputError(
                "Folder holds another data set",
                where=str(folder),
                expected="a new folder, or one with the same settings, which is completed",
                got=f"another {', '.join(dict.fromkeys(differing))}",
            )
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "Folder is not empty",
            where=str(folder),
            expected="a new folder, or an interrupted data set",
            got=", ".join(sorted(p.name for p in folder.iterdir())[:5]) if folder.is_dir() else "a file",
        )
    else:
        write_text(path, json.dumps(description, indent=1) + "\n")


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """As JSON gives it back: lists instead of tuples."""
    plain: dict[str, Any] = json.loads(json.dumps(values))
    return plain
