"""How far cloth and body are within each other, seen from both sides.

Measured by libigl (closest points by a tree of boxes, inside and outside by winding numbers of the closed
body), which shares nothing with the solver's contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import numpy.typing as npt

from toile.errors import InputError

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

PENETRATION_PROTOCOL = (
    "depth of a free vertex of the cloth within the body, distance to its surface; vertices next to a part "
    "that does not collide (the arms) and vertices fixed to the body left out; mean over penetrating "
    "vertices, mean over all, maximum, and share of vertices and frames, mm and 1"
)
BODY_PENETRATION_PROTOCOL = (
    "distance of a vertex of the body to the nearest place on a face of the cloth, where that place is "
    "within the body, so that the vertex sticks out of the cloth; places on the rim of the cloth left out"
)
REACH = 0.03
"""How far a body vertex may stick out of the cloth to be looked at [m]: any further is another layer."""
_RIM = 1e-6
_GRAZING = 1e-6  # [m]; a face that touches a vertex of the body is not within it


@dataclass(frozen=True)
class Penetration:
    """Penetration in F frames.

    Attributes:
        depths: of the cloth's vertices within the body (F, N) [m], 0 outside, NaN where not measured.
        body_depths: by which vertices of the body stick out of a face of the cloth (F, V) [m], 0 where they
            do not.
    """

    depths: Floats
    body_depths: Floats

    @property
    def maximum(self) -> float:
        """Largest depth of a vertex of the cloth [m]."""
        return float(np.nanmax(self.depths, initial=0.0))

    @property
    def mean(self) -> float:
        """Mean over all measured vertices and frames [m]."""
        return float(np.nanmean(self.depths)) if np.isfinite(self.depths).any() else 0.0

    @property
    def mean_penetrating(self) -> float:
        """Mean over those that penetrate [m], 0 where none does: the figure of Li et al. (2021)."""
        within = self.depths > 0
        return float(self.depths[within].mean()) if within.any() else 0.0

    @property
    def share(self) -> float:
        """Share of the measured vertices and frames that penetrate."""
        measured = np.isfinite(self.depths)
        return float((self.depths > 0).sum() / max(1, measured.sum()))

    @property
    def body_maximum(self) -> float:
        """Farthest that a vertex of the body sticks out of the cloth [m]."""
        return float(self.body_depths.max(initial=0.0))

    @property
    def body_share(self) -> float:
        """Share of the frames in which any vertex of the body sticks out of the cloth."""
        return float((self.body_depths > 0).any(1).mean()) if len(self.body_depths) else 0.0


def penetration(
    cloth: Floats,
    cloth_faces: Indices,
    body: Floats,
    body_faces: Indices,
    *,
    held: Indices | None = None,
    inactive: Mask | None = None,
) -> Penetration:
    """Penetration of a moving cloth with a moving body.

    Args:
        cloth: (F, N, 3) [m].
        cloth_faces: (T, 3).
        body: (F, V, 3) [m].
        body_faces: (Tb, 3), a closed surface, normals outward.
        held: (A,) vertices of the cloth that are fixed to the body; not measured, nor faces of three such.
        inactive: (V,) vertices of the body that the cloth may pass through, e.g. the arms.

    Raises:
        InputError: shapes or numbers of frames do not fit together, or positions are not finite.
    """
    _check(cloth, cloth_faces, body, body_faces)
    passive = np.zeros(body.shape[1], np.bool_) if inactive is None else np.asarray(inactive, np.bool_)
    free = np.ones(cloth.shape[1], np.bool_)
    if held is not None:
        free[held] = False
    passive_faces: Mask = np.asarray(passive[body_faces].any(1))
    looked_at = np.ascontiguousarray(cloth_faces[free[cloth_faces].any(1)])
    rim = _rim_edges(cloth_faces, looked_at)
    depths = np.full(cloth.shape[:2], np.nan)
    body_depths = np.zeros(body.shape[:2])
    cloth, body = np.ascontiguousarray(cloth, np.float64), np.ascontiguousarray(body, np.float64)
    for f, (x, b) in enumerate(zip(cloth, body, strict=True)):
        near = _near(b, x, passive)
        squared, faces, places = igl.point_mesh_squared_distance(b[near], x, looked_at)
        chosen = np.flatnonzero(squared < REACH**2)
        chosen = chosen[~_on_rim(places[chosen], x[looked_at[faces[chosen]]], rim[faces[chosen]])]
        asked = np.concatenate((x[free], places[chosen]))
        signed, nearest, _, _ = igl.signed_distance(
            asked, b, body_faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        )
        active = ~passive_faces[nearest]
        n = int(free.sum())
        depths[f, free] = np.where(active[:n], np.maximum(-signed[:n], 0.0), 0.0)
        within = active[n:] & (signed[n:] < -_GRAZING)
        body_depths[f, near[chosen[within]]] = np.sqrt(squared[chosen[within]])
    return Penetration(depths, body_depths)


def _near(body: Floats, cloth: Floats, passive: Mask) -> Indices:
    """Vertices of the body that take part and lie in the box around the cloth."""
    inside = ((body > cloth.min(0) - REACH) & (body < cloth.max(0) + REACH)).all(1)
    return np.flatnonzero(inside & ~passive)


def _rim_edges(faces: Indices, chosen: Indices) -> Mask:
    """Whether the edge opposite to each corner of the chosen faces (T, 3) has no face on its other side."""
    n = int(faces.max()) + 1

    def keys(of: Indices) -> Indices:
        ends = np.stack([of[:, [1, 2]], of[:, [2, 0]], of[:, [0, 1]]], 1)
        return ends.min(2).astype(np.int64) * n + ends.max(2)

    edges, counts = np.unique(keys(faces), return_counts=True)
    return np.isin(keys(chosen), edges[counts == 1])


def _on_rim(places: Floats, corners: Floats, rim: Mask) -> Mask:
    """Whether places (P, 3) in triangles (P, 3, 3) lie on one of their edges (P, 3) that count."""
    if not len(places):
        return np.zeros(0, np.bool_)
    weights = igl.barycentric_coordinates(places, *(np.ascontiguousarray(corners[:, k]) for k in range(3)))
    on_edge: Mask = np.any((weights < _RIM) & rim, axis=1)
    return on_edge


def _check(cloth: Floats, cloth_faces: Indices, body: Floats, body_faces: Indices) -> None:
    for name, x, faces in (("cloth", cloth, cloth_faces), ("body", body, body_faces)):
        if x.ndim != 3 or x.shape[2] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            got = f"positions {x.shape}, faces {faces.shape}"
            raise _bad(name, "positions (F, N, 3) in metres and faces (T, 3)", got)
        if not np.isfinite(x).all():
            raise _bad(name, "finite positions", f"{int((~np.isfinite(x)).sum())} that are not")
        if faces.size and (faces.min() < 0 or faces.max() >= x.shape[1]):
            raise _bad(name, f"faces of {x.shape[1]} vertices", f"indices up to {faces.max()}")
    if len(cloth) != len(body):
        raise _bad("body", f"{len(cloth)} frames, as the cloth", str(len(body)))


def _bad(where: str, expected: str, got: str) -> InputError:
    return InputError("Cannot measure the penetration", where=where, expected=expected, got=got)
