"""Effects that change a cloth's elements, several at once: what each does hangs on no order."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch

from toile.diagnosis.effect_sensitivities import Instant, stretching_within
from toile.diagnosis.sensitivities import StepForces
from toile.diagnosis.template_tension import TemplateTension
from toile.effects.base import Surroundings
from toile.effects.gusts import Gusts
from toile.effects.internal_damping import InternalDamping
from toile.effects.nonuniform_stiffness import NonuniformStiffness
from toile.effects.rest_length_drift import RestLengthDrift
from toile.effects.setting import external_forces
from toile.effects.strain_stiffening import StrainStiffening
from toile.generation.out_of_family.other_forms import RayleighDamping
from toile.physics.cloth import Cloth, grid_cloth
from toile.physics.elements import Elements
from toile.physics.grid_laws import GridLaw, angles, taut, taut_fitted
from toile.physics.implicit.assembly import Assembly
from toile.physics.implicit.terms import changed_elements
from toile.physics.material import Material
from toile.physics.step_terms import ElementTerm, StepContext

GRID, SIDE, H = (4, 5), 0.1, 0.01


def cloth_of(law: GridLaw) -> Cloth:
    size = (SIDE * (GRID[0] - 1), SIDE * (GRID[1] - 1))
    return grid_cloth(GRID, size, 0.15, (0, GRID[1] * (GRID[0] - 1)), law=law)


def sheared(angle: float, stretched: float = 0.0) -> torch.Tensor:
    i, j = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    x = SIDE * (1 + stretched) * (i + angle * j)
    return torch.stack((x, SIDE * j.double(), torch.zeros(GRID)), -1).reshape(-1, 3).double()


def material_of(cloth: Cloth, stretching: float = 100.0) -> torch.Tensor:
    ratios = [0.3] * (len(cloth.energies.parameters) - 3)
    by_name = dict(stretching=stretching, shearing=2e-3, bending=1e-4)
    return torch.tensor(
        [by_name.get(p.name, ratios[0] if ratios else 0.0) for p in cloth.energies.parameters]
    ).double()


def context_of(cloth: Cloth, positions: torch.Tensor, stretching: float = 100.0) -> StepContext:
    """Of a cloth at rest: it has been, and goes on, where it is."""
    return StepContext(
        cloth=cloth,
        material=Material(cloth.energies.parameters, material_of(cloth, stretching)[None]),
        positions=positions,
        velocities=torch.zeros_like(positions),
        time=0.5,
        time_step=H,
        boundary=positions[cloth.pinned],
    )


def force_by(elements: Elements, now: StepContext) -> np.ndarray:
    """Internal force [N]."""
    assembly = Assembly.of(now.cloth)
    assembly.set_elements(elements)
    coefficients = now.cloth.energies.coefficients(now.material.values[0]).numpy()
    return -np.tensordot(coefficients, assembly.gradients(now.positions.numpy()), 1)


def force(cloth: Cloth, terms: list[ElementTerm], positions: torch.Tensor, stretching: float = 100.0):
    now = context_of(cloth, positions, stretching)
    return force_by(changed_elements(terms, now), now)


def drift() -> RestLengthDrift:
    acting = RestLengthDrift({})
    return acting.with_values(0.5 * acting.scales)


@pytest.mark.parametrize("law", [angles, taut, taut_fitted])
def test_what_each_does_hangs_on_no_order(law: GridLaw) -> None:
    """A drift of the length that a damping had shifted already was amplified by 1 + tau / h."""
    cloth = cloth_of(law)
    uneven = NonuniformStiffness({})
    tensions = TemplateTension(np.full(len(cloth.energies.named("stretching").stencil), 0.05))
    terms: list[ElementTerm] = [
        InternalDamping({"in_plane": 0.05, "bending": 0.02}),
        drift(),
        uneven.with_values(uneven.scales),
        StrainStiffening({"stretching": 500.0}),
        tensions,
    ]
    first, *others = (force(cloth, list(order), sheared(0.1, 0.02)) for order in permutations(terms))
    for other in others:
        np.testing.assert_allclose(other, first, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("law", [angles, taut, taut_fitted])
@pytest.mark.parametrize("angle", [0.02, 0.2])
@pytest.mark.parametrize("others", [[], [drift()]], ids=["alone", "with a drift"])
def test_nothing_is_damped_where_nothing_moves(law: GridLaw, angle: float, others: list[ElementTerm]) -> None:
    """Diagonals were weighed by the length that the dashpot remembers: 15 % softer at a shear of 0.2."""
    cloth = cloth_of(law)
    damping = InternalDamping({"in_plane": 0.05})
    still = force(cloth, others, sheared(angle))
    assert np.abs(still).max() > 1e-4
    np.testing.assert_allclose(force(cloth, [damping, *others], sheared(angle)), still, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("law", [angles, taut])
def test_nothing_is_damped_where_nothing_moves_in_generated_scenes(law: GridLaw) -> None:
    damping = RayleighDamping.__new__(RayleighDamping)
    damping.strength, damping.times, damping.half_rate = 1.0, np.array([0.03, 0.03, 0.0]), math.inf
    now = context_of(cloth_of(law), sheared(0.2))
    still = now.cloth.energies.elements()
    damped = damping.elements(still, now)
    np.testing.assert_allclose(force_by(damped, now), force_by(still, now), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("law", [angles, taut, taut_fitted])
def test_a_cloth_that_has_shrunk_is_not_stiffer_for_it(law: GridLaw) -> None:
    """Its strain was counted from the lengths before: at rest, by 10 % shrunk, it was 5.5 times as stiff."""
    cloth = cloth_of(law)
    shrunk = RestLengthDrift({"axis_0_mean_1": -0.1, "axis_1_mean_1": -0.1}).for_clip(0.5)
    stiffening = StrainStiffening({"stretching": 500.0, "shearing": 10.0})
    now = context_of(cloth, math.exp(-0.1) * sheared(0.0))
    elements = changed_elements((shrunk, stiffening), now)
    edges = cloth.energies.named("stretching")
    torch.testing.assert_close(elements.rest["stretching"], edges.measure(now.positions))
    for name in ("stretching", "shearing"):
        torch.testing.assert_close(
            elements.factors[name], torch.ones_like(elements.factors[name]), rtol=1e-9, atol=0
        )


def test_terms_know_the_step_as_it_is() -> None:
    """It was rounded to single precision where it was a number, and not where it was a tensor."""
    now = context_of(cloth_of(angles), sheared(0.0))
    assert now.detached().time_step == H
    exact = torch.tensor(H, dtype=torch.float64)
    assert replace(now, time_step=exact).detached().time_step == H


def test_normals_are_those_of_faces_that_turn_counter_clockwise() -> None:
    """Seen from the side that they point to."""
    now = context_of(cloth_of(angles), sheared(0.0))
    a, b, c = now.positions[now.cloth.topology.faces[0]]
    about = torch.linalg.cross(b - a, c - a)
    assert float(now.normals[0] @ about) > 0  # right-handed: counter-clockwise, seen against the normal


def test_gusts_have_no_mean_and_are_not_early() -> None:
    """Evaluated where an interval ends, every odd mode left a tenth of itself to the wind here."""
    around = Surroundings(cloth_of(angles), (0.3, 0.4), torch.tensor([0.0, 9.81, 0.0]).double(), 25.0, 11)
    bare = external_forces((), around, around.cloth)
    for mode in range(1, 7):
        gust = external_forces((Gusts({f"x_{mode}": 3.0}),), around, around.cloth) - bare
        assert float(gust.abs().max()) > 0
        torch.testing.assert_close(gust.mean(0), torch.zeros_like(gust[0]), rtol=0, atol=1e-12)
    # The first half wave changes its sign in the middle of the clip.
    first = external_forces((Gusts({"x_1": 3.0}),), around, around.cloth) - bare
    torch.testing.assert_close(first, -first.flip(0))


@pytest.mark.parametrize("stiffening", [0.0, 500.0])
def test_stiffer_threads_are_less_stretched_by_a_tension(stiffening: float) -> None:
    """And where their stiffness grows with that stretch, it grows less."""
    cloth, x = cloth_of(taut), sheared(0.05, 0.02)
    tension = TemplateTension(np.full(len(cloth.energies.named("stretching").stencil), 0.05))
    terms: list[ElementTerm] = [
        StrainStiffening({"stretching": stiffening}),
        InternalDamping({"in_plane": 0.02}),
        tension,
    ]
    step, Y = 1e-4, 30.0
    more, less = (force(cloth, terms, x, Y * np.exp(s * step)) for s in (1, -1))
    expected = (more - less) / (2 * step)
    material = material_of(cloth, Y)
    slopes = torch.autograd.functional.jacobian(cloth.energies.coefficients, material)[:, 0] * Y
    still = np.zeros_like(x.numpy())
    forces = StepForces(0, x.numpy(), x.numpy(), still, np.zeros((0, *still.shape)), still)
    boundary = x[cloth.pinned].numpy()
    now = Instant(forces, 0.5, H, material.numpy(), np.zeros(3), boundary, (tension,))
    assembly = Assembly.of(cloth)
    assembly.set_elements(changed_elements(terms, context_of(cloth, x, Y)))
    direct = -np.tensordot(slopes.numpy(), assembly.gradients(x.numpy()), 1)
    within = stretching_within(terms, now, cloth)
    np.testing.assert_allclose(direct + within, expected, rtol=1e-5, atol=1e-7)
    # Without stiffening it is the tension, which the base model takes off by itself.
    alone = np.abs(within + tension.force(x.numpy(), cloth)).max()
    assert (alone > 1e-3) == (stiffening > 0)
