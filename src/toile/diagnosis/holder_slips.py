"""Slips of what holds the cloth, in the motion that the base model has refined.

Tracking has free forces, so that its pinned vertices go astray by centimetres where the images say little,
and jump. Under the laws of motion a cloth that swings shows where it hangs from: refined, they are a
millimetre or two off across the line of sight, from frame to frame anew, and do not jump. And where nobody
moved what holds the cloth, no hands sway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.attachment_slip import SlipFit, SlipSettings, slip_evidence
from toile.diagnosis.findings import Finding, finding
from toile.diagnosis.session_checks import stand_still
from toile.diagnosis.session_stages import SeenClip
from toile.effects.anchor_slip import AnchorSlip
from toile.effects.base import Effect
from toile.scenes.scene import Scene

Array = NDArray[np.float64]


def with_slips(
    clips: Sequence[SeenClip],
    motion: Sequence[Array],
    effects: Sequence[Effect],
    settings: SlipSettings,
    *,
    resized: bool = False,
) -> list[dict[str, Finding]]:
    """What the images of every clip say, and of slips what its refined motion says.

    Args:
        clips: see SeenClip.
        motion: of each, refined by the base model (F, N, 3) [m].
        effects: candidates; a slip may be among them.
        settings: of what pinned vertices do in a refined motion.
        resized: whether the cloth seems to become smaller or larger: its holders go with it in the motion,
            so that nothing is known of slips.
    """
    slips = [effect for effect in effects if isinstance(effect, AnchorSlip)]
    found = []
    for clip, positions in zip(clips, motion, strict=True):
        own: Mapping[str, Finding] = clip.seen.findings
        for effect in slips:
            if resized:
                fit = SlipFit.nothing_known()
            else:
                still = stand_still(clip, positions)
                fit = slip_of(clip.problem.scene, positions, effect, settings, held_still=still)
            one = finding(effect, fit.log_evidence, fit.mean, fit.covariance)
            own = {**own, effect.NAME: replace(one, vertex=fit.vertex)}
        found.append(dict(own))
    return found


def let_go(
    clips: Sequence[SeenClip], motion: Sequence[Array], settings: SlipSettings, threshold: float
) -> list[SeenClip]:
    """The clips, those marked in which nobody moved the pinned vertices and they do not stay all the same.

    One of them slips, or all have moved and another motion was recorded. A model that holds them would make
    up for that by the law of the cloth.

    Args:
        clips: see SeenClip.
        motion: of each, in which nothing holds them (F, N, 3) [m], see session_stages.loosened.
        settings: of what pinned vertices do in a refined motion.
        threshold: evidence from which on it is as probable as not that one slips [nats].
    """
    found = []
    for clip, positions in zip(clips, motion, strict=True):
        goes = clip.held_still and not stand_still(clip, positions)
        if clip.held_still and not goes:
            fit = slip_of(clip.problem.scene, positions, AnchorSlip(), settings, held_still=True)
            goes = bool(fit.log_evidence > threshold)
        found.append(replace(clip, let_go=goes))
    return found


def which_slips(findings: Sequence[Mapping[str, Finding]]) -> tuple[int, int]:
    """The clip that says most clearly that something slips, and the pinned vertex that does; both from 0.

    Args:
        findings: of every clip, see ``with_slips``.
    """
    slips = {k: found[AnchorSlip.NAME] for k, found in enumerate(findings) if AnchorSlip.NAME in found}
    if not slips:
        return 0, 0
    clip = max(slips, key=lambda k: slips[k].log_evidence)
    return clip, slips[clip].vertex


def slip_of(
    scene: Scene, positions: Array, effect: AnchorSlip, settings: SlipSettings, *, held_still: bool
) -> SlipFit:
    """Evidence that a pinned vertex slips in a clip.

    Args:
        scene: the clip.
        positions: its motion, refined by the base model (F, N, 3) [m].
        effect: see slip_evidence.
        settings: of what pinned vertices do in a refined motion.
        held_still: whether nobody moved them.
    """
    if held_still:
        settings = replace(settings, sway=(0.0,), share=0.0)
    pinned = list(scene.pinned_vertices)
    pull = positions[0].mean(0) - positions[0][pinned]
    return slip_evidence(effect, positions[:, pinned], scene.fps, pull, settings)
