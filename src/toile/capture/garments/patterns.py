"""Skirts and dresses that fit a subject at rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Annotated

import numpy as np
import numpy.typing as npt
import torch

from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.subject import Subject
from toile.capture.garments.embedding import embed
from toile.capture.garments.garment import Garment, Material
from toile.capture.garments.quality import clearance
from toile.capture.garments.sections import (
    Floats,
    Indices,
    grown,
    hull,
    length_of,
    outline,
    plane_section,
    section_support,
)
from toile.capture.garments.tube import Tube, tube
from toile.errors import InputError
from toile.limits import Count, NonNegative, Positive, Unit

LEVEL = 0.005
"""Distance of the sections that a garment is made from [m]."""

# Triangles of rows h √3/2 apart are equilateral.
_ROW = np.sqrt(3.0) / 2
_RESOLUTIONS = (200, 20_000)


@dataclass(frozen=True)
class SkirtPattern:
    """A skirt from the waist down.

    Attributes:
        vertices: how many it should have, about.
        length: from the waist to the hem, vertically.
        ease: distance from the convex hull of the body's sections.
        flare: by how much the skirt widens on every side for each metre down.
        waist: height of the upper edge over the floor; None for the narrowest section.
        waistband: height of the band that is fixed to the body.
        material: what it is made of.
    """

    vertices: Count = 960
    length: Annotated[Positive, Unit("m")] = 0.55
    ease: Annotated[Positive, Unit("m")] = 0.01
    flare: NonNegative = 0.35
    waist: Annotated[Positive, Unit("m")] | None = None
    waistband: Annotated[NonNegative, Unit("m")] = 0.02
    material: Material = field(default_factory=Material)

    def make(self, subject: Subject) -> Garment:
        """Fit it to a subject."""
        return make_skirt(subject, **{name: getattr(self, name) for name in self.__dataclass_fields__})


@dataclass(frozen=True)
class DressPattern:
    """A dress on two straps, from below the armpits down.

    Attributes:
        vertices: how many it should have, about.
        length: from the waist to the hem, vertically.
        ease: distance from the convex hull of the body's sections.
        flare: by how much the skirt widens on every side for each metre down.
        strap_width: of each strap.
        material: what it is made of.
    """

    vertices: Count = 1500
    length: Annotated[Positive, Unit("m")] = 0.6
    ease: Annotated[Positive, Unit("m")] = 0.01
    flare: NonNegative = 0.3
    strap_width: Annotated[Positive, Unit("m")] = 0.04
    material: Material = field(default_factory=Material)

    def make(self, subject: Subject) -> Garment:
        """Fit it to a subject."""
        return make_dress(subject, **{name: getattr(self, name) for name in self.__dataclass_fields__})


@dataclass(frozen=True)
class _Mesh:
    vertices: Floats
    faces: Indices
    attached: Indices


def make_skirt(
    subject: Subject,
    vertices: float = 960,
    length: float = 0.55,
    ease: float = 0.01,
    flare: float = 0.35,
    waist: float | None = None,
    waistband: float = 0.02,
    material: Material | None = None,
) -> Garment:
    """A skirt around the convex hulls of the body's sections, wider with every section down.

    Args:
        subject: who wears it.
        vertices: how many it should have; met to a few percent, since rings are whole.
        length: from the waist to the hem, vertically [m].
        ease: distance from the body's hull [m]; raised where triangles would cut into the body.
        flare: by how much it widens on every side for each metre down.
        waist: height of the upper edge over the floor [m]; None for the narrowest section of the trunk.
        waistband: height of the band fixed to the body [m]; the upper ring always is.
        material: what it is made of; None for light woven cotton.

    Raises:
        InputError: a size that does not fit the subject, or no start without penetration.
    """
    body = _Body.of(subject)
    top = waist_height(subject) if waist is None else waist
    _check_size(subject, vertices, top, length)
    levels = np.arange(top, top - length - LEVEL, -LEVEL)

    @cache
    def outlines(distance: float) -> list[Floats]:
        return _widening(body, levels, distance, flare)

    def build(spacing: float, distance: float, _: float) -> _Mesh:
        made = _rings(levels, outlines(distance), length, spacing)
        held = made.rings <= np.searchsorted(top - made.vertices[made.starts[:-1], 1], waistband + 1e-9) - 1
        return _Mesh(made.vertices, made.faces, np.flatnonzero(held | (made.rings == 0)))

    return _fitted(subject, body, build, vertices, ease, material, "skirt", np.inf)


def make_dress(
    subject: Subject,
    vertices: float = 1500,
    length: float = 0.6,
    ease: float = 0.01,
    flare: float = 0.3,
    strap_width: float = 0.04,
    material: Material | None = None,
) -> Garment:
    """A dress: close to the body down to the waist, wider below, held by two straps over the shoulders.

    Args:
        subject: who wears it.
        vertices: how many it should have; met to a few percent.
        length: from the waist to the hem, vertically [m].
        ease: distance from the body's hull [m]; raised where triangles would cut into the body.
        flare: by how much the skirt widens on every side for each metre down.
        strap_width: of each strap [m]; the rows on top of the shoulder are fixed to the body.
        material: what it is made of; None for light woven cotton.

    Raises:
        InputError: a size that does not fit the subject, or no start without penetration.
    """
    body = _Body.of(subject)
    waist, top = waist_height(subject), armpit_height(subject) - 0.01
    _check_size(subject, vertices, waist, length)
    upper = np.arange(top, waist, -LEVEL)
    lower = np.arange(waist, waist - length - LEVEL, -LEVEL)

    @cache
    def outlines(distance: float) -> list[Floats]:
        close = [outline(body.section(height) + distance) for height in upper]
        return close + _widening(body, lower, distance, flare)

    def build(spacing: float, distance: float, over: float) -> _Mesh:
        made = _rings(np.concatenate((upper, lower)), outlines(distance), top - waist + length, spacing)
        parts = [_Mesh(made.vertices, made.faces, np.empty(0, dtype=np.int64))]
        for side in (1, -1):
            parts.append(_strap(body, made, side, spacing, over, strap_width, sum(map(_count, parts))))
        return _Mesh(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.faces for part in parts]),
            np.concatenate([part.attached for part in parts]),
        )

    return _fitted(subject, body, build, vertices, ease, material, "dress", top + 0.01)


def waist_height(subject: Subject) -> float:
    """Height of the narrowest section between hips and chest [m].

    Raises:
        InputError: the skeleton has no hips and no neck.
    """
    roles = humanoid_joints(subject.joint_names)
    if not {"hips", "neck"} <= set(roles):
        raise InputError(
            "Waist of the subject cannot be found",
            where="subject.joint_names",
            expected="joints for hips and neck by one of the usual names",
            got=", ".join(subject.joint_names[:8]),
        )
    low, high = (float(subject.rest_joints[roles[role], 1, 3]) for role in ("hips", "neck"))
    body = _Body.of(subject)
    heights = np.arange(low, low + 0.6 * (high - low), LEVEL)
    return float(heights[int(np.argmin([length_of(outline(body.section(height))) for height in heights]))])


def armpit_height(subject: Subject) -> float:
    """Height of the lowest place where an arm leaves the trunk [m].

    Raises:
        InputError: the subject has no arms marked.
    """
    arms = subject.parts["arms"]
    on_arm = arms[subject.faces].sum(1)
    mixed = subject.faces[(on_arm > 0) & (on_arm < 3)]
    if not len(mixed):
        raise InputError(
            "Armpits of the subject cannot be found",
            where="subject.parts",
            expected="a mask of the arms that ends at the trunk",
            got=f"{int(arms.sum())} vertices",
        )
    return float(subject.rest_vertices[mixed, 1].min())


class _Body:
    """The trunk and the legs at rest, with sections that are made once."""

    def __init__(self, vertices: Floats, faces: Indices, trunk: Indices, strap_place: float) -> None:
        self.vertices, self.faces, self.trunk = vertices, faces, trunk
        self.strap_place = strap_place
        self._sections: dict[float, Floats] = {}

    @classmethod
    def of(cls, subject: Subject) -> _Body:
        apart = [part for part in ("arms", "head") if part in subject.parts]
        roles = humanoid_joints(subject.joint_names)
        ends = [roles[role] for role in ("left_shoulder", "left_upper_arm") if role in roles]
        places = subject.rest_joints[ends, 0, 3]
        return cls(
            subject.rest_vertices.numpy(),
            subject.faces_without("arms").numpy(),
            subject.faces_without(*apart).numpy(),
            # Half-way along the collar bone.
            float(places.abs().mean()) if ends else 0.055 * subject.height,
        )

    def section(self, height: float) -> Floats:
        """Support function at a height, (D,)."""
        key = round(float(height), 6)
        if key not in self._sections:
            self._sections[key] = section_support(self.vertices, self.faces, height)
        return self._sections[key]


def _widening(body: _Body, levels: Floats, ease: float, flare: float) -> list[Floats]:
    """Outlines that hold those above, widened by the flare, and the body."""
    support = body.section(levels[0]) + ease
    found = [outline(support)]
    for height in levels[1:]:
        support = np.maximum(support + flare * LEVEL, body.section(height) + ease)
        found.append(outline(support))
    return found


def _rings(levels: Floats, outlines: list[Floats], length: float, spacing: float) -> Tube:
    """Rings at equal distances along the mean slope, top and hem included."""
    circumference = np.array([length_of(polygon) for polygon in outlines])
    # A ring is 2π wider for each unit that its radius grows.
    slope = np.hypot(np.diff(levels), np.diff(circumference) / (2 * np.pi))
    along = np.concatenate(([0.0], np.cumsum(slope)))
    end = float(np.interp(length, levels[0] - levels, along))
    rows = max(2, round(end / (spacing * _ROW)))
    heights = np.interp(np.linspace(0.0, end, rows + 1), along, levels)
    nearest = np.clip(np.round((levels[0] - heights) / LEVEL).astype(int), 0, len(levels) - 1)
    return tube([outlines[k] for k in nearest], heights, spacing)


def _strap(
    body: _Body, bodice: Tube, side: int, spacing: float, ease: float, width: float, first: int
) -> _Mesh:
    """Rows of vertices over a shoulder, from the bodice's upper ring in front to that in the back."""
    ring = bodice.vertices[: bodice.starts[1]]
    columns = max(2, round(width / spacing) + 1)
    place, middle = side * body.strap_place, float(ring[:, 2].mean())
    # Around the ring x falls in front and rises in the back: columns go the other way there.
    front = _columns(ring, ring[:, 2] > middle, place, columns, 1)
    back = _columns(ring, ring[:, 2] < middle, place, columns, -1)
    step = min(spacing, 0.05 / (columns - 1))
    tops = place - step * (np.arange(columns) - 0.5 * (columns - 1))
    chains = [
        _over_shoulder(body, ring[f], ring[b], top, ease) for f, b, top in zip(front, back, tops, strict=True)
    ]
    rows = max(4, round(np.mean([_along(chain)[-1] for chain in chains]) / spacing))
    shares = np.linspace(0.0, 1.0, rows + 1)[1:-1]
    grid = np.empty((rows + 1, columns), dtype=np.int64)
    grid[0], grid[-1] = front, back
    grid[1:-1] = first + np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    points = np.stack(
        [
            [np.interp(shares * _along(chain)[-1], _along(chain), chain[:, axis]) for axis in range(3)]
            for chain in chains
        ],
        0,
    )
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    faces = np.stack((np.stack((a, c, b), -1), np.stack((a, d, c), -1)), 2).reshape(-1, 3)
    # Fixed are the rows on top of the shoulder, two at least: one would let the strap turn about itself.
    top = float(shares[int(np.argmax(points[:, 1].mean(0)))])
    held = np.flatnonzero(np.abs(shares - top) <= max(0.05, 1.01 / rows))
    return _Mesh(points.transpose(2, 0, 1).reshape(-1, 3), faces, grid[1:-1][held].ravel())


def _columns(ring: Floats, facing: npt.NDArray[np.bool_], x: float, columns: int, way: int) -> Indices:
    """Successive points on one side of a ring, whose middle is the closest to a place."""
    windows = (np.arange(len(ring))[:, None] + way * np.arange(columns)) % len(ring)
    away = np.where(facing[windows].all(1), np.abs(ring[windows, 0].mean(1) - x), np.inf)
    chosen: Indices = windows[int(np.argmin(away))]
    return chosen


def _over_shoulder(body: _Body, front: Floats, back: Floats, top: float, ease: float) -> Floats:
    """The way from a point in front over the shoulder to one in the back, at a distance from the body.

    It follows the section of the trunk at x = ``top``, and swerves to the two points at its ends.
    """
    points = plane_section(body.vertices, body.trunk, np.array([1.0, 0.0, 0.0]), top).reshape(-1, 3)
    above = points[points[:, 1] > min(front[1], back[1]) - 0.01]
    if len(above) < 3:
        raise InputError(
            "Strap finds no shoulder",
            where="garment",
            expected="a trunk above the upper edge",
            got=f"nothing at x = {top:.3f} m",
        )
    flat = grown(hull(above[:, [2, 1]]), ease)
    over = flat[flat[:, 1] > max(front[1], back[1]) + 0.01]
    # From front to back, seen from the middle of the points at the height of the ends.
    over = over[np.argsort(np.arctan2(over[:, 1] - front[1], over[:, 0] - over[:, 0].mean()))]
    chain = np.stack((np.full(len(over), top), over[:, 1], over[:, 0]), 1)
    chain = np.concatenate((front[None], chain, back[None]))
    share = _along(chain) / _along(chain)[-1]
    # The swerve is over in the first and last third of the way.
    for end, weight in ((front, 1 - 3 * share), (back, 3 * share - 2)):
        chain[1:-1, 0] += (end[0] - top) * _smooth(weight[1:-1])
    return chain


def _smooth(x: Floats) -> Floats:
    """0 below 0, 1 above 1, with zero slope at both."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x), dtype=np.float64)


def _along(chain: Floats) -> Floats:
    return np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))))


def _count(mesh: _Mesh) -> int:
    return len(mesh.vertices)


def _fitted(
    subject: Subject,
    body: _Body,
    build: Callable[[float, float, float], _Mesh],
    vertices: float,
    ease: float,
    material: Material | None,
    name: str,
    upper: float,
) -> Garment:
    """Build with the spacing that gives the number of vertices, and the ease that keeps off the body.

    Chords of coarse rings cut into what they should go around: the ease around the trunk, or that of the
    straps above ``upper``, is raised until there is room.
    """
    spacing = _spacing(lambda spacing: _count(build(spacing, ease, ease)), vertices)
    trunk = straps = ease
    enough = min(0.5 * ease, 0.004)
    for _ in range(20):
        mesh = build(spacing, trunk, straps)
        measured = clearance(mesh.vertices, mesh.faces, body.vertices, body.faces)
        if measured.least >= enough and not measured.crossings:
            break
        missing = np.concatenate((enough - measured.vertices, enough - measured.body))
        above = np.concatenate((mesh.vertices[:, 1], body.vertices[:, 1])) > upper
        more = [float(missing[where].max(initial=-np.inf)) for where in (~above, above)]
        if max(more) <= 0:
            more = [0.0, 0.0]
        # In small steps: a vertex far on the wrong side comes right with the first crossing that goes.
        trunk, straps = (
            at + (min(max(lack, 0.001), 0.003) if lack >= 0 else 0.0)
            for at, lack in zip((trunk, straps), more, strict=True)
        )
    else:
        raise InputError(
            "Garment does not fit the subject without penetration",
            where=f"garment {name}",
            expected=f"{1000 * enough:.1f} mm between cloth and body at rest",
            got=f"{1000 * measured.least:.1f} mm, {measured.crossings} crossings",
        )
    at = torch.from_numpy(mesh.attached)
    points = torch.from_numpy(mesh.vertices)
    usable = ~subject.parts["arms"][subject.faces].any(1)
    held = embed(points[at], subject.rest_vertices, subject.faces, usable)
    return Garment(
        rest_vertices=points,
        faces=torch.from_numpy(mesh.faces),
        attached=at,
        attached_faces=held.faces,
        attached_barycentric=held.barycentric,
        attached_offsets=held.offsets,
        material=material or Material(),
        name=name,
    )


def _spacing(count: Callable[[float], int], wanted: float) -> float:
    """Spacing that gives about the wanted number of vertices: a number falls with its square."""
    spacing = 0.03
    best = (np.inf, spacing)
    for _ in range(8):
        got = count(spacing)
        best = min(best, (abs(np.log(got / wanted)), spacing))
        if abs(got - wanted) <= 0.01 * wanted:
            break
        spacing *= float(np.sqrt(got / wanted))
    return best[1]


def _check_size(subject: Subject, vertices: float, top: float, length: float) -> None:
    low, high = _RESOLUTIONS
    if not low <= vertices <= high:
        raise InputError(
            "Garment has an unusable resolution",
            where="vertices",
            expected=f"{low} to {high}",
            got=str(vertices),
        )
    floor = float(subject.rest_vertices[:, 1].min())
    if not 0.05 < length < top - floor - 0.02:
        raise InputError(
            "Garment has an unusable length",
            where="length",
            expected=f"0.05 to {top - floor - 0.02:.2f} m, above the floor",
            got=f"{length:g} m",
        )


def with_material(garment: Garment, **values: float) -> Garment:
    """The same garment of another material, e.g. ``with_material(skirt, young=1500.0)``."""
    return replace(garment, material=replace(garment.material, **values))
