"""Steps of newton's vertex block descent, for newton_vbd.py: run by a Python that has newton.

    <python> benchmarks/newton_steps.py problem.npz result.npz

The problem: vertices (N, 3), faces (T, 3), masses (N,), attached (A,), ways (S, A, 3) where those are after
every step, time_step, gravity, mu and lame of the membrane per area, iterations (K,). The result: positions
(K, N, 3) after the steps, seconds (K,) of the processor for each step.
"""

from __future__ import annotations

import sys
import time

import newton
import numpy as np
import warp as wp


def main() -> None:
    with np.load(sys.argv[1]) as file:
        problem = dict(file)
    wp.config.quiet = True
    wp.config.log_level = wp.LOG_ERROR if hasattr(wp, "LOG_ERROR") else None
    wp.set_device("cpu")
    n, attached = len(problem["vertices"]), problem["attached"]
    masses = problem["masses"].copy()
    masses[attached] = 0.0
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -float(problem["gravity"]), 0.0))
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*x) for x in problem["vertices"]],
        indices=problem["faces"].reshape(-1).tolist(),
        density=1.0,
        tri_ke=float(problem["mu"]),
        tri_ka=float(problem["lame"]),
        tri_kd=0.0,
        edge_ke=0.0,
        edge_kd=0.0,
        particle_radius=1e-4,
    )
    for i, mass in enumerate(masses):
        builder.particle_mass[i] = float(mass)
    builder.color()
    model = builder.finalize(device="cpu")
    found, seconds = [], []
    for k, iterations in enumerate([int(problem["iterations"][0]), *map(int, problem["iterations"])]):
        solver = newton.solvers.SolverVBD(
            model, iterations=iterations, particle_enable_self_contact=False, particle_enable_tile_solve=False
        )
        states = [model.state(), model.state()]
        control = model.control()
        begin = time.process_time()
        for ends in problem["ways"]:
            q = states[0].particle_q.numpy()
            q[attached] = ends
            states[0].particle_q.assign(q)
            states[0].clear_forces()
            solver.step(states[0], states[1], control, None, float(problem["time_step"]))
            states.reverse()
        if k:  # The first time kernels are compiled.
            seconds.append((time.process_time() - begin) / len(problem["ways"]))
            found.append(states[0].particle_q.numpy()[:n])
    np.savez(sys.argv[2], positions=np.array(found), seconds=np.array(seconds))


if __name__ == "__main__":
    main()
