"""One random scene from the command line: ``python -m toile.generation.blender folder --effect air_drag``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from toile.errors import InputError
from toile.generation.blender.effects import EFFECTS
from toile.generation.blender.scene import blender_scene, matched
from toile.generation.blender.settings import random_settings


def main(arguments: Sequence[str] | None = None) -> int:
    """Make a scene; the label goes to a file beside the folder. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="toile.generation.blender", description=__doc__)
    parser.add_argument("folder", type=Path, help="the scene; its label is written to <folder>.label.json")
    parser.add_argument("--effect", default="none", help=", ".join(EFFECTS))
    parser.add_argument("--parameters", type=json.loads, default={}, help='e.g. {"air_damping": 0.3}')
    parser.add_argument("--gap", type=float, help="wanted gap, as a fraction of the cloth's width")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--small", action="store_true", help="24 x 24 grid, 300 px")
    parser.add_argument("--frames", type=int, help="number of frames")
    parser.add_argument("--python", help="interpreter that has bpy")
    parser.add_argument("--overwrite", action="store_true")
    given = parser.parse_args(arguments)
    try:
        settings = random_settings(
            given.seed,
            given.effect,
            given.parameters,
            name=given.folder.name,
            small=given.small,
            python=given.python,
        )
        if given.frames is not None:
            settings = replace(settings, n_frames=given.frames)
        if given.gap is not None:
            settings = matched(settings, given.gap)
        label = blender_scene(settings, given.folder, overwrite=given.overwrite)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    given.folder.with_name(f"{given.folder.name}.label.json").write_text(json.dumps(label, indent=1) + "\n")
    print(f"{given.folder}: {settings.effect}, gap {100 * label['magnitude']['mean_last_third']:.2f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
