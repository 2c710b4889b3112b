"""What is wrong with a garment: its mesh, its size, and where it is on the body at rest."""

from __future__ import annotations

from collections.abc import Iterator

import igl
import numpy as np

from toile.capture.body.subject import Subject
from toile.capture.garments.garment import Garment
from toile.capture.garments.quality import clearance, triangle_quality
from toile.capture.garments.sections import Floats, Indices
from toile.scenes.findings import Finding, Severity

LEAST_QUALITY = 0.1
"""Of a triangle, 4√3 A / (a² + b² + c²), below which it is named."""

_UNITS = (("millimetres", 1000.0), ("inches", 39.37), ("centimetres", 100.0))
_VERTICES = (200, 20_000)


def check_garment(garment: Garment, subject: Subject, where: str) -> list[Finding]:
    """Everything that can be said against simulating a garment on a subject; [] if nothing.

    Args:
        garment: to check.
        subject: who wears it, at rest.
        where: file or name, for messages.
    """
    vertices, faces = garment.rest_vertices.numpy(), garment.faces.numpy()
    findings = [*_mesh(vertices, faces, where)]
    size = [*_size(vertices, subject, where)]
    findings += size
    if not size and not any(finding.severity is Severity.ERROR for finding in findings):
        findings += _start(garment, subject, where)
    if not len(garment.attached):
        findings.append(
            Finding(
                Severity.WARNING,
                "Garment is not fixed to the body",
                where,
                "a waistband or straps, unless it hangs on the body by itself",
                "no attached vertices",
            )
        )
    return findings


def _mesh(vertices: Floats, faces: Indices, where: str) -> Iterator[Finding]:
    expected = "a manifold surface: one or two triangles at every edge, one fan at every vertex"
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    shared, count = np.unique(edges, axis=0, return_counts=True)
    if (count > 2).any():
        a, b = shared[count > 2][0]
        got = f"{int((count > 2).sum())} edges with more than two triangles, the first is {a}-{b}"
        yield Finding(Severity.ERROR, "Garment is not manifold", where, expected, got)
    elif not (fans := np.asarray(igl.is_vertex_manifold(faces))).all():
        got = f"{int((~fans).sum())} vertices where the surface only touches itself, "
        got += f"the first is {int(np.flatnonzero(~fans)[0])}"
        yield Finding(Severity.ERROR, "Garment is not manifold", where, expected, got)
    directed, turned = np.unique(
        faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=0, return_counts=True
    )
    if (turned > 1).any() and not (count > 2).any():
        a, b = directed[turned > 1][0]
        yield Finding(
            Severity.ERROR,
            "Garment has no two sides",
            where,
            "triangles that can be oriented alike",
            f"both triangles at edge {a}-{b} go the same way",
        )
    quality = triangle_quality(vertices, faces)
    if (quality < 1e-6).any():
        bad = np.flatnonzero(quality < 1e-6)
        got = f"{len(bad)} triangles without area, the first is {int(bad[0])}"
        yield Finding(Severity.ERROR, "Garment has degenerate triangles", where, "triangles with area", got)
    elif (quality < LEAST_QUALITY).any():
        bad = np.flatnonzero(quality < LEAST_QUALITY)
        got = f"{len(bad)} triangles, the worst is {int(quality.argmin())} with {quality.min():.3f}"
        yield Finding(
            Severity.WARNING, "Garment has thin triangles", where, f"quality above {LEAST_QUALITY:g}", got
        )
    unused = np.setdiff1d(np.arange(len(vertices)), faces)
    if len(unused):
        got = f"{len(unused)} vertices of no face, the first is {int(unused[0])}"
        yield Finding(Severity.ERROR, "Garment has loose vertices", where, "vertices with triangles", got)
    low, high = _VERTICES
    if not low <= len(vertices) <= high:
        yield Finding(
            Severity.WARNING,
            "Garment has an unusual resolution",
            where,
            f"{low} to {high} vertices",
            f"{len(vertices)}",
        )


def _size(vertices: Floats, subject: Subject, where: str) -> Iterator[Finding]:
    extent, height = float(np.ptp(vertices, axis=0).max()), subject.height
    if 0.05 * height < extent < 1.5 * height:
        return
    expected = f"metres: an extent of {0.05 * height:.2f} to {1.5 * height:.2f}"
    guess = [name for name, factor in _UNITS if 0.05 * height < extent / factor < 1.5 * height]
    got = f"an extent of {extent:g}" + (f", which would fit {' or '.join(guess)}" if guess else "")
    yield Finding(Severity.ERROR, "Garment has other units than metres", where, expected, got)


def _start(garment: Garment, subject: Subject, where: str) -> Iterator[Finding]:
    body_faces = subject.faces_without("arms").numpy()
    measured = clearance(
        garment.rest_vertices.numpy(), garment.faces.numpy(), subject.rest_vertices.numpy(), body_faces
    )
    if measured.vertices.min() > 0.1:
        yield Finding(
            Severity.ERROR,
            "Garment is not on the body",
            where,
            "the subject's frame: metres, y up, facing +z, floor at y = 0",
            f"the closest vertex is {measured.vertices.min():.2f} m away",
        )
    inside = np.flatnonzero(measured.vertices <= 0)
    through = np.flatnonzero(measured.body <= 0)
    if len(inside) or len(through) or measured.crossings:
        got = (
            f"{len(inside)} vertices up to {1000 * max(-measured.vertices.min(), 0.0):.1f} mm inside, "
            f"{len(through)} vertices of the body up to {1000 * max(-measured.body.min(), 0.0):.1f} mm "
            f"through the cloth, {measured.crossings} crossing edges"
        )
        yield Finding(
            Severity.ERROR,
            "Garment intersects the body at rest",
            where,
            "cloth outside the body, normals away from it",
            got,
        )
