"""``toile subject``: a person to dress, out of the body model ``anny`` or a skinned glTF file."""

from __future__ import annotations

from typing import Any

from omegaconf import DictConfig
from rich.text import Text

from toile.capture.body.humanoid import humanoid_joints
from toile.cli.configuration import instantiate
from toile.cli.new_file import new_file
from toile.cli.terminal import console, print_path
from toile.geometry.io import write_mesh


def run(cfg: DictConfig) -> None:
    """Make the subject, write it, say what it has.

    Raises:
        InputError: the file is there already, or the source is no subject.
    """
    file = new_file(cfg.file, ".npz", cfg.overwrite)
    mesh = None if cfg.mesh is None else new_file(cfg.mesh, ".obj", cfg.overwrite)
    body: Any = instantiate(cfg.body)
    subject = body.make()
    subject.save(file)
    out = console()
    roles = len(humanoid_joints(subject.joint_names))
    out.print(
        Text(
            f"{len(subject.rest_vertices)} vertices, {len(subject.faces)} triangles, "
            f"{len(subject.joint_names)} joints ({roles} known by name), "
            f"{len(subject.landmark_names)} landmarks, {subject.height:.2f} m tall"
        )
    )
    print_path(file)
    if mesh is not None:
        write_mesh(mesh, subject.rest_vertices, subject.faces.tolist())
        print_path(mesh)
