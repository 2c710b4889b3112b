"""All metrics that the ground truth of a scene allows, in one frozen, serialisable result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import Tensor

from toile.errors import InputError
from toile.evaluation.chamfer import (
    CHAMFER_L1_PROTOCOL,
    CHAMFER_PROTOCOL,
    CHAMFER_SCALE,
    nearest_distances,
    sample_like,
)
from toile.evaluation.depth import (
    DEPTH_COVERAGE_PROTOCOL,
    DEPTH_MAP_COVERAGE_PROTOCOL,
    DEPTH_MAP_PROTOCOL,
    DEPTH_PROTOCOL,
    DepthError,
    depth_error,
    depth_map_error,
)
from toile.evaluation.normals import (
    CLOUD_NORMAL_PROTOCOL,
    VERTEX_NORMAL_PROTOCOL,
    cloud_normal_error,
    vertex_normal_error,
)
from toile.evaluation.out_of_balance import OUT_OF_BALANCE_PROTOCOL, OutOfBalanceForce
from toile.evaluation.point_to_surface import POINT_TO_SURFACE_PROTOCOL, point_to_surface
from toile.evaluation.silhouette import SILHOUETTE_PROTOCOL, intersection_over_union
from toile.evaluation.target_points import target_points
from toile.evaluation.vertices import VERTEX_PERCENT_PROTOCOL, VERTEX_PROTOCOL, vertex_error
from toile.geometry.mesh import grid_faces
from toile.rendering.base import RenderedImages, Renderer
from toile.scenes.scene import Scene, require_one_camera

NORMAL_SAMPLES = 2_000
NORMAL_NEIGHBOURS = 50
METRES_TO_MILLIMETRES = 1e3


@dataclass(frozen=True)
class Metric:
    """One number per frame, with everything needed to read it.

    Attributes:
        key: short name, e.g. "chamfer".
        title: what a table or an axis calls it.
        unit: unit of the values, "" where there is none.
        protocol: how exactly it was measured; printed beside the number.
        per_frame: values (F,) in ``unit``; NaN where a frame has no value.
        higher_is_better: direction, for tables and plots.
    """

    key: str
    title: str
    unit: str
    protocol: str
    per_frame: npt.NDArray[np.float64]
    higher_is_better: bool = False

    @property
    def mean(self) -> float:
        """Mean over the frames that have a value; NaN where none has."""
        values = self.per_frame[np.isfinite(self.per_frame)]
        return float(values.mean()) if values.size else math.nan

    @property
    def worst_frame(self) -> int | None:
        """Frame with the worst value, or None where no frame has one."""
        if not np.isfinite(self.per_frame).any():
            return None
        return int(np.nanargmin(self.per_frame) if self.higher_is_better else np.nanargmax(self.per_frame))


@dataclass(frozen=True)
class EvaluationResult:
    """Metrics of one trajectory against one scene.

    Attributes:
        scene: name of the scene.
        n_frames: frames that were evaluated.
        seed: seed of every sampling in the evaluation.
        metrics: metrics by key, in the order of the report.
        skipped: metrics that could not be computed, with the reason.
    """

    scene: str
    n_frames: int
    seed: int
    metrics: Mapping[str, Metric]
    skipped: Mapping[str, str] = field(default_factory=dict)

    def mean(self, key: str) -> float:
        """Mean of metric ``key`` in its unit."""
        return self.metrics[key].mean

    def per_frame_table(self) -> pd.DataFrame:
        """One row per frame and a last row "mean"; one column per metric, named "key [unit]"."""
        columns = {_column(m): m.per_frame for m in self.metrics.values()}
        table = pd.DataFrame(columns, index=[str(f) for f in range(self.n_frames)])
        table.loc["mean"] = [m.mean for m in self.metrics.values()]
        table.index.name = "frame"
        return table

    def summary_table(self) -> pd.DataFrame:
        """One row per metric: title, mean, unit, worst value, worst frame, protocol."""
        rows = []
        for m in self.metrics.values():
            worst = m.worst_frame
            value = math.nan if worst is None else float(m.per_frame[worst])
            rows.append((m.key, m.title, m.mean, m.unit, value, worst, m.protocol))
        columns = ["metric", "title", "mean", "unit", "worst", "worst frame", "protocol"]
        return pd.DataFrame(rows, columns=columns).set_index("metric")

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary for JSON; NaN becomes None."""
        return {
            "scene": self.scene,
            "n_frames": self.n_frames,
            "seed": self.seed,
            "metrics": {
                m.key: {
                    "title": m.title,
                    "unit": m.unit,
                    "protocol": m.protocol,
                    "higher_is_better": m.higher_is_better,
                    "mean": None if math.isnan(m.mean) else m.mean,
                    "per_frame": [None if math.isnan(v) else float(v) for v in m.per_frame],
                }
                for m in self.metrics.values()
            },
            "skipped": dict(self.skipped),
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> EvaluationResult:
        """Inverse of ``to_dict``.

        Raises:
            InputError: an entry is missing or has the wrong type.
        """
        try:
            metrics = {
                key: Metric(
                    key=key,
                    title=str(m["title"]),
                    unit=str(m["unit"]),
                    protocol=str(m["protocol"]),
                    per_frame=np.array([math.nan if v is None else float(v) for v in m["per_frame"]]),
                    higher_is_better=bool(m["higher_is_better"]),
                )
                for key, m in data["metrics"].items()
            }
            return EvaluationResult(
                scene=str(data["scene"]),
                n_frames=int(data["n_frames"]),
                seed=int(data["seed"]),
                metrics=metrics,
                skipped=dict(data["skipped"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                "Unreadable evaluation result",
                where="metrics",
                expected="the dictionary written by EvaluationResult.to_dict",
                got=f"{type(error).__name__}: {error}",
            ) from error


def evaluate(
    trajectory: Tensor,
    scene: Scene,
    renderer: Renderer | None = None,
    *,
    seed: int = 0,
    n_frames: int | None = None,
    out_of_balance: OutOfBalanceForce | None = None,
) -> EvaluationResult:
    """Measure a reconstructed trajectory with every metric that the ground truth of the scene allows.

    Args:
        trajectory: reconstructed positions (F, H, W, 3) [m], camera frame, one per frame of the scene.
        scene: the scene, with whatever ground truth it has.
        renderer: renderer for silhouette and depth, or None to leave these out.
        seed: seed of the sampling; frame f samples with ``seed + f``.
        n_frames: evaluate only the first frames; the trajectory may then be shorter than the scene.
        out_of_balance: result of ``out_of_balance_force`` to report with the rest, or None.

    Raises:
        InputError: the trajectory does not fit the scene or is not finite, or several cameras saw it.
    """
    n = _check(trajectory, require_one_camera(scene), n_frames)
    x = trajectory[:n].detach().cpu().double()
    vertices, faces = x.reshape(n, -1, 3), grid_faces(*scene.grid)
    suffix = "" if n == scene.n_frames else f"; first {n} of {scene.n_frames} frames only"
    metrics: dict[str, Metric] = {}
    skipped: dict[str, str] = {}

    def add(
        key: str, title: str, unit: str, protocol: str, values: npt.ArrayLike, higher_is_better: bool = False
    ) -> None:
        per_frame = np.asarray(values, dtype=np.float64)
        metrics[key] = Metric(key, title, unit, protocol + suffix, per_frame, higher_is_better)

    truth = scene.ground_truth
    true_vertices = None
    if truth is not None and truth.vertices is not None:
        true_vertices = truth.vertices[:n].detach().cpu().double()
    clouds, cloud_note = target_points(truth, range(n), seed)

    if clouds is None:
        for key in ("chamfer", "chamfer_l1", "point_to_surface"):
            skipped[key] = "the scene has no ground truth"
    else:
        distances = [
            nearest_distances(sample_like(v, faces, c, seed + f), c)
            for f, (v, c) in enumerate(zip(vertices, clouds, strict=True))
        ]
        squared = [CHAMFER_SCALE * d.squared_chamfer for d in distances]
        l1 = [METRES_TO_MILLIMETRES * d.l1_chamfer for d in distances]
        to_surface = [
            METRES_TO_MILLIMETRES * point_to_surface(c, v, faces)
            for v, c in zip(vertices, clouds, strict=True)
        ]
        add("chamfer", "Squared Chamfer distance", "×10⁻⁴ m²", CHAMFER_PROTOCOL + cloud_note, squared)
        add("chamfer_l1", "L1 Chamfer distance", "mm", CHAMFER_L1_PROTOCOL + cloud_note, l1)
        add("point_to_surface", "Point to surface", "mm", POINT_TO_SURFACE_PROTOCOL + cloud_note, to_surface)

    if true_vertices is None:
        skipped["vertex_error"] = "the scene has no true vertices"
    else:
        error = vertex_error(x, true_vertices).numpy()
        add("vertex_error", "Vertex error", "mm", VERTEX_PROTOCOL, METRES_TO_MILLIMETRES * error)
        percent = 100.0 * error / scene.cloth_size[0]
        add("vertex_error_percent", "Vertex error / cloth width", "%", VERTEX_PERCENT_PROTOCOL, percent)

    if true_vertices is not None:
        angle = vertex_normal_error(vertices, true_vertices.reshape(n, -1, 3), faces).mean(1).numpy()
        add("normal_error", "Normal error", "deg", VERTEX_NORMAL_PROTOCOL, angle)
    elif clouds is not None:
        angles = [
            cloud_normal_error(
                v, faces, c, seed=seed + f, samples=NORMAL_SAMPLES, neighbours=NORMAL_NEIGHBOURS
            )
            for f, (v, c) in enumerate(zip(vertices, clouds, strict=True))
        ]
        protocol = CLOUD_NORMAL_PROTOCOL.format(samples=NORMAL_SAMPLES, neighbours=NORMAL_NEIGHBOURS)
        add("normal_error", "Normal error", "deg", protocol, angles)
    else:
        skipped["normal_error"] = "the scene has no ground truth"

    if renderer is None:
        for key in ("depth_error", "silhouette_iou"):
            skipped[key] = "no renderer was given"
    else:
        iou, depth = _rendered_metrics(vertices, faces, scene, renderer, true_vertices, clouds)
        if depth is None:
            skipped["depth_error"] = "the scene has no ground truth"
        else:
            # Where true vertices exist both surfaces are rendered; samples of hidden layers would spoil
            # the mean.
            by_map = true_vertices is not None
            protocol = DEPTH_MAP_PROTOCOL if by_map else DEPTH_PROTOCOL
            share = DEPTH_MAP_COVERAGE_PROTOCOL if by_map else DEPTH_COVERAGE_PROTOCOL
            add("depth_error", "Depth error", "mm", protocol, [METRES_TO_MILLIMETRES * d.mean for d in depth])
            add("depth_coverage", "Depth coverage", "%", share, [100.0 * d.coverage for d in depth], True)
        add("silhouette_iou", "Silhouette IoU", "", SILHOUETTE_PROTOCOL, iou, True)

    if out_of_balance is None:
        skipped["out_of_balance"] = "no forces were given"
    else:
        values = out_of_balance.per_frame
        if len(values) != n:
            raise InputError(
                "The out-of-balance force belongs to another trajectory",
                where="out_of_balance.per_frame",
                expected=f"{n} frames",
                got=f"{len(values)} frames",
            )
        add("out_of_balance", "Out-of-balance force / weight", "", OUT_OF_BALANCE_PROTOCOL, values)

    return EvaluationResult(scene=scene.name, n_frames=n, seed=seed, metrics=metrics, skipped=skipped)


def _check(trajectory: Tensor, scene: Scene, n_frames: int | None) -> int:
    """Validate the trajectory against the scene; returns the number of frames to evaluate."""
    H, W = scene.grid
    n = scene.n_frames if n_frames is None else n_frames
    enough = trajectory.ndim == 4 and (
        trajectory.shape[0] == n if n_frames is None else trajectory.shape[0] >= n
    )
    if not 1 <= n <= scene.n_frames or not enough or tuple(trajectory.shape[1:]) != (H, W, 3):
        raise InputError(
            "The trajectory does not fit the scene",
            where=f"evaluation of scene {scene.name}",
            expected=f"positions of shape ({n}, {H}, {W}, 3) in metres, at most {scene.n_frames} frames",
            got=str(tuple(trajectory.shape)),
        )
    if not bool(torch.isfinite(trajectory).all()):
        raise InputError(
            "The trajectory is not finite",
            where=f"evaluation of scene {scene.name}",
            expected="finite positions in metres",
            got=f"{int((~torch.isfinite(trajectory)).sum())} numbers that are NaN or infinite",
        )
    truth = scene.ground_truth
    if truth is not None:
        lengths = [len(t) for t in (truth.vertices, truth.point_clouds) if t is not None]
        if any(length < n for length in lengths):
            raise InputError(
                "The ground truth has too few frames",
                where=f"ground truth of scene {scene.name}",
                expected=f"at least {n} frames",
                got=f"{min(lengths)} frames",
            )
    return n


def _rendered_metrics(
    vertices: Tensor,
    faces: Tensor,
    scene: Scene,
    renderer: Renderer,
    true_vertices: Tensor | None,
    clouds: tuple[Tensor, ...] | None,
) -> tuple[list[float], list[DepthError] | None]:
    """Silhouette IoU and depth error per frame, one frame in memory at a time."""
    uv = scene.texture_coordinates.reshape(-1, 2).float()
    iou: list[float] = []
    depth: list[DepthError] | None = None if clouds is None else []

    def draw(frame_vertices: Tensor) -> RenderedImages:
        with torch.no_grad():
            return renderer.render(frame_vertices[None].float(), faces, uv, scene.texture, scene.camera)

    for f, v in enumerate(vertices):
        images = draw(v)
        iou.append(float(intersection_over_union(images.silhouette[0], scene.masks[f])))
        if depth is None or clouds is None:
            continue
        if true_vertices is not None:
            true = draw(true_vertices[f].reshape(-1, 3))
            depth.append(
                depth_map_error(images.depth[0], images.silhouette[0], true.depth[0], true.silhouette[0])
            )
        else:
            depth.append(depth_error(clouds[f], images.depth[0], images.silhouette[0], scene.camera))
    return iou, depth


def _column(metric: Metric) -> str:
    return f"{metric.key} [{metric.unit}]" if metric.unit else metric.key
