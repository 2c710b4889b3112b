"""Putting a made template into the folder of its video."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from toile.errors import InputError
from toile.preparation.template_making.making import MadeTemplate
from toile.scenes.native import FILES, write_without_images

DESCRIPTION = "scene.json"


def require_no_template(folder: Path, *, overwrite: bool) -> None:
    """Raise InputError if the folder has a template, or parts of one, and ``overwrite`` is False."""
    there = [name for name in (FILES["template"], FILES["texture"], DESCRIPTION) if (folder / name).exists()]
    if there and not overwrite:
        raise InputError(
            "Scene has a template already",
            where=str(folder),
            expected="a folder without one, or overwrite=true",
            got=", ".join(there),
        )


def write_template(made: MadeTemplate, folder: Path, *, overwrite: bool = False) -> None:
    """Write ``template.obj``, ``texture.png`` and, last of all, ``scene.json``.

    Each file appears when it is complete, the description when everything else does.

    Raises:
        InputError: the folder has a template and ``overwrite`` is False.
    """
    require_no_template(folder, overwrite=overwrite)
    scratch = Path(tempfile.mkdtemp(prefix=".template.", dir=folder))
    try:
        write_without_images(made.scene, scratch, made.n_frames, made.times)
        (folder / DESCRIPTION).unlink(missing_ok=True)
        for name in (FILES["template"], FILES["texture"], DESCRIPTION):
            os.replace(scratch / name, folder / name)
    finally:
        shutil.rmtree(scratch)
