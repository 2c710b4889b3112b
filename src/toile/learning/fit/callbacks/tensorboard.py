"""TensorBoard: pictures and the mesh now and then."""

from __future__ import annotations

from typing import Annotated, Any, final

import matplotlib as mpl
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from scipy.spatial import cKDTree
from torch import Tensor

from toile.evaluation.target_points import known_frames, target_points
from toile.evaluation.vertices import vertex_distances
from toile.learning.fit.module import FitModule
from toile.limits import Count, Positive, Unit
from toile.reconstruction.problem import Reconstruction
from toile.scenes.scene import GroundTruth

PICTURES = "observed, rendered, difference, silhouettes (grey both, orange observed, blue rendered)"
"""Heading of the pictures; what stands before the slash of a tag is a heading in TensorBoard."""
TRUTH = "ground truth"
MESH = "mesh"
_OBSERVED_ONLY, _RENDERED_ONLY, _BOTH = (0.85, 0.45, 0.05), (0.06, 0.38, 0.67), (0.8, 0.8, 0.8)
# TensorBoard shows y up and looks along -z.
_TO_TENSORBOARD = torch.tensor([1.0, -1.0, -1.0])
_MAX_POINTS = 4000  # of a cloud, in the browser


@final
class PictureLogger(Callback):
    """Draws pictures and the mesh into TensorBoard, beside the ground truth where there is any.

    Args:
        every: cycles between two drawings; the last cycle is always drawn.
        frames: number of frames to draw, evenly spread over the video; those not yet covered are left out.
        error_scale: distance to the ground truth [mm] at the bright end of the mesh's colours.
    """

    def __init__(self, every: Count, frames: Count, error_scale: Annotated[Positive, Unit("mm")]) -> None:
        self.every = every
        self.frames = frames
        self.error_scale = error_scale
        self._with_truth: set[int] = set()

    @property
    def coloured_mesh(self) -> str:
        """Heading of meshes that are coloured by their distance to the ground truth."""
        return f"{MESH}, distance to the ground truth from 0 (dark) to {self.error_scale:g} mm (bright)"

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Draw if it is time."""
        assert isinstance(pl_module, FitModule)
        done, report = pl_module.cycles_done, pl_module.report
        writers = [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        if not writers or report is None or not (done % self.every == 0 or done == pl_module.n_cycles):
            return
        r = pl_module.reconstruction
        for f in spread_frames(r.scene.n_frames, self.frames):
            if f >= report.n_frames or not bool(report.positions[f].isfinite().all()):
                continue
            positions, truth = report.positions[f].detach(), r.scene.ground_truth
            picture = _picture(r, positions, f)
            points, error = _truth_of(truth, f, positions)
            for writer in writers:
                writer.add_image(f"{PICTURES}/frame {f:03d}", picture, done - 1, dataformats="HWC")
                writer.add_mesh(
                    f"{MESH if error is None else self.coloured_mesh}/frame {f:03d}",
                    _shown(positions),
                    colors=None if error is None else _colours(error / self.error_scale),
                    faces=r.faces[None],
                    global_step=done - 1,
                )
                if points is not None and f not in self._with_truth:
                    writer.add_mesh(f"{TRUTH}/frame {f:03d}", _shown(points), global_step=done - 1)
            self._with_truth.add(f)


def spread_frames(total: int, n: int) -> list[int]:
    """At most n frames, evenly spread to the last; frame 0 is the template, the same in every fit."""
    return torch.linspace(0, total - 1, min(n, total - 1) + 1).round().int().tolist()[1:]


@torch.no_grad()
def _picture(r: Reconstruction, positions: Tensor, frame: int) -> Tensor:
    """Observed, rendered, their absolute difference, and the silhouettes, side by side: (h, 4 w, 3)."""
    uv = r.texture_coordinates + r.parameters.texture_offset
    images = r.renderer.render(positions[None], r.faces, uv, r.scene.texture, r.scene.camera)
    rendered, mask = images.rgb[0], r.scene.masks[frame]
    observed = r.scene.frames[frame] * mask[..., None]
    both = silhouettes(mask, images.silhouette[0])
    return torch.cat((observed, rendered, (rendered - observed).abs(), both), 1).clamp(0, 1)


def silhouettes(mask: Tensor, silhouette: Tensor) -> Tensor:
    """Observed mask and rendered silhouette, (h, w) each, in one picture (h, w, 3) on white."""
    m, s = mask[..., None].float(), silhouette[..., None].float()
    observed, rendered, both = (torch.tensor(c) for c in (_OBSERVED_ONLY, _RENDERED_ONLY, _BOTH))
    return (1 - m) * (1 - s) + m * (1 - s) * observed + (1 - m) * s * rendered + m * s * both


def _truth_of(
    truth: GroundTruth | None, frame: int, positions: Tensor
) -> tuple[Tensor | None, Tensor | None]:
    """Ground-truth points (n, 3) [m] of a frame, and every vertex' distance to the truth (N,) [mm].

    The distance is to the same vertex where that is known, else to the nearest point.
    """
    if truth is None or frame >= known_frames(truth):
        return None, None
    clouds, _ = target_points(truth, [frame], seed=0)
    assert clouds is not None
    points = clouds[0].double()
    if truth.vertices is not None and truth.vertices[frame].numel() == positions.numel():
        error = vertex_distances(positions, truth.vertices[frame].reshape(-1, 3))
    else:
        error = torch.from_numpy(cKDTree(points.numpy()).query(positions.numpy())[0])
    return points[:: -(-len(points) // _MAX_POINTS)], 1e3 * error


def _shown(points: Tensor) -> Tensor:
    return (points.float() * _TO_TENSORBOARD)[None]


def _colours(share: Tensor) -> Tensor:
    """Colours (1, N, 3), 0 to 255, of numbers (N,) of which 0 is dark and 1 is bright."""
    return torch.from_numpy(mpl.colormaps["viridis"](share.numpy(), bytes=True)[None, :, :3].copy())
