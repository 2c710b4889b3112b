"""The motion that fitted parameters give, how well it keeps Newton's second law, and what it looks like."""

from __future__ import annotations

from collections.abc import Iterator

import numpy.typing as npt
import torch
from torch import Tensor

from toile.evaluation.out_of_balance import OutOfBalanceForce, out_of_balance_force
from toile.physics.implicit.terms import term_forces
from toile.physics.simulator import SimulationError
from toile.physics.step_terms import ElementTerm, StepContext
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import Scene


@torch.no_grad()
def final_trajectory(reconstruction: Reconstruction, substep_positions: Tensor | None) -> Tensor:
    """The whole video simulated once more from the fitted parameters, (F, H, W, 3) [m].

    Args:
        reconstruction: with the fitted parameters.
        substep_positions: where every step starts its iterations, see Recipe.substep_positions; None starts
            from the past alone, and then a buckling cloth may settle in another equilibrium.

    Raises:
        SimulationError: a step did not converge.
    """
    scene = reconstruction.scene
    motion = reconstruction.simulate(scene.n_frames, substep_positions)
    return motion.positions[0].reshape(scene.n_frames, *scene.grid, 3)


def cold_trajectory(reconstruction: Reconstruction) -> Tensor | None:
    """The motion that the parameters give on their own (F, H, W, 3) [m]; None where a step fails."""
    try:
        return final_trajectory(reconstruction, None)
    except SimulationError:
        return None


def largest_distance(trajectory: Tensor, other: Tensor) -> float:
    """Largest distance [m] of a vertex of (F, H, W, 3) to where it is in the first frames (n, ..., 3)."""
    return float((trajectory[: len(other)].reshape(other.shape) - other).norm(dim=-1).max())


@torch.no_grad()
def residual_force(reconstruction: Reconstruction, trajectory: Tensor) -> OutOfBalanceForce | None:
    """Out-of-balance force of the trajectory under the fitted forces and effects.

    None for fewer than three frames. Effects within a step act as in a sub-step that ends in the frame with
    the velocity between the frames beside it. Frames count as being where they were simulated.
    """
    scene, given = reconstruction.scene, reconstruction.setting()
    cloth, interval = given.cloth, float(given.frame_interval)
    if scene.n_frames < 3 or not bool(scene.gravity.any()):
        return None
    step = interval / reconstruction.frame_steps.per_frame
    regular = torch.arange(scene.n_frames, dtype=torch.float64) * interval
    times = regular if scene.times is None else reconstruction.frame_steps.times(step)
    material = reconstruction.parameters.material()
    elastic = not any(isinstance(term, ElementTerm) for term in given.terms)

    def internal_forces(positions: Tensor) -> Tensor:
        with torch.enable_grad():
            x = positions.reshape(len(positions), -1, 3).clone().requires_grad_()
            energy = cloth.energies.energy(x, cloth.energies.coefficients(material.values))
            return -torch.autograd.grad(energy.sum(), x)[0].reshape(positions.shape)

    def with_terms(positions: Tensor) -> Tensor:
        if not given.terms:
            return internal_forces(positions)
        x = trajectory.reshape(scene.n_frames, -1, 3)
        if scene.times is None:
            velocities = (x[2:] - x[:-2]) / (2 * interval)
        else:
            velocities = torch.gradient(x, spacing=(times,), dim=0)[0][1:-1]
        forces = []
        for frame, (at, velocity) in enumerate(zip(x[1:-1], velocities, strict=True), 1):
            now = StepContext(
                cloth, material, at - step * velocity, velocity, float(times[frame]), step, at[cloth.pinned]
            )
            # Where terms change the elements, this is the elastic force, too.
            forces.append(term_forces(given.terms, now, at).detach())
        found = torch.stack(forces).reshape(positions.shape)
        return found + internal_forces(positions) if elastic else found

    # Forces entry t acts on frame t + 1; the inner frames are 1 ... F - 2.
    forces = reconstruction.forces(given, 0, scene.n_frames - 2)
    return out_of_balance_force(
        trajectory,
        masses=cloth.masses.reshape(scene.grid),
        internal_forces=with_terms,
        external_forces=forces.reshape(-1, *scene.grid, 3),
        frame_time=interval if scene.times is None else times.diff(),
        gravity=scene.gravity,
        pinned_vertices=scene.pinned_vertices,
    )


def fitted_parameters(reconstruction: Reconstruction) -> dict[str, npt.ArrayLike]:
    """Everything that was fitted, by name and unit, for trajectory.npz."""
    p, grid = reconstruction.parameters, reconstruction.scene.grid
    material = p.material()
    result: dict[str, npt.ArrayLike] = {
        parameter.label: value
        for parameter, value in zip(material.parameters, material.values[0].tolist(), strict=True)
    }
    for name in p.STIFFNESSES:
        result[f"{name} [network units]"] = p.get_parameter(name).item()
    result.update(reconstruction.effects.coefficients())
    result["wind [m/s²]"] = p.wind.detach().numpy()
    result["turbulence [m/s²]"] = p.turbulence.detach().numpy().reshape(-1, *grid, 3)
    result["boundary motion [m]"] = p.boundary_motion.detach().numpy()
    result["pinned vertices"] = reconstruction.cloth.pinned.numpy()
    result["texture offset"] = p.texture_offset.detach().numpy().reshape(*grid, 2)
    with torch.no_grad():
        result["masses [kg]"] = reconstruction.setting().cloth.masses.numpy().reshape(grid)
    result["rest lengths [m]"] = reconstruction.cloth.rest_lengths.numpy()
    return result


def fitted_scene(reconstruction: Reconstruction) -> Scene:
    """The scene with its texture coordinates as fitted."""
    return reconstruction.scene.with_texture_offset(reconstruction.parameters.texture_offset.detach())


@torch.no_grad()
def rendered_frames(reconstruction: Reconstruction, scene: Scene, trajectory: Tensor) -> Iterator[Tensor]:
    """Pictures (h, w, 3) of a trajectory (F, H, W, 3) [m] with the scene's texture, one by one."""
    uv = scene.texture_coordinates.reshape(-1, 2)
    for x in trajectory.reshape(scene.n_frames, 1, -1, 3):
        images = reconstruction.renderer.render(x, reconstruction.faces, uv, scene.texture, scene.camera)
        yield images.rgb[0]
