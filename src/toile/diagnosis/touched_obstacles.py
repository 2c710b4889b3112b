"""Where a cloth may touch something that nobody knows of: planes and balls that it comes up to.

Whatever stands in a cloth's way lies beyond all that the cloth reaches, so no vertex is inside it, in no
frame, and many are close to it, though none in frame 0. The refined motion, though, errs by a few percent of
the width along the line of sight, and its outermost vertices are inside. A cloth that swings back comes up to
planes, too, where it turns, and every fold has its ball. What tells them apart is whether a push along the
normal, where the cloth is close, lowers the misfit of the base model, all else being refitted to first order:
of many planes and balls around the refined motion, as large as that lets them be and larger, the one is taken
that lowers it most, and then, as long as that gains, the best of those that lie a little beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from toile.diagnosis.joint_fit import JointFit, JointFitting
from toile.effects.base import Effect, Parameter, VertexEffect
from toile.effects.contact import Contact
from toile.effects.obstacles import Obstacle, Plane, Sphere
from toile.limits import Count, Fraction, NonNegative, Positive, Unit
from toile.physics.step_terms import StepContext
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TouchedSettings:
    """How obstacles that are touched are looked for.

    Attributes:
        margin: distance from which on an obstacle pushes.
        near: distances within which vertices count as close, one after the other.
        inside: by how much an obstacle may be larger than the refined motion lets it be.
        directions: of planes' normals, evenly over the sphere.
        spacing: of the balls' centres, which are tried on a grid around the motion.
        smallest: radius of a ball.
        largest: radius of a ball; what is flatter is a plane.
        each: planes, and balls, that are compared: those that most vertices come close to.
        apart: angle between the normals of two planes at least [°].
        worth: evidence of the best of them below which none is moved [nats].
        asides: by how much the best one is moved, one after the other: a plane's normal by that angle [rad],
            a ball's centre by that share of the width, the surface of both by a quarter of that share.
        moves: by each of them at most.
    """

    margin: Annotated[Positive, Unit("widths")] = 0.02
    near: tuple[Fraction, ...] = (0.02, 0.04, 0.06)
    inside: tuple[Annotated[NonNegative, Unit("widths")], ...] = (0.0, 0.03)
    directions: Count = 1500
    spacing: Annotated[Positive, Unit("widths")] = 0.07
    smallest: Annotated[Positive, Unit("widths")] = 0.08
    largest: Annotated[Positive, Unit("widths")] = 0.8
    each: Count = 40
    apart: Annotated[Positive, Unit("°")] = 16.0
    worth: Annotated[NonNegative, Unit("nats")] = 5.0
    asides: tuple[Fraction, ...] = (0.08, 0.04, 0.02, 0.01)
    moves: Count = 2


DEFAULT = TouchedSettings()


def sphere(n: int) -> Array:
    """Directions evenly over the sphere (n, 3), along a Fibonacci spiral (Swinbank and Purser 2006)."""
    k = np.arange(n) + 0.5
    height = 1 - 2 * k / n
    angle = np.pi * (1 + 5**0.5) * k
    around = np.sqrt(1 - height**2)
    return np.stack((around * np.cos(angle), around * np.sin(angle), height), -1)


@dataclass(frozen=True)
class Met:
    """Something that a motion may have met.

    Attributes:
        touched: as large as the motion lets it be: no vertex is inside.
        inside: by how much it is larger [m].
    """

    touched: Plane | Sphere
    inside: float = 0.0

    @property
    def obstacle(self) -> Plane | Sphere:
        """As large as it is."""
        match self.touched:
            case Plane(point=point, normal=normal):
                return Plane((point + self.inside * normal).tolist(), normal.tolist())
            case Sphere(centre=centre, radius=radius):
                return Sphere(centre.tolist(), radius + self.inside)


@dataclass(frozen=True)
class Swept:
    """All places in which vertices have been, in any frame.

    Attributes:
        positions: of the vertices that are free, frame 0 first (F, N, 3) [m].
        width: of the cloth [m].
        settings: see TouchedSettings.
    """

    positions: Array
    width: float
    settings: TouchedSettings = DEFAULT

    @property
    def margin(self) -> float:
        """Distance from which on an obstacle pushes [m]."""
        return self.settings.margin * self.width

    def plane(self, direction: Array) -> Plane:
        """The plane across a direction (3,) that the vertices come up to and do not pass."""
        farthest = float((self.positions @ direction).max())
        return Plane((farthest * direction).tolist(), (-direction).tolist())

    def ball(self, centre: Array) -> Sphere:
        """The ball around a centre (3,) [m] that the vertices come up to and do not enter."""
        nearest = float(np.linalg.norm(self.positions - centre, axis=-1).min())
        return Sphere(centre.tolist(), max(nearest, 1e-3 * self.width))

    def planes(self, within: float) -> list[Plane]:
        """Planes that many vertices come close to, but none in frame 0, those with most first.

        Args:
            within: distance that counts as close [m].
        """
        directions = sphere(self.settings.directions)
        along = np.einsum("fnd,kd->kfn", self.positions, directions)
        near = along > (along.max((1, 2)) - within)[:, None, None]
        counts = np.where(near[:, 0].any(-1), 0, near.sum((1, 2)))
        cosine = np.cos(np.radians(self.settings.apart))
        kept = _highest(counts, self.settings.each, lambda k: directions @ directions[k] > cosine)
        return [self.plane(directions[k]) for k in kept]

    def balls(self, within: float) -> list[Sphere]:
        """Balls that many vertices come close to, but none in frame 0, those with most first.

        Args:
            within: see ``planes``.
        """
        s, width = self.settings, self.width
        flat = self.positions.reshape(-1, 3)
        lowest, highest = flat.min(0) - 0.5 * width, flat.max(0) + 0.5 * width
        axes = [np.arange(a, b, s.spacing * width) for a, b in zip(lowest, highest, strict=True)]
        centres = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        swept, first = cKDTree(flat), cKDTree(self.positions[0])
        radius = np.asarray(swept.query(centres)[0])
        fits = (radius >= s.smallest * width) & (radius <= s.largest * width)
        fits &= first.query(centres)[0] > radius + within
        centres, radius = centres[fits], radius[fits]
        if not len(centres):
            return []
        counts = np.asarray(swept.query_ball_point(centres, radius + within, return_length=True))
        close = 1.5 * s.spacing * width
        kept = _highest(counts, s.each, lambda k: np.linalg.norm(centres - centres[k], axis=-1) < close)
        return [self.ball(centres[k]) for k in kept]

    def met(self) -> list[Met]:
        """Planes and balls that many vertices come close to, however that is counted, each once."""
        touched: dict[tuple[float, ...], Plane | Sphere] = {}
        for within in (share * self.width for share in self.settings.near):
            near: list[Plane | Sphere] = [*self.planes(within), *self.balls(within)]
            for obstacle in near:
                place = Contact(obstacle).place()
                touched.setdefault(tuple(np.concatenate(list(place.values()))), obstacle)
        insides = [share * self.width for share in self.settings.inside]
        return [Met(obstacle, inside) for obstacle, inside in product(touched.values(), insides)]

    def beside(self, met: Met, aside: float) -> list[Met]:
        """The obstacle, and others of its kind a little aside, see TouchedSettings.asides."""
        obstacle = met.touched
        others: list[Plane | Sphere]
        if isinstance(obstacle, Plane):
            direction = -obstacle.normal.numpy()
            across = np.linalg.svd(direction[None])[2][1:]
            turns = np.pi / 4 * np.arange(8)
            ring = np.stack((np.cos(turns), np.sin(turns)), -1) @ across
            others = [obstacle, *map(self.plane, np.cos(aside) * direction + np.sin(aside) * ring)]
        else:
            moves = aside * self.width * np.array(list(product((-1, 0, 1), repeat=3)), np.float64)
            others = [self.ball(obstacle.centre.numpy() + move) for move in moves]
        further = 0.25 * aside * self.width
        insides = sorted({max(0.0, met.inside + change) for change in (-further, 0.0, further)})
        return [Met(other, inside) for other, inside in product(others, insides)]


@dataclass(frozen=True)
class TouchedObstacles:
    """What the cloth may touch.

    Attributes:
        of_clips: see JointClip.own, of every clip.
    """

    of_clips: list[dict[str, Effect]]


def _highest(counts: NDArray[np.int64], most: int, close: Callable[[int], NDArray[np.bool_]]) -> list[int]:
    """Places of the counts (K,) that are highest among those close to them, the highest first.

    Args:
        counts: above 0 where they count.
        most: places.
        close: which places are close to one (K,).
    """
    left = counts > 0
    kept: list[int] = []
    for k in map(int, np.argsort(-counts, kind="stable")):
        if len(kept) == most or not counts[k]:
            break
        if left[k]:
            kept.append(k)
            left &= ~close(k)
    return kept


def touching(
    fitting: JointFitting,
    base: JointFit,
    settings: TouchedSettings = DEFAULT,
    workers: Workers = ALONE,
) -> TouchedObstacles:
    """For every clip contact, at zero, with the obstacle that explains most; nothing where no push helps.

    Args:
        fitting: the problem of all clips.
        base: the base model, fitted.
        settings: see TouchedSettings.
        workers: share the windows of a clip.
    """
    found = [_of_clip(fitting, base, c, settings, workers) for c in range(len(fitting.clips))]
    return TouchedObstacles([{} if contact is None else {contact.NAME: contact} for contact in found])


def _of_clip(
    fitting: JointFitting, base: JointFit, c: int, settings: TouchedSettings, workers: Workers
) -> Contact | None:
    clip = fitting.clips[c]
    free = clip.shooting.free[:, 0] > 0
    # Not as the base model moves: that knows of no obstacle, and its cloth goes through it.
    positions = clip.shooting.tracked.positions[: base.windows[c][-1].last + 1, free]
    swept = Swept(positions, clip.around.cloth_size[0], settings)

    def best_of(tried: Sequence[Met]) -> tuple[float, Met]:
        pushes = _Pushes([met.obstacle for met in tried], swept.margin)
        drops = _drops(fitting, base, c, pushes, workers)
        k = int(np.argmax(drops))
        return float(drops[k]), tried[k]

    tried = swept.met()
    if not tried:
        return None
    drop, best = best_of(tried)
    if drop <= 0:
        return None
    for aside in settings.asides if drop >= settings.worth else ():
        for _ in range(settings.moves):
            before = drop
            drop, best = best_of(swept.beside(best, aside))
            if drop - before < fitting.settings.nothing:
                break
    return Contact(best.obstacle, thickness=swept.margin)


class _Pushes(VertexEffect):
    """What many obstacles would each push, without friction: their stiffnesses, at zero.

    Args:
        obstacles: one for each parameter.
        thickness: distance from which on they push [m].
    """

    NAME = Contact.NAME
    STAGE = Contact.STAGE
    SCOPE = Contact.SCOPE
    PARAMETERS = Contact.PARAMETERS[:1]
    SOURCE = Contact.SOURCE
    past_reach = 0

    def __init__(self, obstacles: Sequence[Obstacle], thickness: float) -> None:
        self._obstacles, self._thickness = tuple(obstacles), thickness
        super().__init__()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """See Effect."""
        (stiffness,) = self.PARAMETERS
        return tuple(replace(stiffness, name=f"{stiffness.name}_{k}") for k in range(len(self._obstacles)))

    def energy(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexTerm."""
        return 0.5 * now.cloth.masses * (self.values[:, None] * self._depths(positions, now).square()).sum(0)

    def force_derivatives(self, positions: Tensor, now: StepContext) -> Tensor:
        """See VertexEffect."""
        normals = torch.stack([obstacle.normals(positions) for obstacle in self._obstacles])
        return (now.cloth.masses * self._depths(positions, now))[..., None] * normals

    def _depths(self, positions: Tensor, now: StepContext) -> Tensor:
        """By how much vertices are nearer than pushes begin (K, N) [m]."""
        away = torch.stack([obstacle.distance(positions, now.positions) for obstacle in self._obstacles])
        return (self._thickness - away).clamp(min=0.0)


def _drops(
    fitting: JointFitting, base: JointFit, c: int, pushes: _Pushes, workers: Workers
) -> NDArray[np.float64]:
    """By how much the misfit of one clip falls with each of the pushes alone (K,) [nats]."""
    usual = fitting.usual_in(base)
    whole = fitting.layout(usual)
    values = base.values[: len(fitting.start)]
    alone = JointFitting([fitting.clips[c]], fitting.start, values, fitting.settings, usual)
    there = np.concatenate([np.zeros(0, np.intp), *whole.coefficients(c)])
    here = replace(
        base,
        values=base.values[whole.base(c)],
        coefficients=base.coefficients[there],
        windows=[base.windows[c]],
        effects=[base.effects[c]],
    )
    considered = [pushes, *usual]
    evidence = alone.quadratic(considered, here, alone.systems(considered, here, workers))
    layout = alone.layout(considered)
    own, *others = [[layout.n_base + place for place in places] for places in layout.places]
    settings = fitting.settings
    wide = [settings.inflation(effect) for effect in usual for _ in effect.scales]
    information, score = evidence.information(own, alone.size, list(chain.from_iterable(others)), wide)
    precision = np.diag(information) + settings.inflation(Contact()) ** -2
    return np.asarray(0.5 * np.clip(score, 0.0, None) ** 2 / precision)
