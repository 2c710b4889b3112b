"""What is suspicious about a sequence of masks; the user decides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch

from toile.preparation.segmentation.cleaning import Mask
from toile.scenes.findings import Finding, Severity, named
from toile.scenes.masks import Box, bounding_box


@dataclass(frozen=True)
class MaskMeasures:
    """What the checks need to know of a mask.

    Attributes:
        area: number of pixels inside.
        box: bounding box of them.
        at_border: whether one of them is on the border of the image.
    """

    area: int
    box: Box
    at_border: bool


def measure(mask: Mask) -> MaskMeasures:
    """Measure a mask (h, w)."""
    border = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
    return MaskMeasures(int(mask.sum()), bounding_box(torch.from_numpy(mask)), bool(border))


def check_sequence(measures: Sequence[MaskMeasures], largest_jump: float, where: str) -> list[Finding]:
    """Warnings about masks that jump in area or touch the border of the image.

    Args:
        measures: one per frame, in order.
        largest_jump: factor between the areas of two successive masks from which on they are named.
        where: file or folder, for messages.
    """
    areas = [m.area for m in measures]
    jumps = [t for t, two in enumerate(pairwise(areas), 1) if max(two) > largest_jump * min(two)]
    cut_off = [t for t, m in enumerate(measures) if m.at_border]
    findings = []
    if jumps:
        t = jumps[0]
        findings.append(
            Finding(
                Severity.WARNING,
                "Mask jumps in area",
                f"{where}: {named(jumps)}",
                f"areas within a factor {largest_jump:g} of the frame before",
                f"from {areas[t - 1]} to {areas[t]} px at frame {t}",
            )
        )
    if cut_off:
        findings.append(
            Finding(
                Severity.WARNING,
                "Mask touches the border of the image",
                f"{where}: {named(cut_off)}",
                "a cloth that is fully visible",
                f"{len(cut_off)} of {len(measures)} masks that do",
            )
        )
    return findings
