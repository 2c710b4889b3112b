"""What one camera can tell apart in a person's garment: `make capture-aliases`.

A skirt is simulated on a person who walks and squats, once as it is and twice for every effect, with some
more and some less of it. The central difference is how the masks of person and garment answer to it, and
how the garment's vertices do. Two effects whose answers point the same way cannot be told apart: the tables
have the cosine of every pair, seen by one camera, by four, and with the vertices known; and for every effect
the share of its answer that no mixture of the others explains.

Sizes of the differences are in ``EFFECTS``; cosines and shares do not depend on them as long as the answer is
linear, which ``linearity`` measures: the cosine of the two one-sided answers.

    python benchmarks/capture_aliases.py [--frames 14] [--output docs/results/capture_aliases]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import roma
import torch
from numpy.typing import NDArray
from torch import Tensor

from toile.atomic_file import write_text
from toile.capture.body.humanoid import humanoid_joints
from toile.capture.body.poses import Poses, from_world_axes, in_world_axes
from toile.capture.body.skinning import skin
from toile.capture.body.subject import Subject, load_subject
from toile.capture.data.filming import CameraRing
from toile.capture.garments import Garment, attached_targets
from toile.capture.garments.patterns import make_skirt
from toile.capture.layer.layer import SimulationLayer
from toile.capture.losses.silhouette import distance_field
from toile.capture.motion.procedural import make_motion
from toile.effects.air_drag import AirDrag
from toile.geometry.camera import Camera
from toile.geometry.mesh import vertex_normals
from toile.rendering import WarpRenderer

Floats = NDArray[np.float64]

FPS, SUBSTEPS, VERTICES, SEED = 30.0, 2, 300, 0
MOTIONS = ("walk", "squat")
CAMERAS, SIDE = 4, 128


@dataclass(frozen=True)
class Scene:
    """What a roll-out depends on.

    Attributes:
        friction: of cloth and body, as a multiple.
        stiffness: of membrane and bending, as a multiple.
        drag: of the air across the cloth [1/s].
        thigh: turn of both thighs forwards [rad].
        girth: of the skin of hips and legs, along its normals [m].
        slip: of the waistband, downwards [m].
        bias: of both masks, outwards [px].
    """

    friction: float = 1.0
    stiffness: float = 1.0
    drag: float = 0.5
    thigh: float = 0.0
    girth: float = 0.0
    slip: float = 0.0
    bias: float = 0.0

    def changed(self, name: str, by: float) -> Scene:
        """With one number changed."""
        values: dict[str, float] = {name: getattr(self, name) + by}
        return replace(self, **values)


@dataclass(frozen=True)
class Effect:
    """An effect of the diagnosis of a capture scene.

    Attributes:
        field: of the scene.
        size: of the difference, up and down.
        unit: of that size.
    """

    field: str
    size: float
    unit: str


EFFECTS = {
    "mask_bias": Effect("bias", 0.5, "half a pixel"),
    "body_friction": Effect("friction", 0.3, "of 0.3"),
    "pose_error": Effect("thigh", math.radians(2.0), "2 degrees of both thighs"),
    "body_shape": Effect("girth", 0.004, "4 mm of hips and legs"),
    "garment_stiffness": Effect("stiffness", 0.3, "of 500 N/m and 1e-5 J"),
    "waist_slip": Effect("slip", 0.008, "8 mm downwards"),
    "air_drag": Effect("drag", 0.4, "0.4 1/s across the cloth"),
}


@dataclass(frozen=True)
class Seen:
    """What is known of a roll-out.

    Attributes:
        vertices: of the garment (F, N, 3) [m].
        masks: of person and garment in every camera (C, 2, F, h, w) in [0, 1].
        converged: share of the layer's steps.
    """

    vertices: Floats
    masks: Floats
    converged: float


class Stage:
    """A motion of the default person, in a skirt, before a ring of cameras.

    Args:
        motion: its name.
        frames: of it; the first five are left out.
    """

    def __init__(self, motion: str, frames: int) -> None:
        self.subject: Subject = load_subject("default")
        self.garment: Garment = make_skirt(self.subject, vertices=VERTICES)
        self.poses: Poses = make_motion(self.subject, motion, frames, FPS, SEED)
        self.cameras: Sequence[Camera] = CameraRing(views=CAMERAS, side=SIDE).cameras()
        self.renderer = WarpRenderer(2)
        joints = humanoid_joints(self.subject.joint_names)
        self.thighs = [joints["left_upper_leg"], joints["right_upper_leg"]]
        # Hips and legs: all below the waistband but the arms.
        rest = self.subject.rest_vertices
        top = float(self.garment.rest_vertices[:, 1].max())
        low = (rest[:, 1] < top) & ~self.subject.parts["arms"]
        # Faded out over 10 cm, so that the skin has no step.
        fade = ((top - rest[:, 1]) / 0.1).clamp(0.0, 1.0) * low
        self.skin_moves = fade[:, None] * vertex_normals(rest, self.subject.faces)
        self._known: dict[Scene, tuple[Tensor, Tensor, float]] = {}
        self.faces = torch.cat((self.subject.faces, self.garment.faces + len(rest)))

    def __call__(self, scene: Scene) -> Seen:
        """Roll out and look."""
        # Masks alone do not change the motion.
        moving = replace(scene, bias=0.0)
        if moving not in self._known:
            self._known = {moving: self._rolled(moving)}
        x, bodies, converged = self._known[moving]
        keep = slice(5, None)
        return Seen(x[keep].numpy(), self._masks(x[keep], bodies[keep], scene.bias), converged)

    def _bodies(self, scene: Scene) -> Tensor:
        rotations = in_world_axes(self.subject, self.poses)
        turn = roma.rotvec_to_rotmat(torch.tensor([-scene.thigh, 0.0, 0.0], dtype=torch.float64))
        # Grows out of the pose at rest, as the motion does.
        for joint in self.thighs:
            rotations[:, joint] = rotations[:, joint] @ turn
        poses = from_world_axes(self.subject, rotations, self.poses.root_translation)
        rest = self.subject.rest_vertices + scene.girth * self.skin_moves
        return skin(replace(self.subject, rest_vertices=rest), poses)

    def _rolled(self, scene: Scene) -> tuple[Tensor, Tensor, float]:
        bodies = self._bodies(scene)
        drag = AirDrag({"linear": 0.0, "normal": scene.drag})
        layer = SimulationLayer.of(self.garment, self.subject, terms=(drag,))
        m = self.garment.material
        material = layer.cloth.material(
            young=scene.stiffness * m.young, poisson=m.poisson, bending=scene.stiffness * m.bending
        )
        down = torch.tensor([0.0, -scene.slip, 0.0], dtype=torch.float64)
        x, v = self.garment.rest_vertices.clone(), torch.zeros_like(self.garment.rest_vertices)
        frames, converged = [x], []
        body = bodies[0]
        with torch.no_grad():
            for f in range(1, len(bodies)):
                for sub in range(1, SUBSTEPS + 1):
                    after = torch.lerp(bodies[f - 1], bodies[f], sub / SUBSTEPS)
                    # The waistband slips within the five frames that are left out.
                    share = min(1.0, (f - 1 + sub / SUBSTEPS) / 4)
                    held = attached_targets(self.garment, after, self.subject.faces) + share * down
                    step = layer.step(
                        x,
                        v,
                        body,
                        after,
                        1 / (FPS * SUBSTEPS),
                        material=material,
                        friction=scene.friction * m.friction,
                        attached=held,
                    )
                    x, v, body = step.positions, step.velocities, after
                    converged.append(step.converged)
                frames.append(x)
        return torch.stack(frames), bodies, float(np.mean(converged))

    def _masks(self, garment: Tensor, bodies: Tensor, bias: float) -> Floats:
        both = torch.cat((bodies, garment), 1)
        # A white garment on a black body: its mask, where the body does not hide it.
        uv = torch.full((both.shape[1], 2), 0.5)
        uv[:, 0] = 0.1
        uv[bodies.shape[1] :, 0] = 0.9
        texture = torch.zeros(1, 10, 3)
        texture[:, 5:] = 1.0
        found = []
        for camera in self.cameras:
            drawn = self.renderer.render(both, self.faces, uv, texture, camera)
            found.append([_moved(drawn.silhouette, bias), _moved(drawn.rgb[..., 0], bias)])
        return np.stack([np.stack([mask.double().numpy() for mask in pair]) for pair in found])


def _moved(masks: Tensor, bias: float) -> Tensor:
    """Masks (F, h, w) whose outlines are moved outwards [px]."""
    if not bias:
        return masks
    moved = []
    for mask in masks:
        distance = distance_field(mask > 0.5)
        # Antialiased outlines stay so: the change alone is taken from the distances.
        change = (0.5 - (distance - bias)).clamp(0, 1) - (0.5 - distance).clamp(0, 1)
        moved.append(mask + change.to(mask))
    return torch.stack(moved)


def answers(stage: Stage, report: Callable[[str], None]) -> tuple[dict[str, dict[str, Floats]], pd.DataFrame]:
    """What each kind of observation answers to each effect, (n,) per unit size; and notes on every effect."""
    plain = stage(Scene())
    found: dict[str, dict[str, Floats]] = {"one camera": {}, "four cameras": {}, "vertices": {}}
    notes = []
    for name, effect in EFFECTS.items():
        begin = time.process_time()
        more, less = (stage(Scene().changed(effect.field, sign * effect.size)) for sign in (1, -1))
        up, down = more.masks - plain.masks, plain.masks - less.masks
        masks = (more.masks - less.masks) / 2
        found["one camera"][name] = masks[0].ravel()
        found["four cameras"][name] = masks.ravel()
        moved = (more.vertices - less.vertices) / 2
        found["vertices"][name] = moved.ravel()
        notes.append(
            {
                "effect": name,
                "vertices_mm": 1e3 * float(np.sqrt(np.square(moved).sum(-1).mean())),
                "pixels_one_camera": float(np.abs(masks[0]).sum((-2, -1)).mean()),
                "linearity_one_camera": cosine(up[0].ravel(), down[0].ravel()),
                "converged": min(more.converged, less.converged),
            }
        )
        report(f"{name}: {time.process_time() - begin:.0f} s of the processor")
    return found, pd.DataFrame(notes)


def cosine(first: Floats, second: Floats) -> float:
    """Of two answers; 0 where one of them is none."""
    length = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(first @ second) / length if length else 0.0


def own_share(found: dict[str, Floats], name: str) -> float:
    """Length of what is left of an answer when the others have explained what they can, of its length."""
    answer = found[name]
    length = float(np.linalg.norm(answer))
    if not length:
        return 0.0
    others = np.stack([v / max(float(np.linalg.norm(v)), 1e-30) for k, v in found.items() if k != name], 1)
    left = answer - others @ np.linalg.lstsq(others, answer, rcond=None)[0]
    return float(np.linalg.norm(left)) / length


def together(parts: Sequence[dict[str, dict[str, Floats]]]) -> dict[str, dict[str, Floats]]:
    """The answers of several motions as one, the effects the same in all."""
    return {
        kind: {name: np.concatenate([part[kind][name] for part in parts]) for name in EFFECTS}
        for kind in parts[0]
    }


def tables(found: dict[str, dict[str, Floats]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Cosines of all pairs, and own shares of all effects, by what is observed."""
    names = list(EFFECTS)
    pairs = [
        {"effect": a, "other": b, **{kind: cosine(found[kind][a], found[kind][b]) for kind in found}}
        for i, a in enumerate(names)
        for b in names[i + 1 :]
    ]
    shares = [{"effect": name, **{kind: own_share(found[kind], name) for kind in found}} for name in names]
    return pd.DataFrame(pairs), pd.DataFrame(shares)


def main() -> None:
    """Roll out, compare, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=14, help="of each motion, six or more")
    parser.add_argument("--output", type=Path, default=Path("docs/results/capture_aliases"))
    given = parser.parse_args()
    if given.frames < 6:
        parser.error(f"--frames: expected 6 or more, got {given.frames}")
    found, notes = [], []
    for motion in MOTIONS:

        def say(line: str, motion: str = motion) -> None:
            print(f"{motion}, {line}", flush=True)

        part, note = answers(Stage(motion, given.frames), say)
        found.append(part)
        notes.append(note.assign(motion=motion))
        # What is there so far: the next motion may take a while.
        pairs, shares = tables(together(found))
        given.output.parent.mkdir(parents=True, exist_ok=True)
        csv = given.output.with_suffix(".csv")
        write_text(csv, pairs.to_csv(index=False, float_format="%.4f"))
        text = page(pairs, shares, pd.concat(notes), given.frames)
        write_text(given.output.with_suffix(".md"), text)
        print(csv, flush=True)


def page(pairs: pd.DataFrame, shares: pd.DataFrame, notes: pd.DataFrame, frames: int) -> str:
    """The tables as Markdown."""
    worst = (
        pairs.assign(size=pairs["one camera"].abs()).sort_values("size", ascending=False).drop(columns="size")
    )
    sizes = "; ".join(f"`{name}` {effect.unit}" for name, effect in EFFECTS.items())
    lines = [
        "# What one camera can tell apart in a garment",
        "",
        f"`make capture-aliases`: a skirt of {VERTICES} vertices on the default person, "
        f"{' and '.join(notes.motion.unique())} of {frames} frames, {SUBSTEPS} sub-steps, seed {SEED}, "
        f"{CAMERAS} cameras of {SIDE} px; central differences. Sizes: {sizes}. "
        "Deterministic: there is no spread over seeds.",
        "",
        "## Cosines of the answers",
        "",
        "Near 1 or -1: the two cannot be told apart by what is observed (masks of person and garment in one "
        "camera or in four, or the garment's vertices). The bias of masks does not move vertices.",
        "",
        worst.to_markdown(index=False, floatfmt=".2f"),
        "",
        "## What is left of an effect's answer",
        "",
        "when the six others have explained what they can, as a share of its length. 0: it cannot be told "
        "from a mixture of the others; 1: nothing is like it.",
        "",
        shares.to_markdown(index=False, floatfmt=".2f"),
        "",
        "## The answers themselves",
        "",
        "Root mean square of how far vertices move [mm]; area of the masks that changes [px], mean over "
        "masks and frames of the first camera; cosine of the answers to more and to less of it, which is 1 "
        "where the answer is linear; share of the layer's steps that converged.",
        "",
        notes[["motion", *(c for c in notes if c != "motion")]].to_markdown(index=False, floatfmt=".3g"),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
