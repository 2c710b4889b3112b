"""Where on the cloth an effect acts, by its own fit.

What the base model is wrong by is largest where the cloth moves otherwise for it, which of a heavy patch, a
fold or a corner that slips is not where the cause is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from toile.diagnosis.joint_fit import JointFit, frame_positions
from toile.diagnosis.session_stages import SessionModel
from toile.effects.base import Effect

Array = NDArray[np.float64]


def effect_map(model: SessionModel, base: JointFit, acting: Sequence[Effect | None]) -> Array | None:
    """How strongly an effect acts on every vertex of the scene's grid (H, W), 1 where most, over its clips.

    Args:
        model: see SessionModel.
        base: the base model, fitted.
        acting: the effect as it acts in every clip; None for a clip in which it does not.

    Returns:
        None for an effect that acts everywhere alike, or nowhere.
    """
    maps = []
    clips = zip(model.fitting.clips, model.clips, model.grids, base.windows, acting, strict=True)
    for clip, seen, grid, windows, effect in clips:
        if effect is None:
            continue
        motion = torch.from_numpy(frame_positions(clip.shooting, windows))
        found = effect.acts_on(clip.around, motion)
        if found is None:
            return None
        maps.append((grid.prolong @ found.detach().numpy()).clip(min=0).reshape(seen.problem.scene.grid))
    mean = np.mean(maps, axis=0)
    most = float(mean.max())
    return mean / most if most > 0 else None
