"""The simulation layer on the shipped subject, and its parts against exact results: `make capture-layer`.

Motions: skirt and dress through walk, twirl and squat, 300 frames with 4 sub-steps at 30 frames a second.
Sizes: time a frame by number of vertices. Friction: sliding on a plane and on a sphere against Coulomb's law.
Own contact: crossings of the garment with itself, with that option and without. Eq. 1: error to the truth
with a stiffness that is wrong by a factor of three, by number of cameras. Times are those of the processor,
of one thread. What is found is kept in outputs/capture_layer, so that it goes on where it was; a motion goes
on from its last 25 frames.

    python benchmarks/capture_layer.py [--part motions] [--kept] [--output docs/results/capture_layer]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
import trimesh
from scipy.integrate import solve_ivp
from torch import Tensor

from toile.atomic_file import write_text
from toile.capture.body.skinning import skin
from toile.capture.body.subject import load_subject
from toile.capture.data.filming import CameraRing
from toile.capture.garments import Garment, Material, attached_targets
from toile.capture.garments.patterns import make_dress, make_skirt
from toile.capture.layer.layer import GRAVITY, LayerSettings, SimulationLayer
from toile.capture.layer.silhouette import SilhouetteRays
from toile.capture.layer.workers import LayerWorkers
from toile.capture.losses.simulation import LayerWindow, window_on_layer
from toile.capture.motion.procedural import make_motion
from toile.geometry.mesh import grid_faces
from toile.geometry.moving_surface import MovingSurface
from toile.geometry.self_proximity import SelfProximity
from toile.physics.contact.own import OwnContactSettings
from toile.rendering import WarpRenderer

FOLDER = Path("outputs") / "capture_layer"
FPS, SUBSTEPS, FRAMES, SEED = 30.0, 4, 300, 0
GARMENTS: dict[str, Callable[..., Garment]] = {"skirt": make_skirt, "dress": make_dress}
MOTIONS = ("walk", "twirl", "squat")
VERTICES = 960
SIZES = (500, 1000, 1500, 3000)
CHUNK = 25
SUBJECT = "default"
FRICTIONS = (0.0, 0.3, 1.0)
OWN_FRAMES = 51
# Every side's vertices are among those of the next.
DRAPE_SIDES, DRAPE_SIDE, DRAPE_RADIUS, DRAPE_FRAMES = (5, 9, 17, 33), 0.2, 0.25, 46
BATCH_VERTICES, BATCH_WINDOWS, BATCH_FRAMES, BATCH_REPEATS = (448, 960), 8, 3, 3
SEEN_MOTION, SEEN_FRAMES, SEEN_VERTICES = "twirl", 31, 450


Case = tuple[str, Callable[[], dict]]


def table(cases: Iterable[Case], make: bool) -> pd.DataFrame:
    """Rows by their names: kept ones, and those that are made if there are none yet."""
    rows = []
    for name, case in cases:
        file = FOLDER / f"{name}.json"
        if make and not file.is_file():
            FOLDER.mkdir(parents=True, exist_ok=True)
            write_text(file, json.dumps(case(), indent=1))
        if file.is_file():
            rows.append(json.loads(file.read_text()))
    return pd.DataFrame(rows)


def bodies(motion: str, frames: int = FRAMES) -> Tensor:
    """Vertices (F, V, 3) of the subject in a motion."""
    subject = load_subject(SUBJECT)
    poses = make_motion(subject, motion, FRAMES, FPS, SEED)
    return torch.cat([skin(subject, poses[i : i + 30]) for i in range(0, frames, 30)])[:frames]


class Depths(NamedTuple):
    """How far cloth and body are in each other [m].

    Attributes:
        vertex: deepest vertex of the cloth in the body.
        through: deepest vertex of the body through the cloth: the larger one of two, along the body's normal
            to the nearest place on the cloth, if that place is in the body (a fold far beside is not), and
            along a ray inwards to the first face of the cloth.
        surface: deepest place of the cloth in the body, of its faces as well: what lies between the vertices
            of both, and no other measure sees.
    """

    vertex: float
    through: float
    surface: float


# Places in a face, an eighth of its edges apart.
PARTS_OF_EDGE = 8
IN_FACE = (
    np.array(
        [
            (i, j, PARTS_OF_EDGE - i - j)
            for i in range(PARTS_OF_EDGE + 1)
            for j in range(PARTS_OF_EDGE + 1 - i)
        ]
    )
    / PARTS_OF_EDGE
)


def penetration(layer: SimulationLayer, body: np.ndarray, cloth: np.ndarray) -> Depths:
    """See Depths; attached vertices, and places in faces that are mostly theirs, are left out."""
    contact = layer.contact
    contact.body.move(body)
    found = contact.surface(cloth[contact.loose], 0.08)
    contact.cloth.move(cloth)
    normals = contact.normals(body)[contact.active]
    points = body[contact.active]
    near = ((points > cloth.min(0) - 0.03) & (points < cloth.max(0) + 0.03)).all(1)
    facing, gaps = contact.facing(points[near], normals[near], 0.03)
    inside = contact.body.nearest(facing.points, 0.03)
    gaps = gaps[inside.which[inside.distances < 0.0]]
    every = MovingSurface(len(cloth), layer.cloth.topology.faces.numpy())
    every.move(cloth)
    hits = every.hits(points[near], -normals[near], 0.03)
    through = max(-gaps.min(initial=0.0), hits[np.isfinite(hits)].max(initial=0.0))
    # No place is farther from the body's inside than the middle of its face less its way from there.
    faces = contact.cloth.faces
    middles = cloth[faces].mean(1)
    widths = np.linalg.norm(cloth[faces] - middles[:, None], axis=2).max(1)
    around = contact.body.nearest(middles, 0.08)
    faces = faces[around.which[around.distances < widths[around.which]]]
    movable = contact.free[faces] @ IN_FACE.T > 0.2
    places = np.einsum("pk,tkd->tpd", IN_FACE, cloth[faces])[movable]
    within = contact.surface(places, 0.08)
    deepest = [max(0.0, -float(near.distances.min(initial=0.0))) for near in (found, within)]
    return Depths(deepest[0], float(through), deepest[1])


def run(garment_name: str, motion_name: str, vertices: int = VERTICES, frames: int = FRAMES) -> dict:
    """Simulate a garment through a motion in chunks that are kept."""
    subject = load_subject(SUBJECT)
    garment = GARMENTS[garment_name](subject, vertices)
    layer = SimulationLayer.of(garment, subject)
    body = bodies(motion_name, frames)
    # Kernels are compiled, the pattern is analysed.
    at_rest = torch.zeros_like(garment.rest_vertices)
    layer.step(garment.rest_vertices, at_rest, body[0], body[0], 1 / (FPS * SUBSTEPS))
    x, v = garment.rest_vertices, at_rest
    chunks = []
    for first in range(0, frames - 1, CHUNK):
        last = min(first + CHUNK, frames - 1)
        file = FOLDER / "chunks" / f"{garment_name}_{motion_name}_{vertices}_{first}.npz"
        if not file.is_file():
            begin, cpu = time.perf_counter(), time.process_time()
            motion = layer.simulate(body[first : last + 1], FPS, SUBSTEPS, x, v)
            cpu, wall = time.process_time() - cpu, time.perf_counter() - begin
            targets = attached_targets(garment, body[first : last + 1], subject.faces).numpy()
            held = motion.garment_positions[:, garment.attached.numpy()] - targets
            file.parent.mkdir(parents=True, exist_ok=True)
            partial_file = file.with_suffix(".partial.npz")
            np.savez(
                partial_file,
                positions=motion.garment_positions[1:],
                velocities=motion.velocities,
                converged=motion.converged,
                newton=motion.newton_steps,
                energy=np.stack((motion.kinetic, motion.elastic, motion.gravitational)),
                waist=np.linalg.norm(held[1:], axis=-1).max(initial=0.0),
                seconds=np.array([cpu, wall]),
            )
            os.replace(partial_file, file)
            print(
                f"{garment_name} {motion_name} {vertices}: frames {first}-{last} in {cpu:.1f} s", flush=True
            )
        with np.load(file) as found:
            chunks.append(dict(found))
        x, v = torch.from_numpy(chunks[-1]["positions"][-1]), torch.from_numpy(chunks[-1]["velocities"])
    moved = np.concatenate([chunk["positions"] for chunk in chunks])
    depths = np.array([penetration(layer, *pair) for pair in zip(body[1:].numpy(), moved, strict=True)])
    energy = np.concatenate([chunk["energy"][:, 1:] for chunk in chunks], 1)
    cpu, wall = sum(chunk["seconds"] for chunk in chunks)
    converged = np.concatenate([chunk["converged"] for chunk in chunks])
    newton = np.concatenate([chunk["newton"] for chunk in chunks])
    return {
        "subject": SUBJECT,
        "garment": garment_name,
        "motion": motion_name,
        "vertices": layer.cloth.n_vertices,
        "frames": frames,
        "converged_share": float(converged.mean()),
        "penetration_max_mm": 1e3 * abs(float(depths[:, 0].max())),
        "penetration_body_through_cloth_mm": 1e3 * abs(float(depths[:, 1].max())),
        "penetration_surface_mm": 1e3 * float(depths[:, 2].max()),
        "waist_error_mm": 1e3 * float(max(chunk["waist"] for chunk in chunks)),
        "seconds_per_frame": float(cpu) / (frames - 1),
        "wall_seconds_per_frame": float(wall) / (frames - 1),
        "newton_steps": float(newton.mean()),
        "most_newton_steps": int(newton.max()),
        "kinetic_max_mJ": 1e3 * float(energy[0].max()),
        "elastic_max_mJ": 1e3 * float(energy[1].max()),
        "elastic_end_mJ": 1e3 * float(energy[1, -1]),
    }


COLUMNS = (
    "subject",
    "garment",
    "motion",
    "vertices",
    "frames",
    "converged_share",
    "penetration_max_mm",
    "penetration_body_through_cloth_mm",
    "waist_error_mm",
    "seconds_per_frame",
)


def motions() -> Iterator[Case]:
    """Every garment through every motion."""
    for garment in GARMENTS:
        for motion in MOTIONS:
            yield f"{garment}_{motion}_{VERTICES}", partial(run, garment, motion)


def sizes() -> Iterator[Case]:
    """A skirt of several resolutions, the first second of the walk."""
    for n in SIZES:
        yield f"size_{n}", partial(run, "skirt", "walk", n, 31)


def own_contact() -> Iterator[Case]:
    """Motions with the garment's contact with itself and without."""
    for garment, motion in (("skirt", "twirl"), ("skirt", "walk"), ("skirt", "squat"), ("dress", "squat")):
        for own in (None, OwnContactSettings()):
            name = f"own_{garment}_{motion}_{'off' if own is None else 'on'}"
            yield name, partial(through_itself, garment, motion, own)


def through_itself(garment_name: str, motion_name: str, own: OwnContactSettings | None) -> dict:
    """How often edges of a garment go through faces of it, frame by frame."""
    subject = load_subject(SUBJECT)
    garment = GARMENTS[garment_name](subject, VERTICES)
    layer = SimulationLayer.of(garment, subject, LayerSettings(own_contact=own))
    body = bodies(motion_name, OWN_FRAMES)
    layer.simulate(body[:2], FPS, 1)
    cpu = time.process_time()
    motion = layer.simulate(body, FPS, SUBSTEPS)
    cpu = time.process_time() - cpu
    topology = layer.cloth.topology
    proximity = SelfProximity(
        layer.cloth.n_vertices, topology.faces.numpy(), topology.edges.numpy(), garment.attached.numpy(), 0.01
    )
    crossings = [proximity.crossings(x) for x in motion.garment_positions]
    pairs = zip(body.numpy(), motion.garment_positions, strict=True)
    depths = np.array([penetration(layer, person, x) for person, x in pairs])
    return {
        "garment": garment_name,
        "motion": motion_name,
        "own_contact": "off" if own is None else "on",
        "frames": OWN_FRAMES,
        "crossings_max": max(crossings),
        "crossings_end": crossings[-1],
        "converged_share": float(motion.converged.mean()),
        "penetration_max_mm": 1e3 * float(depths[:, 0].max()),
        "penetration_body_through_cloth_mm": 1e3 * abs(float(depths[:, 1].max())),
        "penetration_surface_mm": 1e3 * float(depths[:, 2].max()),
        "newton_steps": float(motion.newton_steps.mean()),
        "seconds_per_frame": cpu / (OWN_FRAMES - 1),
    }


def drape() -> Iterator[Case]:
    """A square sheet that falls on a sphere and comes to rest, finer and finer."""
    for n in DRAPE_SIDES:
        yield f"drape_{n}", partial(refined, n)


@cache
def draped(n: int) -> tuple[np.ndarray, float, float]:
    """Where a sheet of n² vertices rests on a sphere, its speed [m/s] there, and share of steps converged."""
    # Soft enough in its plane to lie on a sphere without folds, of which there would be several.
    soft = Material(young=50.0, bending=3e-4, friction=0.3)
    garment = replace(sheet(DRAPE_SIDE, n, 0.0, DRAPE_RADIUS + 0.008), material=soft)
    mesh = trimesh.creation.icosphere(5, DRAPE_RADIUS)
    layer = SimulationLayer(garment, torch.from_numpy(np.array(mesh.faces, np.int64)))
    still = torch.from_numpy(np.array(mesh.vertices)).expand(DRAPE_FRAMES, -1, -1)
    motion = layer.simulate(still, FPS, 1)
    speed = float(np.linalg.norm(motion.velocities, axis=1).max())
    return motion.garment_positions[-1], speed, float(motion.converged.mean())


def refined(n: int) -> dict:
    """Distance of a sheet's vertices to those at the same places of the finest one."""
    x, speed, converged = draped(n)
    finest = DRAPE_SIDES[-1]
    every = (finest - 1) // (n - 1)
    there = draped(finest)[0].reshape(finest, finest, 3)[::every, ::every].reshape(-1, 3)
    away = np.linalg.norm(x - there, axis=1)
    return {
        "vertices": n * n,
        "edge_mm": 1e3 * DRAPE_SIDE / (n - 1),
        "error_rms_mm": 1e3 * float(np.sqrt(np.square(away).mean())),
        "error_max_mm": 1e3 * float(away.max()),
        "lowest_mm": 1e3 * float(x[:, 1].min()),
        "nearest_to_sphere_mm": 1e3 * float(np.linalg.norm(x, axis=1).min() - DRAPE_RADIUS),
        "speed_mm_per_s": 1e3 * speed,
        "converged_share": converged,
    }


def friction() -> Iterator[Case]:
    """A patch of cloth on an inclined plane and on a sphere, against Coulomb's law."""
    for degrees in (10, 25, 55):
        for mu in FRICTIONS:
            yield f"plane_{degrees}_{mu}", partial(on_a_plane, degrees, mu)
    for mu in FRICTIONS:
        yield f"sphere_{mu}", partial(on_a_sphere, mu)


def patch(size: float, tilt: float, lift: float, mu: float) -> Garment:
    """A square of nine vertices for friction, see ``sheet``."""
    return replace(sheet(size, 3, tilt, lift), material=Material(young=200.0, bending=1e-3, friction=mu))


def sheet(size: float, n: int, tilt: float, lift: float) -> Garment:
    """A square of n² vertices, held nowhere, at a height over the origin and turned about z with it."""
    at = torch.linspace(-size / 2, size / 2, n, dtype=torch.float64)
    z, x = torch.meshgrid(at, at, indexing="ij")
    flat = torch.stack((x, torch.full_like(x, lift), z), -1).reshape(-1, 3)
    c, s = np.cos(tilt), np.sin(tilt)
    turn = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64)
    none, index = torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int64)
    return Garment(flat @ turn.T, grid_faces(n, n), index, index, none, none)


def resting(pressure: float) -> float:
    """Height over the body where the contact bears a force per mass [m/s²]."""
    contact = LayerSettings().contact
    return contact.thickness - float(np.sqrt(2 * contact.smoothing * pressure / contact.stiffness))


def slid(garment: Garment, body: np.ndarray, faces: np.ndarray, seconds: float) -> np.ndarray:
    """Middle of a cloth on a still body over time, (F, 3) with 60 frames a second."""
    layer = SimulationLayer(garment, torch.from_numpy(faces))
    still = torch.from_numpy(body).expand(1 + round(60 * seconds), -1, -1)
    motion = layer.simulate(still, 60.0, SUBSTEPS)
    if not motion.converged.all():
        raise RuntimeError("a step on a still body did not converge")
    return motion.garment_positions.mean(1)


def on_a_plane(degrees: float, mu: float) -> dict:
    """Acceleration down a plane within a quarter of a second [m/s²]."""
    angle, seconds = np.deg2rad(degrees), 0.25
    square = np.array([[-9.0, 0, -9], [-9, 0, 9], [9, 0, 9], [9, 0, -9]])
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    garment = patch(0.1, angle, resting(GRAVITY * np.cos(angle)), mu)
    middle = slid(garment, square @ turn.T, np.array([[0, 1, 2], [0, 2, 3]]), seconds)
    way = float(np.linalg.norm(middle[-1] - middle[0]))
    n = round(60 * SUBSTEPS * seconds)
    # Implicit Euler goes n (n + 1) / 2 steps of a h² where the exact way is n² / 2.
    return {
        "on": "plane",
        "degrees": degrees,
        "friction": mu,
        "unit": "m/s²",
        "expected": max(GRAVITY * (np.sin(angle) - mu * np.cos(angle)), 0.0),
        "found": 2 * way * (60 * SUBSTEPS) ** 2 / (n * (n + 1)),
    }


def on_a_sphere(mu: float) -> dict:
    """Way down a sphere of half a metre from 35 degrees off its top within a fifth of a second [degrees]."""
    radius, first, seconds = 0.5, np.deg2rad(35.0), 0.2
    mesh = trimesh.creation.icosphere(6, radius)
    garment = patch(0.01, first, radius + resting(GRAVITY * np.cos(first)), mu)
    middle = slid(garment, np.array(mesh.vertices), np.array(mesh.faces, np.int64), seconds)
    angles = np.arctan2(middle[:, 0], middle[:, 1])
    around = float(np.linalg.norm(middle[0]))

    def motion(_: float, y: np.ndarray) -> list[float]:
        turn = GRAVITY * np.sin(y[0]) - mu * (GRAVITY * np.cos(y[0]) - around * y[1] ** 2)
        return [y[1], turn / around]

    slides = np.tan(first) > mu
    exact = solve_ivp(motion, (0, seconds), [first, 0.0], rtol=1e-9).y[0, -1] - first if slides else 0.0
    return {
        "on": "sphere",
        "degrees": 35,
        "friction": mu,
        "unit": "degrees",
        "expected": float(np.rad2deg(exact)),
        "found": float(np.rad2deg(angles[-1] - angles[0])),
    }


def batches() -> Iterator[Case]:
    """Windows of a training's batch, one after the other and in two processes."""
    for n in BATCH_VERTICES:
        for count in (1, 2):
            yield f"batch_{n}_{count}", partial(in_processes, n, count)


@cache
def windows(vertices: int) -> tuple[Garment, list[LayerWindow]]:
    """Skirt, and windows of its walk, 10 to 80 frames from the start."""
    subject = load_subject(SUBJECT)
    garment = make_skirt(subject, vertices)
    body = bodies("walk", 31)
    motion = SimulationLayer.of(garment, subject).simulate(body, FPS, 1)
    x = torch.from_numpy(motion.garment_positions)
    begins = np.linspace(5, 31 - BATCH_FRAMES, BATCH_WINDOWS).astype(int)
    return garment, [
        LayerWindow(x[k : k + BATCH_FRAMES], body[k : k + BATCH_FRAMES], FPS, 1) for k in map(int, begins)
    ]


def timed_window(layer: SimulationLayer, window: LayerWindow) -> tuple[Tensor, float]:
    """What a layer makes of a window, and seconds of the processor."""
    cpu = time.process_time()
    positions = window_on_layer(layer, window).positions
    return positions, time.process_time() - cpu


def in_processes(vertices: int, count: int) -> dict:
    """Time of a batch of windows, and whether its digits are those of one process."""
    garment, asked = windows(vertices)
    layer = SimulationLayer.of(garment, load_subject(SUBJECT))
    window_on_layer(layer, asked[0])
    alone = [window_on_layer(layer, window).positions for window in asked]
    with LayerWorkers(layer, count) as workers:
        begin = time.perf_counter()
        workers.map(timed_window, asked)
        first = time.perf_counter() - begin
        walls, own = [], []
        for _ in range(BATCH_REPEATS):
            begin, cpu = time.perf_counter(), time.process_time()
            found = workers.map(timed_window, asked)
            walls.append(time.perf_counter() - begin)
            of_this = time.process_time() - cpu
            own.append(of_this if count == 1 else of_this + sum(seconds for _, seconds in found))
    return {
        "vertices": layer.cloth.n_vertices,
        "windows": len(asked),
        "frames": BATCH_FRAMES,
        "processes": count,
        "first_batch_seconds": first,
        "wall_seconds": min(walls),
        "slowest_wall_seconds": max(walls),
        "cpu_seconds": min(own),
        "same_digits": all(torch.equal(x, y) for x, (y, _) in zip(alone, found, strict=True)),
    }


def silhouettes() -> Iterator[Case]:
    """Error to the truth of a skirt whose stiffness is a third, or three times, of what is true."""
    for factor in (1 / 3, 3.0):
        for cameras, along in ((0, 1.0), (1, 1.0), (2, 1.0), (4, 1.0), (8, 1.0), (4, 0.0)):
            yield f"eq1_{factor:.2f}_{cameras}_{along:g}", partial(drawn, factor, cameras, along)


@cache
def seen() -> tuple[Garment, np.ndarray, list[list[SilhouetteRays]]]:
    """Skirt, its true motion, and its silhouettes in eight views at every frame."""
    subject = load_subject(SUBJECT)
    garment = make_skirt(subject, SEEN_VERTICES)
    body = bodies(SEEN_MOTION, SEEN_FRAMES)
    truth = SimulationLayer.of(garment, subject).simulate(body, FPS, SUBSTEPS).garment_positions
    renderer, ring = WarpRenderer(), CameraRing(views=8, side=256).cameras()
    faces = torch.cat((garment.faces, subject.faces + truth.shape[1]))
    rays = []
    for cloth, person in zip(truth, body, strict=True):
        vertices = torch.cat((torch.from_numpy(cloth), person)).float()[None]
        found = [renderer.rasterize(vertices, faces, camera).face[0].numpy() for camera in ring]
        rays.append(
            [
                SilhouetteRays.of_mask(camera, (face >= 0) & (face < len(garment.faces)), face >= 0)
                for camera, face in zip(ring, found, strict=True)
            ]
        )
    return garment, truth, rays


def drawn(factor: float, cameras: int, along: float) -> dict:
    """Error of a skirt of another stiffness, drawn to the silhouettes of some of the views."""
    garment, truth, every = seen()
    material = garment.material
    other = replace(material, young=factor * material.young, bending=factor * material.bending)
    settings = LayerSettings(silhouette_along=along)
    layer = SimulationLayer.of(replace(garment, material=other), load_subject(SUBJECT), settings)
    views = [frame[:: 8 // cameras] if cameras else [] for frame in every]
    cpu = time.process_time()
    motion = layer.simulate(bodies(SEEN_MOTION, SEEN_FRAMES), FPS, SUBSTEPS, silhouettes=views)
    cpu = time.process_time() - cpu
    away = np.linalg.norm(motion.garment_positions - truth, axis=-1)[SEEN_FRAMES // 2 :, layer.contact.loose]
    return {
        "stiffness": f"{factor:.2g}",
        "cameras": cameras,
        "along": along,
        "error_mm": 1e3 * float(away.mean()),
        "worst_frame_mm": 1e3 * float(away.mean(1).max()),
        "converged_share": float(motion.converged.mean()),
        "seconds_per_frame": cpu / (SEEN_FRAMES - 1),
    }


PARTS: dict[str, tuple[str, Callable[[], Iterator[Case]]]] = {
    "motions": (
        "4 sub-steps at 30 frames a second. Penetration of garment vertices in the body; of body "
        "vertices through the garment, the larger of two measures (nearest place on the garment along the "
        "body's normal, where it is in the body; ray inwards); of places in the garment's faces, an eighth "
        "of their edges apart, in the body (surface). Attached vertices against where the body "
        "takes them. Seconds of the processor, one thread; energies in millijoule.",
        motions,
    ),
    "sizes": ("The first second of the skirt's walk by number of vertices.", sizes),
    "own contact": (
        f"The first {OWN_FRAMES} frames, with contact of the garment with itself (off by default) and "
        "without. Crossings: edges times faces of the garment that go through each other in a frame.",
        own_contact,
    ),
    "drape": (
        f"A square sheet of {1e3 * DRAPE_SIDE:g} mm that falls on a sphere of {1e3 * DRAPE_RADIUS:g} mm "
        f"radius (50 N/m, 3e-4 J, friction 0.3) and rests after {(DRAPE_FRAMES - 1) / FPS:g} s: its vertices "
        "against those at the same places of the finest sheet. Heights are above the sphere's middle; "
        "vertices keep 3 mm from the sphere.",
        drape,
    ),
    "friction": (
        "Way of a patch of cloth on a plane, as its acceleration, and on a sphere. What sticks creeps below "
        "5 mm/s.",
        friction,
    ),
    "batches": (
        f"A batch of {BATCH_WINDOWS} windows of a training ({BATCH_FRAMES} frames, one sub-step per frame), "
        f"one after the other and in two processes: the fastest and the slowest of {BATCH_REPEATS} on two "
        "cores. The first batch starts the processes. Seconds of the processor are those of all processes. "
        "Same digits: as one after the other, where that has one thread as well (OMP_NUM_THREADS=1).",
        batches,
    ),
    "silhouettes": (
        f"Eq. 1 with another stiffness than the truth's: error of free vertices over the second half of "
        f"{SEEN_FRAMES} frames of a {SEEN_MOTION}, {SEEN_VERTICES} vertices, images of 256 px. Along: share "
        "of a pixel's weight along the silhouette, 1 in Eq. 1.",
        silhouettes,
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--part", choices=PARTS, help="only this one, and write nothing")
    parser.add_argument("--kept", action="store_true", help="write what is kept, make nothing")
    parser.add_argument("--output", type=Path, default=Path("docs/results/capture_layer"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.part:
        print(table(PARTS[arguments.part][1](), make=True).to_string())
        return
    tables = {name: table(cases(), make=not arguments.kept) for name, (_, cases) in PARTS.items()}
    csv = tables["motions"].reindex(columns=list(COLUMNS)).to_csv(index=False, float_format="%.4g")
    write_text(arguments.output.with_suffix(".csv"), csv)
    lines = ["# The simulation layer (`make capture-layer`)"]
    for name, (text, _) in PARTS.items():
        lines += ["", f"## {name.capitalize()}", "", text]
        if len(tables[name]):
            lines += ["", tables[name].to_markdown(index=False, floatfmt=".4g")]
    write_text(arguments.output.with_suffix(".md"), "\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
