"""One suite over every effect of the catalogue: identity at zero, gradients, bounds, what a user reads."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hydra.utils import instantiate
from omegaconf import OmegaConf

from toile.cli.configuration import CONF
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import (
    BoundaryEffect,
    BrightnessEffect,
    CameraEffect,
    ElementEffect,
    ExposureEffect,
    ForceEffect,
    MaskEffect,
    MassEffect,
    Surroundings,
    TimeEffect,
    VertexEffect,
)
from toile.effects.catalogue import CATALOGUE, STAGES, STAND_INS
from toile.effects.contact import Contact
from toile.effects.gusts import Gusts
from toile.effects.obstacles import Plane, Sphere, TriangleMesh
from toile.effects.setting import active_terms, setting
from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.geometry.horizontal import horizontal_axes
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2, BackwardEuler
from toile.physics.implicit.linearized import LinearizedRollout, Perturbation
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State
from toile.physics.surrogate.simulator import SurrogateSimulator

GRID, SIZE, FRAMES, FPS, SUBSTEPS = (6, 5), (0.25, 0.2), 6, 40.0, 2
TIGHT = NewtonSettings(tolerance=1e-11)
CAMERA = Camera(600.0, 590.0, 320.0, 235.0, 480, 640)
AROUND = Surroundings(
    grid_cloth(GRID, SIZE, 0.2, (0, 4)), SIZE, torch.tensor([0.3, 9.7, 0.5]).double(), FPS, FRAMES
)
# A box with its top in the way of the lower half of the cloth, which falls past its edge.
BOX_CORNERS = torch.tensor(
    [[x, y, z] for x in (-1.0, 1.0) for y in (0.17, 1.0) for z in (-1.0, 1.0)]
).double()
BOX_FACES = torch.tensor(
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)
OBSTACLES = {
    "plane": Plane((0.0, 0.17, 0.0), (0.1, -1.0, 0.3)),
    "sphere": Sphere((0.1, 0.3, 0.02), 0.12),
    "mesh": TriangleMesh(BOX_CORNERS, BOX_FACES),
}

SPECIAL = {
    "contact": lambda values: Contact(OBSTACLES["plane"], values, thickness=0.02),
    "anchor_slip": lambda values: AnchorSlip(values, vertex=1, start=0.03, duration=0.06),
    # Half waves that five frame intervals can follow.
    "gusts": lambda values: Gusts(values, n_modes=FRAMES - 2),
}
MAKE = {name: SPECIAL.get(name, effect) for name, effect in CATALOGUE.items()}
VARIANTS = {
    **MAKE,
    **STAND_INS,
    "contact with a sphere": lambda values: Contact(OBSTACLES["sphere"], values),
    "contact with a mesh": lambda values: Contact(OBSTACLES["mesh"], values),
    "gusts of two modes": lambda values: Gusts(values, n_modes=2),
    "density in detail": lambda values: CATALOGUE["nonuniform_density"](values, half_waves=3),
    "curvature in detail": lambda values: CATALOGUE["rest_curvature"](values, half_waves=2),
}
MECHANICAL = VertexEffect | ElementEffect | ForceEffect | MassEffect | BoundaryEffect | TimeEffect


def some_values(effect):
    """Non-zero numbers of about the prior's size."""
    return torch.stack(
        [
            torch.tensor(min((0.8 if k % 2 else 0.6) * p.scale, p.high), dtype=torch.float64)
            for k, p in enumerate(effect.parameters)
        ]
    )


def start():
    i, j = torch.meshgrid(
        torch.linspace(0, SIZE[0], GRID[0], dtype=torch.float64),
        torch.linspace(0, SIZE[1], GRID[1], dtype=torch.float64),
        indexing="ij",
    )
    x = torch.stack((j, i, 0.02 * torch.sin(20 * i + 9 * j)), -1).reshape(1, -1, 3)
    generator = torch.Generator().manual_seed(5)
    return x, 0.3 * torch.randn(x.shape, generator=generator, dtype=torch.float64)


def simulate(effects, simulator=ImplicitSimulator, integrator=None, newton=TIGHT, **more):
    x, v = start()
    nominal = x[0, None, AROUND.cloth.pinned].expand(FRAMES, -1, -1)
    given = setting(effects, AROUND, nominal, torch.tensor([0.0, 0.0, 0.5]).double())
    h = given.frame_interval / SUBSTEPS
    sim = simulator(given.cloth, h, integrator or BDF2(), newton, terms=given.terms)
    material = grid_material(*(torch.tensor([s], dtype=torch.float64) for s in (60.0, 3e-4, 2e-5)))
    state = State.start(x, v, h, sim.n_past)
    motion = rollout(sim, state, material, given.forces[None], given.boundary[None], SUBSTEPS, **more)
    return sim, motion


def seen(effect):
    """Everything that an effect changes, in one tensor of numbers of order one."""
    generator = torch.Generator().manual_seed(2)
    match effect:
        case CameraEffect():
            pixels = 600 * torch.rand(7, 2, generator=generator, dtype=torch.float64)
            return effect.pixels(pixels, CAMERA) / 100
        case BrightnessEffect():
            normals = torch.nn.functional.normalize(
                torch.randn(2, 9, 3, generator=generator, dtype=torch.float64), dim=-1
            )
            return effect.brightness(normals[0], normals[1])
        case ExposureEffect():
            return effect.exposure()
        case MaskEffect():
            return effect.growth()
    return simulate([effect])[1].positions / 0.01


@pytest.mark.parametrize("name", CATALOGUE)
def test_what_a_user_reads(name):
    effect = CATALOGUE[name]
    assert name == effect.NAME
    assert STAGES[name] is effect.STAGE
    assert len(effect.SOURCE) > 20
    assert len(effect.__doc__) > 20
    names = [p.name for p in effect.PARAMETERS]
    assert names
    assert len(set(names)) == len(names)
    for p in effect.PARAMETERS:
        assert p.unit
        assert p.doc
        assert p.low <= 0.0 <= p.high
        assert 0.0 < p.scale < p.high


@pytest.mark.parametrize("name", CATALOGUE)
def test_configuration_makes_the_effect_that_does_nothing(name):
    config = OmegaConf.load(CONF / "effect" / f"{name}.yaml")
    assert list(config) == [name]
    effect = instantiate(config[name])
    assert type(effect) is CATALOGUE[name]
    assert effect.is_identity
    assert list(config[name]["values"]) == [p.name for p in effect.parameters]


def test_every_configuration_is_of_the_catalogue():
    assert {path.stem for path in (CONF / "effect").glob("*.yaml")} == {*CATALOGUE, "none"}


@pytest.mark.parametrize("name", VARIANTS)
def test_bounds_are_told(name):
    make = VARIANTS[name]
    for p in make({}).parameters:
        for value in (p.low - 1e-3 * p.scale, p.high * 1.001, math.nan):
            with pytest.raises(InputError, match=f"{p.name} is out of bounds"):
                make({p.name: value})
        make({p.name: p.low})
        make({p.name: p.high})
    with pytest.raises(InputError, match="has no such parameter"):
        make({"nonsense": 1.0})


@pytest.mark.parametrize("name", VARIANTS)
def test_values_by_name_and_number(name):
    effect = VARIANTS[name]({})
    values = some_values(effect)
    other = effect.with_values(values)
    assert torch.equal(torch.stack([other.value(p.name) for p in effect.parameters]), values)
    assert effect.is_identity
    assert not other.is_identity
    again = VARIANTS[name]({p.name: float(v) for p, v in zip(effect.parameters, values, strict=True)})
    assert torch.equal(again.values, values)
    with pytest.raises(ValueError, match="values: expected"):
        effect.with_values(values[:-1])


@pytest.fixture(scope="module")
def plain():
    return simulate([])[1].all_positions


@pytest.mark.parametrize("name", VARIANTS)
def test_zero_is_identity_bit_for_bit(name, plain):
    """Both for an effect that is left out because it does nothing, and for one that takes part at 0."""
    effect = VARIANTS[name]({})
    taking_part = effect.with_values(effect.values.clone().requires_grad_())
    if isinstance(effect, MECHANICAL):
        for given in (effect, taking_part):
            _, motion = simulate([given])
            assert torch.equal(motion.all_positions, plain)
        return
    generator = torch.Generator().manual_seed(2)
    for given in (effect, taking_part):
        match given:
            case CameraEffect():
                pixels = 600 * torch.rand(50, 2, generator=generator, dtype=torch.float64)
                assert torch.equal(given.pixels(pixels, CAMERA), pixels)
                assert effect.pixels(pixels, CAMERA) is pixels
            case BrightnessEffect():
                normals = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
                assert torch.equal(given.brightness(*normals), torch.ones(50).double())
            case ExposureEffect():
                assert given.exposure().tolist() == 0.0
            case MaskEffect():
                assert given.growth().tolist() == 0.0


def test_nothing_is_made_new_where_nothing_acts():
    nominal = torch.zeros(FRAMES, 2, 3).double()
    effects = [make({}) for make in MAKE.values()]
    given = setting(effects, AROUND, nominal)
    assert given.cloth is AROUND.cloth
    assert given.boundary is nominal
    assert given.terms == ()
    assert float(given.frame_interval) == 1 / FPS
    weight = AROUND.cloth.masses[:, None] * AROUND.gravity
    assert torch.equal(given.forces, weight.expand(FRAMES - 1, -1, -1))


@pytest.mark.parametrize("name", VARIANTS)
def test_effect_is_felt(name, plain):
    """Every single number matters where it is not zero, up to what a second one multiplies."""
    effect = VARIANTS[name]({})
    nothing = seen(effect)
    for k, p in enumerate(effect.parameters):
        values = torch.zeros(len(effect.parameters), dtype=torch.float64)
        values[k] = p.scale
        if p.name == "friction":
            continue
        assert (seen(effect.with_values(values)) - nothing).abs().max() > 1e-6


@pytest.mark.parametrize("name", VARIANTS)
def test_gradients_against_finite_differences(name):
    """By every single number, at non-zero values, through ten simulated steps if it is mechanical."""
    effect = VARIANTS[name]({})
    values = some_values(effect)
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(seen(effect).shape, generator=generator, dtype=torch.float64)

    def loss(v):
        return (weights * seen(effect.with_values(v))).sum()

    leaf = values.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(leaf), leaf)
    for k, p in enumerate(effect.parameters):
        step = torch.zeros_like(values)
        step[k] = 1e-4 * p.scale
        slope = float(loss(values + step) - loss(values - step)) / (2 * 1e-4)
        assert slope != 0.0
        assert float(gradient[k]) * p.scale == pytest.approx(slope, rel=1e-4, abs=1e-6), p.name


@pytest.mark.parametrize("integrator", [BackwardEuler(), BDF2()], ids=["backward Euler", "BDF2"])
@pytest.mark.parametrize(
    "name", [n for n, make in MAKE.items() if isinstance(make({}), VertexEffect | ElementEffect)]
)
def test_tangents_and_adjoints_know_the_terms(name, integrator):
    """The linearised rollout against autograd and a finite difference, by values and initial velocities."""
    effect = MAKE[name]({})
    scales = effect.scales.numpy()
    values = some_values(effect)
    leaf = values.clone().requires_grad_()
    simulator, motion = simulate([effect.with_values(leaf)], integrator=integrator, linearize=True)
    linear = LinearizedRollout(simulator, motion)
    rng = np.random.default_rng(1)
    n = simulator.cloth.n_vertices
    change = Perturbation(
        forces=np.zeros((FRAMES - 1, n, 3)),
        stiffness=np.zeros(3),
        boundary=np.zeros((FRAMES, 2, 3)),
        positions=np.zeros((n, 3)),
        velocities=np.zeros((n, 3)),
        values=scales * rng.normal(size=len(scales)),
    )
    tangent = linear.tangent(change)

    def moved(by):
        given = effect.with_values(values + by * torch.from_numpy(change.values))
        return simulate([given], integrator=integrator)[1].positions[0].numpy()

    difference = (moved(1e-4) - moved(-1e-4)) / 2e-4
    assert np.abs(tangent - difference).max() <= 1e-4 * np.abs(difference).max()

    gradient = rng.normal(size=tangent.shape)
    back = linear.adjoint(gradient)
    assert (gradient * tangent).sum() == pytest.approx(back.values @ change.values, rel=1e-8)
    (by_autograd,) = torch.autograd.grad((torch.from_numpy(gradient) * motion.positions[0]).sum(), leaf)
    np.testing.assert_allclose(back.values, by_autograd.numpy(), rtol=1e-7, atol=1e-12)

    everything = Perturbation(
        forces=1e-3 * rng.normal(size=change.forces.shape),
        stiffness=np.array([6.0, 3e-5, 2e-6]) * rng.normal(size=3),
        boundary=1e-3 * rng.normal(size=change.boundary.shape),
        positions=1e-3 * rng.normal(size=change.positions.shape),
        velocities=0.1 * rng.normal(size=change.velocities.shape),
        values=change.values,
    )
    forward = (gradient * linear.tangent(everything)).sum()
    parts = ("forces", "stiffness", "boundary", "positions", "velocities", "values")
    backward = sum((getattr(back, part) * getattr(everything, part)).sum() for part in parts)
    assert forward == pytest.approx(backward, rel=1e-8)


OF_A_LENGTH = ("gusts", "rest_length_drift", "pressure")


@pytest.mark.parametrize("name", [name for name in VARIANTS if name not in OF_A_LENGTH])
def test_the_length_of_a_clip_changes_no_other_effect(name):
    effect = VARIANTS[name]({})
    assert effect.for_clip(1.58) is effect


def test_gusts_have_a_mean_of_their_own_in_still_air_and_elsewhere_the_wind_has_it():
    gusts = Gusts({"x_1": 0.3, "z_2": -0.5}, n_modes=3)
    both = gusts.in_still_air()
    names = [parameter.name for parameter in both.parameters]
    assert names == [f"{axis}_{k}" for axis in "xz" for k in range(4)]
    assert both.in_still_air() is both
    times, calm = AROUND.frame_times(), replace(AROUND, still_air=True)
    assert torch.equal(both.acceleration(times, calm), gusts.acceleration(times, AROUND))
    blowing = Gusts({"x_1": 0.3}).in_still_air().for_clip(1.0)
    values = blowing.values.clone()
    values[names.index("x_0")] = 2.0
    blowing = blowing.with_values(values)
    assert float(blowing.value("x_1")) == 0.3
    added = blowing.acceleration(times, calm) - blowing.acceleration(times, AROUND)
    along = horizontal_axes(AROUND.gravity)[0]
    assert torch.allclose(added, 2.0 * along.expand_as(added), rtol=0, atol=1e-15)


def test_gusts_reach_the_same_frequency_in_clips_of_any_length():
    gusts = Gusts({"x_1": 0.3, "z_2": -0.5})
    assert len(gusts.parameters) == 12
    for duration, n_modes in ((0.5, 3), (1.5, 9), (79 / 50, 10)):
        longer = gusts.for_clip(duration)
        assert len(longer.parameters) == 2 * n_modes == len(longer.values)
        assert 3.0 <= n_modes / (2 * duration) < 3.0 + 1 / (2 * duration)
        times = torch.linspace(0, AROUND.n_frames / FPS, 7, dtype=torch.float64)
        torch.testing.assert_close(
            longer.acceleration(times, AROUND), gusts.acceleration(times, AROUND), rtol=0, atol=1e-15
        )
    # What acts already is never lost.
    assert float(Gusts({"z_6": 1.0}).for_clip(0.2).value("z_6")) == 1.0
    assert len(gusts.for_clip(1.58).for_clip(0.5).parameters) == 6


def test_a_number_of_modes_that_was_asked_for_stays():
    listed = OmegaConf.load(CONF / "effect" / "gusts.yaml").gusts
    assert len(instantiate(listed).for_clip(1.58).parameters) == 20
    for n_modes in (3, 7):
        gusts = instantiate({**listed, "n_modes": n_modes})
        assert len(gusts.parameters) == 2 * n_modes
        assert gusts.for_clip(1.58) is gusts
    with pytest.raises(InputError, match="no such parameter"):
        Gusts({"x_4": 1.0}, n_modes=3)


FIELDS = {"nonuniform_density": 15, "nonuniform_stiffness": 15, "rest_curvature": 10}


@pytest.mark.parametrize("name", FIELDS)
def test_fields_in_detail_begin_as_they_were(name):
    usual = CATALOGUE[name]()
    usual = usual.with_values(some_values(usual))
    finer = usual.in_detail()
    assert len(finer.parameters) == len(finer.values) == FIELDS[name]
    for parameter, value in zip(usual.parameters, usual.values, strict=True):
        assert finer.value(parameter.name) == value
    motions = [simulate([one])[1].positions for one in (usual, finer)]
    torch.testing.assert_close(*motions, rtol=0, atol=1e-12)
    assert finer.in_detail().parameters == finer.parameters


@pytest.mark.parametrize("name", FIELDS)
def test_half_waves_that_were_asked_for_stay(name):
    listed = OmegaConf.load(CONF / "effect" / f"{name}.yaml")[name]
    assert len(instantiate(listed).in_detail().parameters) == FIELDS[name]
    one = instantiate({**listed, "half_waves": 1})
    assert one.in_detail() is one
    assert len(one.parameters) == {"rest_curvature": 4}.get(name, 3)
    with pytest.raises(InputError, match="no such parameter"):
        CATALOGUE[name]({"mode_33": 1.0, "axis_1_4": 1.0}, half_waves=1)
    with pytest.raises(InputError, match="no such modes"):
        CATALOGUE[name](half_waves=-1)


def test_modes_of_two_digits_are_refused_as_their_names_would_be_one():
    with pytest.raises(InputError, match="1 to 9"):
        CATALOGUE["nonuniform_density"](half_waves=11)


def test_all_mechanical_effects_at_once():
    effects = []
    for make in MAKE.values():
        effect = make({})
        if isinstance(effect, MECHANICAL):
            effects.append(effect.with_values(0.5 * some_values(effect)))
    values = [e.values.clone().requires_grad_() for e in effects]
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(1, FRAMES, 30, 3, generator=generator, dtype=torch.float64)

    def loss(given):
        _, motion = simulate([e.with_values(v) for e, v in zip(effects, given, strict=True)])
        return (weights * motion.positions).sum()

    gradients = torch.autograd.grad(loss(values), values)
    along = [e.scales * torch.randn(len(e.values), generator=generator).double() for e in effects]
    slope = sum(float((g * a).sum()) for g, a in zip(gradients, along, strict=True))
    ahead, behind = (
        loss([v.detach() + s * 1e-4 * a for v, a in zip(values, along, strict=True)]) for s in (1, -1)
    )
    assert slope == pytest.approx(float(ahead - behind) / 2e-4, rel=1e-4)


def test_surrogate_refuses_terms():
    drag = MAKE["air_drag"]({"linear": 1.0})
    with pytest.raises(InputError, match="cannot take effects that act within a step"):
        SurrogateSimulator(AROUND.cloth, 0.01, BDF2(), 2, terms=active_terms([drag]))


def test_anchor_slip_wants_a_pinned_vertex():
    slip = AnchorSlip({"x": 0.01}, vertex=2)
    with pytest.raises(InputError, match="no such pinned vertex"):
        slip.boundary(torch.zeros(FRAMES, 2, 3).double(), AROUND)
    with pytest.raises(InputError, match="no such slip"):
        AnchorSlip(vertex=-1)


def test_hook_values():
    """Numbers that can be worked out by hand."""
    tilt = MAKE["gravity_tilt"]({"about_x": 30.0})
    down = Surroundings(AROUND.cloth, SIZE, torch.tensor([0.0, 10.0, 0.0]).double(), FPS, FRAMES)
    tilted = tilt.acceleration(torch.zeros(1).double(), down)[0, 0] + down.gravity
    expected = torch.tensor([0.0, 10 * math.cos(math.pi / 6), 10 * math.sin(math.pi / 6)]).double()
    torch.testing.assert_close(tilted, expected)

    gusts = Gusts({"x_1": 2.0, "z_2": 3.0})
    times = torch.tensor([0.0, 0.5, 1.0]).double() * (FRAMES - 1) / FPS
    torch.testing.assert_close(
        gusts.acceleration(times, down)[:, 0],
        torch.tensor([[2.0, 0.0, 3.0], [0.0, 0.0, -3.0], [-2.0, 0.0, 3.0]]).double(),
    )

    density = MAKE["nonuniform_density"]({"mode_10": 0.01, "mode_02": -0.01})
    masses = density.masses(AROUND.cloth.masses, AROUND)
    assert float(masses.sum() / AROUND.cloth.masses.sum()) == pytest.approx(1.0, abs=1e-4)
    assert float(masses[0] / AROUND.cloth.masses[0]) == pytest.approx(1.0, abs=1e-12)
    assert float(masses[2] / AROUND.cloth.masses[2]) == pytest.approx(math.exp(0.02), abs=1e-12)

    distortion = MAKE["lens_distortion"]({"k1": -0.2, "k2": 0.1})
    corner = torch.tensor([CAMERA.cx + CAMERA.fx, CAMERA.cy]).double()
    assert float(distortion.pixels(corner, CAMERA)[0]) == pytest.approx(CAMERA.cx + 0.9 * CAMERA.fx)

    slip = AnchorSlip({"y": 0.04}, vertex=1, start=1 / FPS, duration=2 / FPS)
    path = slip.boundary(torch.zeros(FRAMES, 2, 3).double(), AROUND)
    assert path[:, 1, 1].tolist() == pytest.approx([0.0, 0.0, 0.02, 0.04, 0.04, 0.04])
    assert not path[:, 0].any()


@pytest.mark.parametrize("name", OBSTACLES)
def test_obstacle_normals_are_gradients_of_the_distance(name):
    obstacle = OBSTACLES[name]
    generator = torch.Generator().manual_seed(4)
    points = 0.3 * torch.rand(40, 3, generator=generator, dtype=torch.float64)
    at = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(obstacle.distance(at, points).sum(), at)
    torch.testing.assert_close(obstacle.normals(points), gradient)
    torch.testing.assert_close(gradient.norm(dim=-1), torch.ones(40).double())


def test_distance_to_a_mesh_near_faces_edges_and_corners():
    """A cube of side 2 about the origin, whose distance is known everywhere."""
    cube = TriangleMesh(
        torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]), BOX_FACES
    )
    generator = torch.Generator().manual_seed(6)
    points = 4 * torch.rand(500, 3, generator=generator, dtype=torch.float64) - 2
    beyond = points.abs() - 1
    exact = beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0)
    torch.testing.assert_close(cube.distance(points, points), exact)


def test_a_sharp_edge_tells_inside_from_outside(tmp_path):
    """A thin tetrahedron, as a file that stores the corners of every face for itself."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.1, 0], [0, 0, 3]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh.export(tmp_path / "wedge.stl")
    points = 3 * np.random.default_rng(0).random((2000, 3)) - 1.5
    outside = ((points[:, None] - mesh.triangles[None, :, 0]) * mesh.face_normals).sum(-1).max(1) > 0
    at = torch.from_numpy(points)
    found = TriangleMesh.read(tmp_path / "wedge.stl").distance(at, at) > 0
    assert 0 < (~outside).sum() < 100
    np.testing.assert_array_equal(found.numpy(), outside)
