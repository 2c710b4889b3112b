"""Which effects leave the same trace in a session, which leave none, and how weak they may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.evidence import Evidence
from toile.diagnosis.joint_fit import JointFitting
from toile.diagnosis.record import Alias
from toile.effects.base import Effect
from toile.effects.catalogue import OUTSIDE, PUSHING, STAND_INS, WEIGHING

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SessionAlias:
    """What clips can tell apart.

    Attributes:
        alias: traces alike, and detection limits.
        unseen: causes from outside that leave no trace of their own however strong they are, such as a tilt
            of gravity, which is a steady wind to clips without a plumb line: one answer with none, whose base
            model has such a wind. How strong winds usually are is no trace of a tilt. What acts within the
            cloth is not said to be unseen: the stiffness that hides it was fitted without it.
    """

    alias: Alias
    unseen: tuple[str, ...]


def session_alias(
    fitting: JointFitting,
    effects: Sequence[Effect],
    quadratic: Evidence,
    needed: float,
    scale: float,
) -> SessionAlias:
    """Alias matrix and detection limits around the base model.

    Traces are those that refitted material, winds and starts leave.

    Args:
        fitting: the problem.
        effects: that move the cloth; stand-ins, which take up nearly anything, are left out.
        quadratic: of these effects around the base model, see JointFitting.quadratic.
        needed: evidence from which on an effect is seen [nats].
        scale: by which misfits are too large, see session_evidence.
    """
    fisher = quadratic.fisher(fitting.size) / scale
    in_any_wind = fitting.in_any_wind(quadratic).fisher(fitting.size) / scale
    pairs = zip(effects, fitting.layout(effects).places, strict=True)
    kept = [(effect, own) for effect, own in pairs if effect.NAME not in STAND_INS]
    places = [own for _, own in kept]
    names = [effect.NAME for effect, _ in kept]
    roots = [_inverse_root(fisher[np.ix_(own, own)]) for own in places]
    matrix = np.eye(len(names))
    for i in range(len(names)):
        for j in range(i):
            cross = roots[i] @ fisher[np.ix_(places[i], places[j])] @ roots[j]
            matrix[i, j] = matrix[j, i] = min(1.0, float(np.linalg.norm(cross, 2)))
    limits: dict[str, float | None] = {}
    unseen = []
    for effect, own in kept:
        parameter = effect.parameters[0]
        information = float(fisher[own[0], own[0]])
        limit = float(np.sqrt(2 * needed / max(information, 1e-12))) * parameter.scale
        limits[effect.NAME] = limit if limit <= max(abs(parameter.low), abs(parameter.high)) else None
        strongest = max(max(abs(p.low), abs(p.high)) / p.scale for p in effect.parameters)
        most = float(np.linalg.eigvalsh(in_any_wind[np.ix_(own, own)])[-1])
        from_outside = effect.NAME in OUTSIDE and effect.NAME not in (*PUSHING, *WEIGHING)
        if from_outside and 0.5 * most * strongest**2 < needed:
            unseen.append(effect.NAME)
    alias = Alias(tuple(names), tuple(tuple(map(float, row)) for row in matrix), limits)
    return SessionAlias(alias, tuple(unseen))


def _inverse_root(block: Array) -> Array:
    values, vectors = np.linalg.eigh(block + 1e-3 * np.eye(len(block)))
    return np.asarray(vectors / np.sqrt(np.maximum(values, 1e-9)) @ vectors.T)
