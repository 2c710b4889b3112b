"""A rectangular cloth as one flex of MuJoCo: its model, its rest, its motion.

MuJoCo's flex is a St. Venant-Kirchhoff membrane of linear triangles with the quadratic bending energy of
isometric plates (Bergou et al. 2006, "A Quadratic Bending Model for Inextensible Surfaces"). The membrane
stiffness of every triangle is written here, so that the sheet can be orthotropic or uneven. Steps are those
of `integrator="discrete"`: elasticity, its damping and the constraints are implicit, linearised once a step.
The pinned corners are connected to mocap bodies by equality constraints.

World axes are those of the OpenCV camera; positions [m], velocities [m/s], forces [N].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.errors import InputError
from toile.generation.motion import PinnedMotion
from toile.generation.out_of_family.interface import OutOfFamilyEffect, places_on
from toile.physics.cloth import GRID_PARAMETERS, Cloth, grid_cloth
from toile.physics.material import Material
from toile.physics.simulator import SimulationError
from toile.physics.step_terms import StepContext

Array = NDArray[np.float64]

_RADIUS = 1e-3  # [m], half of what contacts see of the cloth's thickness
_HOLD = 1e-5  # [s], time constant of the connection of a corner: it follows its path to 1e-5 m at 1 m/s
_SETTLING_STEP = 0.02  # [s]
_SETTLING_RATE = 2.0  # [1/s], drag while settling
_SETTLING_DAMPING = 0.02  # [s], internal
_SETTLED_SPEED = 1e-4  # [m/s]
_SETTLED_FOR = 10  # steps: once is also the turning point of a swing
_SETTLING_STEPS = 1500


def why_no_mujoco() -> str:
    """Why MuJoCo cannot make scenes here; "" where it can."""
    try:
        import mujoco
    except ImportError as error:
        return str(error)
    if not hasattr(mujoco.mjtIntegrator, "mjINT_DISCRETE"):
        return f"MuJoCo {mujoco.__version__} has no discrete integrator; 3.13 is the first that has it"
    return ""


def require_mujoco() -> None:
    """Raise InputError where MuJoCo cannot make scenes."""
    why = why_no_mujoco()
    if why:
        raise InputError(
            "Scenes of this engine need MuJoCo",
            where="mujoco",
            expected="pip install 'toile[mujoco]'",
            got=why,
        )


@dataclass(frozen=True)
class FlexMaterial:
    """Stiffness of a sheet, as much along axis 0 as along axis 1.

    Attributes:
        stretching: Young's modulus times thickness [N/m].
        shearing: shear modulus times thickness [N/m]; stretching / (2 (1 + poisson)) would be isotropic.
        poisson: ratio.
        bending: [N·m].
        damping: Rayleigh, proportional to the stiffness [s], above 0.
    """

    stretching: float
    shearing: float
    poisson: float
    bending: float
    damping: float

    @property
    def thickness(self) -> float:
        """At which a plate of this Young's modulus bends like this sheet [m]."""
        return math.sqrt(12 * (1 - self.poisson**2) * self.bending / self.stretching)

    def plane_stiffness(self, ratio: float = 1.0) -> Array:
        """Forces per width (xx, yy, xy) [N/m] by strains (xx, yy, 2xy), (3, 3).

        Args:
            ratio: of Young's moduli along axis 0 and 1; their geometric mean stays.
        """
        first, second = self.stretching * math.sqrt(ratio), self.stretching / math.sqrt(ratio)
        # Symmetric: Poisson's ratio of either direction goes with its modulus.
        coupling = self.poisson * self.stretching
        plane = np.array([[first, coupling], [coupling, second]]) / (1 - self.poisson**2)
        result = np.zeros((3, 3))
        result[:2, :2], result[2, 2] = plane, self.shearing
        return result


@dataclass(frozen=True)
class FlexSheet:
    """The cloth before it is simulated.

    Attributes:
        grid: (H, W) of its vertices.
        size: rest lengths along axis 0 and 1 [m].
        areal_density: [kg/m²].
        material: see FlexMaterial.
        pinned: flattened indices of pinned vertices.
    """

    grid: tuple[int, int]
    size: tuple[float, float]
    areal_density: float
    material: FlexMaterial
    pinned: tuple[int, ...]

    def cloth(self) -> Cloth:
        """What effects that know nothing of this engine ask about the cloth: masses, faces, places."""
        return grid_cloth(self.grid, self.size, self.areal_density, self.pinned)


class FlexEffect(OutOfFamilyEffect):
    """An effect that acts through this engine's own numbers; hooks not overridden do nothing."""

    def prepare(self, flex: Flex) -> None:
        """Change the model before the first step."""

    def update(self, flex: Flex, time: float) -> None:
        """Change the model before the step that ends at a time [s]."""

    def force(self, flex: Flex, now: StepContext) -> Tensor | None:
        """Forces on the vertices (N, 3) [N], or None."""
        return None

    def obstacle(self) -> str:
        """MJCF of a fixed body in the way, or ""."""
        return ""


class Flex:
    """A compiled model with its data; what effects read and write.

    Attributes:
        sheet: what it was made of.
        model, data: MuJoCo's.
        rest: (N, 3), flat.
        places: vertices as fractions of the cloth (N, 2).
        elements: (T, 3) vertices of triangles.
        edges: (E, 2) vertices of edges; flaps: (E, 2) vertices opposite of them, -1 at the border.
        masses: (N,) [kg].
    """

    def __init__(self, sheet: FlexSheet, step: float, gravity: Tensor, obstacles: Sequence[str] = ()) -> None:
        import mujoco

        self._mujoco = mujoco
        self.sheet = sheet
        n = sheet.grid[0] * sheet.grid[1]
        self.places = places_on(sheet.grid).numpy()
        self.rest = np.concatenate([self.places * np.array(sheet.size), np.zeros((n, 1))], 1)
        self.model: Any = mujoco.MjModel.from_xml_string(
            _model_text(sheet, self.rest, step, gravity, obstacles)
        )
        self.data: Any = mujoco.MjData(self.model)
        self.elements = self.model.flex_elem.reshape(-1, 3)
        self.edges, self.flaps = self.model.flex_edge, self.model.flex_edgeflap
        self._element_edges = self.model.flex_elemedge.reshape(-1, 3)
        self._rest_lengths = self.model.flexedge_length0.copy()
        self.set_masses(sheet.cloth().masses.numpy())
        self.set_stiffness(sheet.material.plane_stiffness())

    @property
    def positions(self) -> Array:
        """(N, 3), a copy."""
        result: Array = self.rest + self.data.qpos.reshape(-1, 3)
        return result

    @property
    def velocities(self) -> Array:
        """(N, 3), a copy."""
        result: Array = self.data.qvel.reshape(-1, 3).copy()
        return result

    def place(self, positions: Array) -> None:
        """Put the vertices (N, 3) somewhere, at rest, and hold the pinned ones there."""
        self.data.qpos[:] = (positions - self.rest).reshape(-1)
        self.data.qvel[:] = 0
        self.hold(positions[list(self.sheet.pinned)])

    def hold(self, positions: Array) -> None:
        """Where the pinned vertices (n_pinned, 3) are at the end of the next step."""
        self.data.mocap_pos[:] = positions

    def set_masses(self, masses: Array) -> None:
        """Give the vertices masses (N,) [kg]."""
        bodies = self.model.flex_vertbodyid
        self.model.body_inertia[bodies] *= (masses / self.model.body_mass[bodies])[:, None]
        self.model.body_mass[bodies] = masses
        self.masses = masses.copy()
        # Quantities that MuJoCo derives from masses; it counts them in the pose of the data it is given.
        self._mujoco.mj_setConst(self.model, self._mujoco.MjData(self.model))

    def set_stiffness(self, plane: Array) -> None:
        """Give the triangles a plane stiffness, (3, 3) for all of them or (T, 3, 3).

        The energy of a triangle of area A is ¼ sᵀ K s in the changes s of its squared edge lengths, and
        ½ A gᵀ C g in Green's strain g = ½ M⁻¹ s; so K = ½ A M⁻ᵀ C M⁻¹.
        """
        vectors = self.rest[self.edges[self._element_edges]]
        across = vectors[:, :, 1, :2] - vectors[:, :, 0, :2]
        x, y = across[..., 0], across[..., 1]
        inverse = np.linalg.inv(np.stack([x**2, y**2, x * y], -1))
        area = 0.5 * np.abs(x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1])
        stiffness = 0.5 * area[:, None, None] * np.swapaxes(inverse, 1, 2) @ plane @ inverse
        rows, columns = np.triu_indices(3)
        self._stiffness = stiffness[:, rows, columns]
        self._write_stiffness(self._stiffness)

    def scale_stiffness(self, factors: Array) -> None:
        """Multiply the stiffness that set_stiffness gave the triangles by (T,)."""
        self._write_stiffness(self._stiffness * factors[:, None])

    def scale_bending(self, factors: Array) -> None:
        """Multiply the bending stiffness at the edges by (E,)."""
        self.model.flex_bending.reshape(len(self.edges), -1)[:] *= factors[:, None]

    def scale_lengths(self, first: float, second: float) -> None:
        """Rest lengths of the triangles that a sheet has whose sides are shorter by two factors."""
        vectors = self.rest[self.edges[:, 1], :2] - self.rest[self.edges[:, 0], :2]
        before, after = (np.linalg.norm(v, axis=1) for v in (vectors, vectors * np.array([first, second])))
        self.model.flexedge_length0[:] = self._rest_lengths * after / before

    def strains(self) -> Array:
        """Largest principal value of Green's strain in every triangle (T,)."""
        sides = self.rest[self.elements[:, 1:], :2] - self.rest[self.elements[:, :1], :2]
        x = self.positions
        now = x[self.elements[:, 1:]] - x[self.elements[:, :1]]
        # Rows are sides: now = sides · gradientᵀ.
        gradient = np.linalg.solve(sides, now)
        strain = 0.5 * (gradient @ np.swapaxes(gradient, 1, 2) - np.eye(2))
        mean = 0.5 * (strain[:, 0, 0] + strain[:, 1, 1])
        spread: Array = np.hypot(0.5 * (strain[:, 0, 0] - strain[:, 1, 1]), strain[:, 0, 1])
        return np.asarray(mean + spread)

    def bending_matrices(self) -> tuple[Array, Array]:
        """Inner edges as stencils (S, 4) of vertices and their bending matrices (S, 4, 4) [N/m]."""
        inner = self.flaps[:, 1] >= 0
        matrices = self.model.flex_bending.reshape(len(self.edges), -1)[inner, :16].reshape(-1, 4, 4)
        return np.concatenate([self.edges[inner], self.flaps[inner]], 1), matrices

    def step(self, forces: Array) -> None:
        """One step under forces (N, 3) beside gravity.

        Raises:
            SimulationError: it diverged.
        """
        self.data.qfrc_applied[:] = forces.reshape(-1)
        self._mujoco.mj_step(self.model, self.data)
        if any(w.number for w in self.data.warning) or not np.isfinite(self.data.qpos).all():
            raise SimulationError("generator: MuJoCo's cloth diverged")

    def holding_force(self) -> Array:
        """Sum of the forces by which the corners were held in the last step, (3,)."""
        result: Array = self.data.qfrc_constraint.reshape(-1, 3)[list(self.sheet.pinned)].sum(0)
        return result

    def _write_stiffness(self, values: Array) -> None:
        self.model.flex_stiffness.reshape(len(self.elements), -1)[:, : values.shape[1]] = values


def settled_pose(sheet: FlexSheet, pose: Tensor, acceleration: Tensor) -> Tensor:
    """The sheet's equilibrium (H, W, 3) under an acceleration (3,), from a pose nearby; corners stay.

    Raises:
        SimulationError: it does not come to rest.
    """
    damped = replace(sheet, material=replace(sheet.material, damping=_SETTLING_DAMPING))
    flex = Flex(damped, _SETTLING_STEP, acceleration)
    flex.place(pose.reshape(-1, 3).numpy())
    slow = 0
    for _ in range(_SETTLING_STEPS):
        flex.step(-_SETTLING_RATE * flex.masses[:, None] * flex.velocities)
        slow = slow + 1 if float(np.abs(flex.velocities).max()) < _SETTLED_SPEED else 0
        if slow == _SETTLED_FOR:
            return torch.from_numpy(flex.positions).reshape(*sheet.grid, 3)
    raise SimulationError("generator: MuJoCo's cloth does not settle")


def simulate_flex(
    sheet: FlexSheet,
    pose: Tensor,
    effects: Sequence[OutOfFamilyEffect],
    *,
    pinned_motion: PinnedMotion,
    gravity: Tensor,
    wind: Tensor,
    n_frames: int,
    fps: float,
    substeps: int,
) -> Tensor:
    """Motion of a sheet that is at rest in a pose at frame 0, when the effects begin.

    Args:
        sheet: the cloth.
        pose: (H, W, 3) [m].
        effects: that act; of the other generator those that act by forces, masses, gravity, path and time.
        pinned_motion: of the pinned vertices.
        gravity: (3,) [m/s²].
        wind: force per mass (3,) [m/s²], as fits model it.
        n_frames: F.
        fps: declared frames per second.
        substeps: steps per frame.

    Returns:
        Positions of every step ((F - 1)·substeps + 1, H, W, 3) [m]; every substeps-th is a frame.

    Raises:
        SimulationError: it diverged.
    """
    interval = 1 / fps
    for effect in effects:
        effect.begin()
        interval = effect.frame_interval(interval)
        gravity = effect.gravity(gravity)
    own = [e for e in effects if isinstance(e, FlexEffect)]
    pushing = [e for e in effects if type(e).acceleration is not OutOfFamilyEffect.acceleration]
    step = interval / substeps
    flex = Flex(sheet, step, gravity, [text for e in own if (text := e.obstacle())])
    cloth = sheet.cloth()
    masses = cloth.masses
    for effect in effects:
        masses = effect.masses(masses, places_on(sheet.grid))
    cloth = replace(cloth, masses=masses)
    flex.set_masses(masses.numpy())
    for e in own:
        e.prepare(flex)
    n_steps = (n_frames - 1) * substeps
    times = step * torch.arange(n_steps + 1, dtype=torch.float64)
    path = pinned_motion.displacement(times)[:, None]
    for effect in effects:
        path = path + effect.boundary(times)
    start = pose.reshape(-1, 3)
    held = (start[list(sheet.pinned)] + path).numpy()
    flex.place(start.numpy())
    steady = masses[:, None] * wind
    material = _material(sheet.material)
    motion = [start.numpy()]
    for k in range(n_steps):
        forces = steady
        if own or pushing:
            now = StepContext(
                cloth=cloth,
                material=material,
                positions=torch.from_numpy(flex.positions),
                velocities=torch.from_numpy(flex.velocities),
                time=step * (k + 1),
                time_step=step,
                boundary=torch.from_numpy(held[k + 1]),
            )
            for effect in pushing:
                acceleration = effect.acceleration(now)
                if acceleration is not None:
                    forces = forces + masses[:, None] * acceleration
            for e in own:
                e.update(flex, now.time)
                extra = e.force(flex, now)
                forces = forces if extra is None else forces + extra
        flex.hold(held[k + 1])
        flex.step(forces.numpy())
        motion.append(flex.positions)
    return torch.from_numpy(np.stack(motion)).reshape(n_steps + 1, *sheet.grid, 3)


def _material(material: FlexMaterial) -> Material:
    """What effects of the other generator may ask for; a lattice counts shear in other units."""
    values = {"stretching": material.stretching, "shearing": 0.0, "bending": material.bending}
    return Material.of(GRID_PARAMETERS, values)


def _model_text(sheet: FlexSheet, rest: Array, step: float, gravity: Tensor, obstacles: Sequence[str]) -> str:
    """MJCF of the cloth, flat, with a mocap body at every pinned vertex."""
    material = sheet.material
    total = sheet.areal_density * sheet.size[0] * sheet.size[1]
    mocap = "".join(f'<body name="hold_{k}" mocap="true" pos="{_numbers(rest[k])}"/>' for k in sheet.pinned)
    connections = "".join(
        f'<connect body1="cloth_{k}" body2="hold_{k}" anchor="0 0 0" solref="{_HOLD} 1" '
        'solimp="0.9999 0.9999 0.001"/>'
        for k in sheet.pinned
    )
    contact = "enable" if obstacles else "disable"
    young = material.stretching / material.thickness
    return f"""<mujoco>
<option timestep="{step!r}" integrator="discrete" gravity="{_numbers(gravity.numpy())}">
<flag contact="{contact}"/></option>
<worldbody>{mocap}{"".join(obstacles)}
<flexcomp name="cloth" type="direct" dim="2" mass="{total!r}" radius="{_RADIUS}"
 point="{_numbers(rest.reshape(-1))}" element="{" ".join(map(str, _triangles(*sheet.grid).reshape(-1)))}">
<elasticity young="{young!r}" poisson="{material.poisson!r}" thickness="{material.thickness!r}"
 damping="{material.damping!r}" elastic2d="both"/>
<contact selfcollide="none" condim="3" solref="0.01 1"/>
</flexcomp></worldbody>
<equality>{connections}</equality>
</mujoco>"""


def _numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def _triangles(H: int, W: int) -> NDArray[np.int64]:
    """Triangles (T, 3) whose diagonals alternate, so that the sheet prefers neither of them."""
    result = []
    for i in range(H - 1):
        for j in range(W - 1):
            a, b, c, d = i * W + j, (i + 1) * W + j, (i + 1) * W + j + 1, i * W + j + 1
            result += [(a, b, c), (a, c, d)] if (i + j) % 2 == 0 else [(a, b, d), (b, c, d)]
    return np.array(result)
