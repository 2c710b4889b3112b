"""One mesh for body and garment, as DeepCap has it (Habermann et al., CVPR 2020).

A scan with one surface and one embedded graph: what the graph does it does to body and garment. There is no
attachment, since the surface is one, and nothing knows that cloth and skin could meet.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from toile.capture.body.subject import Subject
from toile.capture.deformation.deform import Deformation, Deformed
from toile.capture.deformation.garment_skinning import SMOOTHING
from toile.capture.deformation.graph import (
    SKIN_RIGIDITY,
    EmbeddedGraph,
    embedded_graph,
    fabric_rigidity,
)
from toile.capture.garments.garment import Garment


def one_piece_graph(subject: Subject, garment: Garment, nodes: int) -> EmbeddedGraph:
    """Graph of body and garment as one mesh, sewn together where the garment is attached.

    Args:
        subject: the person; its V vertices come first.
        garment: its N vertices follow.
        nodes: K, of both together.

    Raises:
        InputError: see ``embedded_graph``.
    """
    body, n_body = subject.rest_vertices, len(subject.rest_vertices)
    corners = subject.faces[garment.attached_faces]
    # A triangle from each attached vertex to an edge of the face that holds it: the paths of the graph cross.
    seam = torch.column_stack((garment.attached + n_body, corners[:, :2]))
    faces = torch.cat((subject.faces, garment.faces + n_body, seam))
    rigidity = torch.full((n_body + len(garment.rest_vertices),), SKIN_RIGIDITY, dtype=torch.float64)
    rigidity[n_body:] = fabric_rigidity(garment.material)
    return embedded_graph(torch.cat((body, garment.rest_vertices)), faces, nodes, rigidity)


class OnePieceDeformation(Deformation):
    """f(θ, α, A, T) with one graph for body and garment.

    Args:
        subject: the person.
        garment: worn by it at rest.
        nodes: K, of both together.
        smoothing: see ``garment_skinning`` [m].
    """

    def __init__(self, subject: Subject, garment: Garment, nodes: int, smoothing: float = SMOOTHING) -> None:
        graph, n_body = one_piece_graph(subject, garment, nodes), len(subject.rest_vertices)
        parts = (slice(n_body, None), slice(0, n_body))
        own, skin = (
            replace(graph, indices=graph.indices[part], weights=graph.weights[part]) for part in parts
        )
        super().__init__(subject, garment, own, skin, smoothing)

    def __call__(
        self,
        angles: Tensor,
        root: Tensor,
        A: Tensor | None = None,
        T: Tensor | None = None,
        body_A: Tensor | None = None,
        body_T: Tensor | None = None,
        *,
        with_body: bool = False,
    ) -> Deformed:
        """See Deformation; A and T are of the body, too, unless it has its own."""
        if body_A is None and body_T is None:
            body_A, body_T = A, T
        return super().__call__(angles, root, A, T, body_A, body_T, with_body=with_body)
