"""``toile template scene=<folder> surface=points surface.file=...``: the grid mesh a fit starts from."""

from __future__ import annotations

import numpy as np
from omegaconf import DictConfig
from rich.table import Table
from rich.text import Text

from toile.cli.configuration import instantiate
from toile.cli.terminal import console, print_path
from toile.errors import InputError
from toile.preparation.template_making.making import MadeTemplate, make_template
from toile.preparation.template_making.still import read_still
from toile.preparation.template_making.surface import Layout
from toile.preparation.template_making.writing import DESCRIPTION, require_no_template, write_template
from toile.reports.figures import save_figure
from toile.reports.template_picture import template_picture
from toile.scenes.native import FILES
from toile.scenes.registry import find_scene

PICTURE = "template.png"


def run(cfg: DictConfig) -> None:
    """Make, check and write the template; print what was measured and where it is."""
    location = find_scene(str(cfg.scene.name), cfg.scene.data_dir)
    if not location.native:
        raise InputError(
            f"Scene {location.name} has a template already",
            where=str(location.folder),
            expected="the folder of your own frames and masks",
            got="a published scene",
        )
    folder = location.folder
    # Said before the work, not after.
    require_no_template(folder, overwrite=cfg.overwrite)
    still = read_still(
        folder, instantiate(cfg.camera), fps=cfg.scene.fps, minimum_component=cfg.scene.minimum_component
    )
    made = make_template(
        still,
        instantiate(cfg.surface),
        Layout(
            grid=tuple(cfg.grid),
            cloth_size=None if cfg.cloth_size is None else tuple(cfg.cloth_size),
            corners=None if cfg.corners is None else _corners(cfg.corners),
        ),
        name=folder.resolve().name,
        pinned_vertices=cfg.scene.pinned_vertices,
        gravity=tuple(cfg.scene.gravity),
        minimum_iou=cfg.minimum_iou,
    )
    write_template(made, folder, overwrite=cfg.overwrite)
    save_figure(template_picture(made), folder / PICTURE)
    _print(made)
    for name in (FILES["template"], FILES["texture"], DESCRIPTION, PICTURE):
        print_path(folder / name)


def _corners(given: object) -> np.ndarray:
    try:
        return np.array([[float(x) for x in corner] for corner in given], dtype=np.float64)  # type: ignore[attr-defined]
    except (TypeError, ValueError) as error:
        raise InputError(
            "Corners cannot be understood",
            where="corners",
            expected="[[x, y], ...] in px: upper left, upper right, lower right, lower left",
            got=str(given),
        ) from error


def _print(made: MadeTemplate) -> None:
    scene, laid = made.scene, made.surface
    title = Text(f"Template of {scene.name}, {scene.grid[0]} x {scene.grid[1]} vertices")
    table = Table("measure", "value", title=title, title_justify="left")
    rows = dict(laid.remarks)
    for name, distances in (
        ("from the input surface to the template", laid.to_template),
        ("from the template to the surface", laid.to_surface),
    ):
        if len(distances):
            rows[name] = f"mean {1e3 * distances.mean():.2f} mm, max {1e3 * distances.max():.2f} mm"
    for axis, lengths in enumerate(made.edges):
        spread = 100 * lengths.std() / lengths.mean()
        rows[f"edges along axis {axis}"] = f"mean {1e3 * lengths.mean():.2f} mm, spread {spread:.2f} %"
    size = " x ".join(f"{side:.4g}" for side in scene.cloth_size)
    rows["cloth size"] = f"{size} m"
    rows["shear angle"] = f"mean {np.abs(made.shear).mean():.2f}°, max {np.abs(made.shear).max():.2f}°"
    rows["IoU of the projection with mask 0"] = f"{made.iou:.3f}"
    rows["pinned vertices"] = ", ".join(map(str, scene.pinned_vertices)) or "none"
    for name, value in rows.items():
        table.add_row(Text(name), Text(value))
    out = console()
    out.print(table)
    for finding in made.warnings:
        out.print(Text(str(finding), style="yellow"))
