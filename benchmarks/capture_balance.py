"""Why a network's garment is out of balance, and what a graph can do about it: `make capture-balance`.

Measured on a clip of the training set with the package's networks (``make capture-data`` makes it):

1. The truth itself, carried along by the model's coarser mesh, and what the networks state.
2. What the simulation layer makes of the networks' windows and of the true garment: how far it moves, and how
   much nearer to the truth that is.
3. A simulated motion on the networks' bodies, which is in balance; the same smoothed over five frames; and
   as embedded graphs can follow it, by least squares in metres.

    python benchmarks/capture_balance.py [--data outputs/capture/demo/train] [--weights ...] [--output ...]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from toile.atomic_file import write_text
from toile.capture.data.clips import TRUTH_FILE, Truth
from toile.capture.data.making import clips_of
from toile.capture.deformation.graph import embedded_deformation, embedded_graph
from toile.capture.garments import Garment
from toile.capture.layer.layer import SimulationLayer
from toile.capture.losses.simulation import LayerFrameStep, simulated_window
from toile.capture.metrics.out_of_balance import balance_with_contact
from toile.capture.metrics.reconstruction import HIPS
from toile.capture.test_time.resolution import CollisionResolution
from toile.capture.test_time.smoothing import SmoothingSettings, smoothed_values
from toile.capture.training.frames import Sample, TrainingSet
from toile.capture.training.weights import load_networks
from toile.learning.capture.physics_stage import PhysicsSettings, PhysicsStage

FRAMES = slice(8, 24)
WINDOW = 3
NODES = (32, 96, 200)
ITERATIONS = 300


class Scene:
    """Frames of a clip, what the networks say of them, and the truth where they put the person.

    Args:
        folder: of the data set.
        weights: of the networks, the package's if None.
    """

    def __init__(self, folder: Path, weights: Path | None) -> None:
        networks = load_networks(weights)
        data = TrainingSet.load(folder, networks.settings.backbone.side)
        stage = PhysicsStage(PhysicsSettings(), networks, data, 0)
        samples = [Sample(0, 0, f) for f in range(FRAMES.start, FRAMES.stop)]
        batch = data.batch(samples)
        with torch.no_grad():
            world, _, _ = stage.deformed(batch, batch.images)
        assert world.body is not None
        truth = Truth.load(clips_of(folder)[0] / TRUTH_FILE)
        self.data, self.layer = data, stage.layer
        self.garment: Garment = data.garment
        self.stated, self.bodies = world.garment.double(), world.body.double()
        found = [list(data.subject.landmark_names).index(name) for name in HIPS]
        true = torch.from_numpy(truth.landmarks[FRAMES])[:, found].mean(1)
        by = (world.landmarks.double()[:, found].mean(1) - true)[:, None]
        self.truth = torch.from_numpy(truth.extra["model_positions"].astype(np.float64))[FRAMES] + by
        self.true_bodies = torch.from_numpy(truth.body_positions)[FRAMES] + by
        self.rays = [data.rays(sample) for sample in samples]

    def balance(self, garment: Tensor, bodies: Tensor) -> tuple[float, float]:
        """Out-of-balance force [weights], average and largest."""
        subject = self.data.subject
        found = balance_with_contact(
            self.garment,
            self.layer.cloth,
            garment.numpy(),
            bodies.numpy(),
            subject.faces.numpy(),
            self.data.fps,
            inactive=subject.parts["arms"].numpy(),
        )
        return found.average_weights, found.maximum_weights

    def strain(self, garment: Tensor) -> float:
        """Root mean square strain of the edges."""
        faces = self.garment.faces
        edges = torch.cat((faces[:, :2], faces[:, 1:], faces[:, [2, 0]])).sort(1).values.unique(dim=0)

        def lengths(x: Tensor) -> Tensor:
            return (x[..., edges[:, 0], :] - x[..., edges[:, 1], :]).norm(dim=-1)

        off: Tensor = lengths(garment) / lengths(self.garment.rest_vertices) - 1
        return float(off.square().mean().sqrt())


def distance(x: Tensor, y: Tensor) -> float:
    """Root mean square [mm]."""
    return 1e3 * float((x - y).square().sum(-1).mean().sqrt())


def simulated_windows(scene: Scene) -> Iterator[dict[str, object]]:
    """What the layer makes of windows."""
    for name, positions, bodies, rays in (
        ("networks' windows", scene.stated, scene.bodies, False),
        ("networks' windows, with Eq. 1", scene.stated, scene.bodies, True),
        ("true garment and body", scene.truth, scene.true_bodies, False),
        ("true garment on the networks' body", scene.truth, scene.bodies, False),
    ):
        before, after, moved, strains = [], [], [], []
        for begin in range(0, len(positions) - WINDOW + 1, WINDOW - 1):
            frames = slice(begin, begin + WINDOW)
            step = LayerFrameStep(scene.layer, scene.data.fps, 1, scene.rays[frames] if rays else ())
            window = simulated_window(positions[frames], bodies[frames], step, 1 / scene.data.fps)
            there, truth = window.positions[window.counts], scene.truth[frames][window.counts]
            stated = positions[frames][window.counts]
            moved.append(distance(there, stated))
            before.append(distance(stated, truth))
            after.append(distance(there, truth))
            strains.append(scene.strain(there))
        yield {
            "starts from": name,
            "moves_mm": float(np.mean(moved)),
            "to_truth_before_mm": float(np.mean(before)),
            "to_truth_after_mm": float(np.mean(after)),
            "strain_after_percent": 100 * float(np.mean(strains)),
        }


def projected(garment: Garment, motion: Tensor, nodes: int) -> Tensor:
    """The nearest motion (F, N, 3) that a graph can make, each frame by least squares, after a rigid fit."""
    rest = garment.rest_vertices
    graph = embedded_graph(rest, garment.faces, nodes)
    middle, centre = motion.mean(1, keepdim=True), rest.mean(0)
    u, _, v = torch.linalg.svd((motion - middle).mT @ (rest - centre))
    keep = torch.eye(3, dtype=motion.dtype).repeat(len(motion), 1, 1)
    keep[:, 2, 2] = torch.linalg.det(u @ v)
    turn = u @ keep @ v
    target = (motion - middle) @ turn + centre
    A, T = (torch.zeros(len(motion), nodes, 3, dtype=motion.dtype, requires_grad=True) for _ in range(2))
    search = torch.optim.LBFGS(
        [A, T],
        max_iter=ITERATIONS,
        history_size=30,
        line_search_fn="strong_wolfe",
        tolerance_grad=1e-12,
        tolerance_change=1e-14,
    )

    def off() -> Tensor:
        search.zero_grad()
        loss = 1e4 * (embedded_deformation(graph, rest, A, T) - target).square().sum() / len(motion)
        loss.backward()
        return loss

    search.step(off)
    with torch.no_grad():
        return (embedded_deformation(graph, rest, A, T) - centre) @ turn.mT + middle


def balances(scene: Scene) -> Iterator[dict[str, object]]:
    """Forces of the truth, the networks, a motion in balance, and what graphs make of it."""

    def row(name: str, garment: Tensor, bodies: Tensor, of: Tensor | None = None) -> dict[str, object]:
        average, largest = scene.balance(garment, bodies)
        return {
            "motion": name,
            "off_mm": np.nan if of is None else distance(garment, of),
            "out_of_balance_avg": average,
            "out_of_balance_max": largest,
            "strain_percent": 100 * scene.strain(garment),
        }

    yield row("truth, on the model's mesh", scene.truth, scene.true_bodies)
    yield row("networks", scene.stated, scene.bodies)
    gentle = SmoothingSettings()
    bodies = smoothed_values(scene.bodies, gentle)
    resolution = CollisionResolution(scene.garment, scene.data.subject)
    start = resolution(smoothed_values(scene.stated, gentle)[:1].numpy(), bodies[:1].numpy()).positions[0]
    layer: SimulationLayer = scene.layer
    found = layer.simulate(bodies, scene.data.fps, 2, start=torch.from_numpy(start))
    motion, bodies = torch.from_numpy(found.garment_positions)[4:], bodies[4:]
    yield row("simulated on the networks' bodies", motion, bodies)
    yield row("the same, smoothed over five frames", smoothed_values(motion, gentle), bodies, motion)
    for nodes in (*NODES, len(scene.garment.rest_vertices)):
        made = projected(scene.garment, motion, nodes)
        yield row(f"the same, by a graph of {nodes} nodes", made, bodies, motion)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("outputs/capture/demo/train"))
    parser.add_argument("--weights", type=Path, help="of the networks; the package's if not given")
    parser.add_argument("--output", type=Path, default=Path("docs/results/capture_balance"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    scene = Scene(given.data, given.weights)
    forces, windows = pd.DataFrame(balances(scene)), pd.DataFrame(simulated_windows(scene))
    given.output.parent.mkdir(parents=True, exist_ok=True)
    write_text(given.output.with_suffix(".csv"), forces.to_csv(index=False, float_format="%.4g"))
    lines = [
        "# Why a network's garment is out of balance",
        "",
        f"`make capture-balance`: frames {FRAMES.start} to {FRAMES.stop - 1} of the first training clip of "
        "the demo, camera 0, the package's networks. One clip, nothing random: no spread. Forces in "
        "weights of a vertex.",
        "",
        forces.to_markdown(index=False, floatfmt=".3g").replace(" nan ", "   – "),
        "",
        f"What windows of {WINDOW} frames become in the layer (one step a frame), and how far they are from "
        "the truth, root mean squares:",
        "",
        windows.to_markdown(index=False, floatfmt=".3g"),
        "",
    ]
    write_text(given.output.with_suffix(".md"), "\n".join(lines))
    print(given.output.with_suffix(".md"))


if __name__ == "__main__":
    main()
