"""Cloth of a third engine, MuJoCo's flex: finite elements on triangles, for sealed sets alone.

No setting of the diagnosis, no threshold, no calibration and no training scene may come from here, and nobody
looks at a diagnosis of its scenes while anything can still be tuned: what is reported on them says how the
diagnosis does on cloth that nobody has tuned on, or it says nothing.

Needs the package `mujoco-core` (the extra `mujoco`).
"""
