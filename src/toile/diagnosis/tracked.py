"""What the images say about the motion: positions tracked with free forces, and how sure the images are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy import sparse

from toile.diagnosis.image_information import Information, as_array
from toile.diagnosis.model_grid import ModelGrid
from toile.limits import Count, NonNegative, Positive, Unit
from toile.reconstruction.gauss_newton.recipe import (
    SlidingWindows,
    TrackingRecipe,
    TrackingStage,
    Windows,
)
from toile.reconstruction.image_terms.texture_points import PointTermSettings, TexturePointTerm, visible
from toile.reconstruction.lost_cloth import LEAST, first_lost, outline_overlap
from toile.reconstruction.problem import Reconstruction

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@dataclass(frozen=True)
class Tracked:
    """A quadratic around the tracked motion that stands for the image term; N vertices of the model's grid.

    Attributes:
        positions: (F, N, 3) [m].
        information: F Gauss-Newton matrices of the image term (3N, 3N) [1/m²], in units of its noise.
        gradient: of the image term at ``positions`` (F, N, 3) [1/m], in the same units.
        fine_positions: on the scene's grid (F, N_scene, 3) [m].
    """

    positions: Array
    information: Sequence[Information]
    gradient: Array
    fine_positions: Array

    def cost(self, frame: int, x: Array) -> float:
        """Cost of positions x (N, 3) in a frame."""
        away = (x - self.positions[frame]).reshape(-1)
        return float(0.5 * away @ (self.information[frame] @ away) + self.gradient[frame].reshape(-1) @ away)

    def slope(self, frame: int, x: Array) -> Array:
        """Gradient (3N,) of it."""
        away = (x - self.positions[frame]).reshape(-1)
        return np.asarray(self.information[frame] @ away + self.gradient[frame].reshape(-1))

    @cached_property
    def mean_information(self) -> Single:
        """Of all frames (3N, 3N) [1/m²]; softened ones have to be inverted for it, so it is kept."""
        return np.asarray(sum(as_array(one) for one in self.information) / len(self.information), np.float32)

    def distances(self, frames: slice, x: Array) -> Array:
        """Root mean square distance (n,) [m] of positions (n, N, 3) to the tracked ones."""
        away = x - self.positions[frames]
        return np.sqrt((away**2).sum(-1).mean(-1))


@dataclass(frozen=True)
class CoarseTracking:
    """A first pass over blurred images: it finds fast motion and repeated prints that the fine one loses.

    Attributes:
        blur: σ of the pre-blur [px].
        per_side: points along each side of the cloth.
        cg_iterations: per window.
        fine_stride: frames by which the fine pass advances, whose start is close already.
        mask_factors: by how much the silhouette weighs more than in the recipe. They are tried in turn, as
            long as the fine pass loses the cloth.
    """

    blur: Annotated[NonNegative, Unit("px")] = 10.0
    per_side: Count = 32
    cg_iterations: Count = 15
    fine_stride: Annotated[Count, Unit("frames")] = 2
    mask_factors: Annotated[tuple[Positive, ...], Field(min_length=1)] = (1.0, 10.0)


class StopAt(Windows):
    """Windows of which one ends at a given frame, so that frames up to it know nothing of later ones.

    Args:
        windows: any, in the order of their ends.
        frame: at which one ends.
    """

    def __init__(self, windows: Windows, frame: int) -> None:
        self.windows = windows
        self.frame = frame

    def plan(self, n_frames: int) -> list[tuple[int, int]]:
        """See Windows."""
        plan: list[tuple[int, int]] = []
        for first, last in self.windows.plan(n_frames):
            if last > self.frame and (not plan or plan[-1][1] < self.frame):
                # As long as the window that goes past it.
                plan.append((max(0, first - last + self.frame), self.frame))
            plan.append((first, last))
        return plan


def track(
    reconstruction: Reconstruction,
    recipe: TrackingRecipe,
    coarse: CoarseTracking | None,
    used: int,
    report: Callable[[int, float], None],
    least_overlap: float = LEAST,
) -> Array:
    """Track the motion; where the cloth is lost, once more with a heavier silhouette in the first pass.

    A cloth that folds over where the image shows it flat hides its points, and points say nothing about what
    they leave uncovered. The outline tells (outline_overlap); the try that keeps the cloth longest counts.

    Args:
        reconstruction: changed in place.
        recipe: see track_once.
        coarse: see track_once.
        used: see track_once.
        report: see track_once.
        least_overlap: of an outline that is not lost, see first_lost.
    """
    start = {name: value.clone() for name, value in reconstruction.parameters.state_dict().items()}
    best: Array | None = None
    longest = -1
    for factor in (1.0,) if coarse is None else coarse.mask_factors:
        reconstruction.parameters.load_state_dict(start)
        positions = track_once(reconstruction, recipe, coarse, used, report, factor)
        kept = min(first_lost(outline_overlap(reconstruction, positions), least_overlap), used)
        if kept > longest:
            best, longest = positions, kept
        if kept == used:
            break
    assert best is not None
    return best


def track_once(
    reconstruction: Reconstruction,
    recipe: TrackingRecipe,
    coarse: CoarseTracking | None,
    used: int,
    report: Callable[[int, float], None],
    mask_factor: float,
) -> Array:
    """Track the motion on blurred images, then by the recipe's last stage; frame positions (F, N, 3) [m].

    The first ``used`` frames stay as they were when neither pass had seen any others.

    Args:
        reconstruction: changed in place.
        recipe: with free forces; stiffness is the diagnosis' own business.
        coarse: see CoarseTracking; None for the second pass alone.
        used: frames.
        report: called with the frames covered and the share that is done.
        mask_factor: of the silhouette's weight in the first pass.
    """
    last = recipe.stages[-1]
    fine = replace(last, windows=StopAt(last.windows, used - 1))
    first: TrackingStage | None = None
    if coarse is not None:
        term = point_settings(recipe)
        term = replace(
            term, blur=coarse.blur, per_side=coarse.per_side, mask_weight=mask_factor * term.mask_weight
        )
        first = replace(fine, term=term, cg_iterations=coarse.cg_iterations)
        if isinstance(last.windows, SlidingWindows):
            skipping = SlidingWindows(last.windows.lag, coarse.fine_stride, last.windows.repeats)
            fine = replace(fine, windows=StopAt(skipping, used - 1))
    tracking = TrackingRecipe({"coarse": first, "fine": fine})
    tracking.start(reconstruction)
    n = tracking.n_cycles(reconstruction)
    n_coarse = TrackingRecipe({"coarse": first}).n_cycles(reconstruction)
    p, frame_steps = reconstruction.parameters, reconstruction.frame_steps
    forces, boundary = p.turbulence.detach().clone(), p.boundary_motion.detach().clone()
    early = positions = reconstruction.template.numpy()[None]
    for index in range(n):
        covered = tracking.cycle(reconstruction, index).n_frames
        motion = tracking.substep_positions()
        assert motion is not None
        positions = frame_steps.at_frames(motion[0]).numpy().copy()
        if covered <= used and index < n_coarse:
            forces, boundary = p.turbulence.detach().clone(), p.boundary_motion.detach().clone()
        elif covered <= used:
            early = positions[:covered]
        if index == n_coarse - 1:
            with torch.no_grad():
                p.turbulence[: used - 1] = forces[: used - 1]
                p.boundary_motion[:used] = boundary[:used]
        report(covered, (index + 1) / n)
    positions[: len(early)] = early
    return positions


def tracked_motion(
    reconstruction: Reconstruction, positions: Array, grid: ModelGrid, term: TexturePointTerm
) -> Tracked:
    """The image term around tracked positions (F, N_scene, 3), on the model's grid.

    The noise of the features is what is left of them at the tracked positions.
    """
    settings, points = term.settings, term.points
    seen = visible(reconstruction, points, positions)
    value = term.evaluate(positions, 0, seen, derivatives=True)
    # ½ Σ w |r|² / δ² over three channels is the number of points times 3/2 σ² / δ².
    weight = settings.colour_weight / term.n_points
    variance = 2 * value.colour[1:] / (3 * weight * np.maximum(seen.sum(1)[1:], 1))
    scale = 1 / max(float(np.median(variance)), 1e-6)
    P, N = term.n_points, positions.shape[1]
    rows = np.repeat(np.arange(P), 4)
    at_points = sparse.coo_matrix((points.weights.reshape(-1), (rows, points.vertices.reshape(-1))), (P, N))
    at_points = at_points.tocsr().astype(np.float32)
    prolong = grid.prolong.astype(np.float32)
    # As many vertices on lines elsewhere are another grid.
    same = prolong.shape[0] == prolong.shape[1] and bool(
        np.allclose(prolong, np.eye(len(prolong)), atol=1e-6)
    )
    model = np.einsum("cn,fnd->fcd", grid.restrict, positions)
    n = prolong.shape[1]
    information: list[Information] = []
    gradient = np.empty_like(model)
    for f in range(len(positions)):
        # Where the coarse motion cannot follow the fine one, the term has its slope.
        off = (grid.prolong @ model[f] - positions[f]).astype(np.float32)
        fine = value.gradient[f].copy()
        dense = np.zeros((0 if same else n, 3, n, 3), np.float32)
        whole: sparse.csr_matrix | None = None
        for c in range(3):
            for d in range(c, 3):
                weights = sparse.diags(scale * value.matrices[f, :, c, d].astype(np.float32))
                block = (at_points.T @ weights @ at_points).tocsr()
                if same:
                    # Components of a vertex lie side by side.
                    placed = sparse.kron(block, _component(c, d), "csr")
                    placed = placed if c == d else placed + sparse.kron(block.T, _component(d, c), "csr")
                    whole = placed if whole is None else whole + placed
                else:
                    coarse = prolong.T @ (block @ prolong)
                    dense[:, c, :, d] = coarse
                    dense[:, d, :, c] = coarse.T
                fine[:, c] += block @ off[:, d] / scale
                if c != d:
                    fine[:, d] += block.T @ off[:, c] / scale
        # Processes that share work have it once.
        dense.flags.writeable = False
        information.append(dense.reshape(3 * n, 3 * n) if whole is None else whole)
        gradient[f] = grid.prolong.T @ fine
    return Tracked(model, information, scale * gradient, positions)


def _component(row: int, column: int) -> Single:
    """One at (row, column), (3, 3)."""
    out = np.zeros((3, 3), np.float32)
    out[row, column] = 1
    return out


def point_settings(recipe: TrackingRecipe) -> PointTermSettings:
    """Image term of the last stage."""
    settings = recipe.stages[-1].term
    assert isinstance(settings, PointTermSettings)
    return settings
