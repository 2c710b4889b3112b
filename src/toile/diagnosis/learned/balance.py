"""The balance of forces in weak form: what the accelerations lack of gravity, and which forces fill the gap.

Momentum per mass, tested with smooth functions ψ over the cloth and three directions,
∫ ψ (a - g) = -∫ σ : sym(∇ψ t) + reactions + forces. Stresses within the surface σ are not known, because
strains are smaller than the noise, so they are nuisances with a wide prior: the tests are whitened by the
covariance that they make, together with the noise. What is left of the balance tells the rest (the virtual
fields of Pierron and Grédiac, 2012, with the fields found by the covariance).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.learned.fields import Fields, dot
from toile.diagnosis.learned.motion import TEST_DEGREE, basis
from toile.diagnosis.learned.regression import Blocks

Array = NDArray[np.float64]

BASE = ("wind", "wind_normal", "bending", "in_plane")
"""Blocks of the base model."""

_STRESS = 10.0  # of the lowest modes, of weight over width; wide, since forces gather at the pins
_FINER = 1.4  # a mode's variance falls by it with every degree
_REACTION = 30.0
_MODEL = 0.03  # g; error of a test beside the noise of tracking
_RIGHT, _DOWN, _AHEAD = np.eye(3)


@dataclass(frozen=True)
class Balance:
    """Whitened target and regressors of a clip.

    Attributes:
        blocks: all regressors, those of BASE among them.
        target: (F', T) whitened; regressors by block (F', T, k).
        whitening: (F', T, T).
        stress_gain: (F', 3 J, T) from a whitened residual to the mean of the modes of in-plane stress.
    """

    blocks: Blocks
    target: Array
    regressors: Mapping[str, Array]
    whitening: Array
    stress_gain: Array


def balance(fields: Fields) -> Balance:
    """Set up the balance of a clip."""
    tests = _Tests(fields)
    stress, reactions = tests.stress_columns(), tests.reaction_columns()
    prior = _stress_prior()
    wide = stress * np.sqrt(prior)
    covariance = np.matmul(wide, np.swapaxes(wide, 1, 2)) + _REACTION**2 * (reactions @ reactions.T)
    noise = _MODEL**2 + fields.motion.acceleration_noise**2
    covariance += noise * np.eye(covariance.shape[-1])
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    raw_target = tests.of(fields.a - _DOWN)
    regressors = _regressors(fields, tests)
    stacked = np.concatenate([*regressors.values(), raw_target[..., None]], -1)
    white = np.matmul(whitening, stacked)
    flat = white.reshape(-1, white.shape[-1])
    blocks, start = {}, 0
    split = {}
    for name, block in regressors.items():
        blocks[name] = flat[:, start : start + block.shape[-1]]
        split[name] = white[..., start : start + block.shape[-1]]
        start += block.shape[-1]
    result = Blocks.of(flat[:, -1], blocks, correlated=fields.correlated)
    gain = np.matmul((prior[:, None] * np.swapaxes(stress, 1, 2)), np.swapaxes(whitening, 1, 2))
    return Balance(result, white[..., -1], split, whitening, gain)


def _stress_prior() -> Array:
    """Variances of the modes of the three stresses, lower for finer ones."""
    k = np.arange(TEST_DEGREE + 1)
    one = _STRESS**2 * _FINER ** -(k[:, None] + k[None]).ravel()
    return np.tile(one, 3)


class _Tests:
    """Projections on test functions, as vectors (F', 3 J) of all functions in all directions."""

    def __init__(self, fields: Fields) -> None:
        b = basis()
        self.fields = fields
        su, sv = fields.motion.sides
        w = b.weights[:, None]
        self.value = (w * b.test).T
        self.du, self.dv = (w * b.test_du).T / su, (w * b.test_dv).T / sv
        self.duu, self.dvv = (w * b.test_duu).T / su**2, (w * b.test_dvv).T / sv**2

    def of(self, force: Array) -> Array:
        """Of a force per mass (F', Q, 3)."""
        return np.matmul(self.value, force).reshape(len(force), -1)

    def bending(self, moment_u: Array | None, moment_v: Array | None) -> Array:
        """Of moments (F', Q) along both directions, per mass."""
        n = self.fields.n
        total: Array | float = 0.0
        for matrix, moment in ((self.duu, moment_u), (self.dvv, moment_v)):
            if moment is not None:
                total = total - np.matmul(matrix, moment[..., None] * n)
        return np.asarray(total).reshape(len(n), -1)

    def stress(self, uu: Array | None = None, vv: Array | None = None, uv: Array | None = None) -> Array:
        """Of stresses (F', Q) within the surface, per mass."""
        f = self.fields
        along_u: Array | float = 0.0
        along_v: Array | float = 0.0
        if uu is not None:
            along_u = along_u + uu[..., None] * f.tu
        if vv is not None:
            along_v = along_v + vv[..., None] * f.tv
        if uv is not None:
            along_u, along_v = along_u + uv[..., None] * f.tv, along_v + uv[..., None] * f.tu
        total: Array | float = 0.0
        for matrix, part in ((self.du, along_u), (self.dv, along_v)):
            if not isinstance(part, float):
                total = total - np.matmul(matrix, part)
        return np.asarray(total).reshape(len(f.n), -1)

    def viscous(self) -> Array:
        """Of friction between neighbours."""
        f = self.fields
        force = -(np.matmul(self.du, f.vu) + np.matmul(self.dv, f.vv))
        return force.reshape(len(f.n), -1)

    def stress_columns(self) -> Array:
        """Of all modes of the three stresses (F', 3 J, 3 J)."""
        f, modes = self.fields, basis().test
        F, J = len(f.n), modes.shape[1]
        pairs_u = (self.du[:, None] * modes.T[None]).reshape(J * J, -1)
        pairs_v = (self.dv[:, None] * modes.T[None]).reshape(J * J, -1)

        def forces(pairs: Array, tangent: Array) -> Array:
            flat = tangent.transpose(1, 0, 2).reshape(len(modes), -1)
            return (pairs @ flat).reshape(J, J, F, 3).transpose(2, 0, 3, 1).reshape(F, 3 * J, J)

        uu, vv = forces(pairs_u, f.tu), forces(pairs_v, f.tv)
        uv = forces(pairs_u, f.tv) + forces(pairs_v, f.tu)
        return -np.concatenate([uu, vv, uv], -1)

    def reaction_columns(self) -> Array:
        """Of a force at every pinned vertex (3 J, 3 k)."""
        b = basis()
        # Test functions at the vertices nearest to the pins, by their values at the quadrature's grid.
        places = self.fields.motion.pin_places
        values = _test_at(places)
        J = b.test.shape[1]
        result = np.zeros((J, 3, len(places), 3))
        for c in range(3):
            result[:, c, :, c] = values.T
        return result.reshape(3 * J, -1)


def _test_at(places: Array) -> Array:
    """Test functions (k, J) at places (k, 2)."""
    from toile.diagnosis.learned.motion import _along

    u = _along(TEST_DEGREE, places[:, 0], 0)
    v = _along(TEST_DEGREE, places[:, 1], 0)
    return np.einsum("ki,kj->kij", v, u).reshape(len(places), -1)


def _regressors(f: Fields, tests: _Tests) -> dict[str, Array]:
    """Forces per mass of the base and of every effect (F', T, k) by block."""
    F = len(f.n)
    n, v = f.n, f.v
    ones = np.ones(n.shape[:2])
    across = dot(v, n)[..., None] * n
    speed = np.linalg.norm(v, axis=-1, keepdims=True)
    uniform = [tests.of(np.broadcast_to(e, n.shape)) for e in (_RIGHT, _AHEAD)]
    on_normals = [tests.of(n * (n @ e)[..., None]) for e in (_RIGHT, _AHEAD)]
    bend_u, bend_v = tests.bending(f.kuu, None), tests.bending(None, f.kvv)
    u, w = (2 * basis().places - 1).T
    waves = np.cos(np.pi * f.time[:, None] * np.arange(1, 9))
    ahead = f.x[..., 2]
    low, high = np.quantile(ahead, (0.02, 0.98))
    reach = max(float(high - low), 1e-6)
    front, back = (np.clip(s / (0.12 * reach) + 1, 0, 1) for s in (ahead - high, low - ahead))
    turning = np.cross(_DOWN, f.x - f.x.mean((0, 1)))
    shear, squared = f.shear, f.euu * np.abs(f.euu)

    def block(*columns: Array) -> Array:
        return np.stack(columns, -1)

    inertia = f.a - _DOWN
    kuu, kvv = f.kuu, f.kvv
    return {
        "wind": block(*uniform),
        "wind_normal": block(*on_normals),
        "bending": block(bend_u + bend_v),
        "in_plane": block(tests.stress(uu=f.euu), tests.stress(vv=f.evv), tests.stress(uv=shear)),
        "gusts": block(*(c * waves[:, k, None] for c in uniform for k in range(8))),
        "gusts_normal": block(*(c * waves[:, k, None] for c in on_normals for k in range(5))),
        "drag": block(tests.of(-v), tests.of(-across), tests.of(-speed * v), tests.of(-speed * across)),
        "drag_linear": block(tests.of(-across)),
        "damping": block(tests.bending(f.ruu, f.rvv), tests.stress(uv=f.shear_rate), tests.viscous()),
        "viscosity": block(tests.viscous()),
        "anisotropy": block(bend_u - bend_v),
        "anisotropy_in_plane": block(tests.stress(uu=f.euu, vv=-f.evv)),
        "stiffening": block(
            tests.stress(uv=shear * np.abs(shear)),
            tests.stress(uv=shear**3),
            tests.stress(uu=squared),
            tests.stress(vv=f.evv * np.abs(f.evv)),
        ),
        "rest_u": block(*(tests.bending(ones * p, None) for p in (1 + 0 * u, u, u**2 - 0.33, w))),
        "rest_v": block(*(tests.bending(None, ones * p) for p in (1 + 0 * u, w, w**2 - 0.33, u))),
        "density": block(
            *(tests.of(p[:, None] * inertia) for p in (u, w, u * u - 0.33, w * w - 0.33, u * w))
        ),
        "stiffness": block(
            *(tests.bending(p * kuu, p * kvv) for p in (u, w, u * u - 0.33, w * w - 0.33)),
            *(tests.stress(uv=p * shear) for p in (u, w)),
        ),
        "interval": block(tests.of(np.broadcast_to(_DOWN, n.shape))),
        "contact": block(
            *(
                tests.of(s * np.broadcast_to(_AHEAD, n.shape) * p[..., None])
                for s, p in ((-1, front), (1, back))
            )
        ),
        "pressure": block(*(tests.of(n * wave[:, None, None]) for wave in (np.ones(F), *waves[:, :2].T))),
        "vortex": block(
            tests.of(n * dot(turning, n)[..., None]),
            tests.of(n * (u * ones)[..., None]),
            tests.of(n * (w * ones)[..., None]),
        ),
    }
