"""``toile garment``: a skirt, a dress or a mesh of one's own, fitted to a person at rest."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig
from rich.text import Text

from toile.capture.body.subject import load_subject
from toile.capture.garments.checks import check_garment
from toile.capture.garments.quality import clearance
from toile.cli.configuration import instantiate
from toile.cli.new_file import new_file
from toile.cli.terminal import console, print_path
from toile.geometry.io import write_mesh
from toile.geometry.mesh import face_normals


def run(cfg: DictConfig) -> None:
    """Make the garment, write it, say how it fits.

    Raises:
        InputError: the file is there already, a size that does not fit, or an error of ``check_garment``.
    """
    file = new_file(cfg.file, ".npz", cfg.overwrite)
    mesh = None if cfg.mesh is None else new_file(cfg.mesh, ".obj", cfg.overwrite)
    pattern: Any = instantiate(cfg.garment)
    subject = load_subject(str(cfg.subject))
    garment = pattern.make(subject)
    out = console()
    for finding in check_garment(garment, subject, str(file)):
        out.print(Text(str(finding), style="yellow"))
    garment.save(file)
    area = 0.5 * float(face_normals(garment.rest_vertices, garment.faces).norm(dim=-1).sum())
    measured = clearance(
        garment.rest_vertices.numpy(),
        garment.faces.numpy(),
        subject.rest_vertices.numpy(),
        subject.faces_without("arms").numpy(),
    )
    out.print(
        Text(
            f"{len(garment.rest_vertices)} vertices, {len(garment.faces)} triangles, "
            f"{len(garment.attached)} vertices fixed to the body; {area:.2f} m², "
            f"{1000 * area * garment.material.density:.0f} g; "
            f"{1000 * measured.least:.1f} mm from the body at least"
        )
    )
    print_path(file)
    if mesh is not None:
        write_mesh(mesh, garment.rest_vertices, garment.faces.tolist())
        print_path(mesh)
