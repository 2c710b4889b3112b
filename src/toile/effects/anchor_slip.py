"""Anchor slip: a pinned corner gives way."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from toile.effects.base import BoundaryEffect, Parameter, Scope, Stage, Surroundings
from toile.errors import InputError
from toile.limits import CountOrZero, NonNegative, Positive, Unit


class AnchorSlip(BoundaryEffect):
    """One pinned vertex moves away from its path by a vector, along a smooth ramp 3s² - 2s³, and stays there.

    Args:
        values: see Effect.
        vertex: which of the pinned vertices, from 0.
        start: when it begins [s].
        duration: how long it takes [s].
    """

    NAME: ClassVar[str] = "anchor_slip"
    STAGE: ClassVar[Stage] = Stage.ACTUATION
    SCOPE: ClassVar[Scope] = Scope.CLIP
    PARAMETERS: ClassVar[tuple[Parameter, ...]] = tuple(
        Parameter(axis, "m", -0.3, 0.3, 0.02, f"displacement along the camera's {axis} axis")
        for axis in "xyz"
    )
    SOURCE: ClassVar[str] = (
        "this project's own; the ramp is the cubic Hermite blend, Farin, Curves and Surfaces for CAGD, 5th "
        "edition 2002"
    )

    def __init__(
        self,
        values: Mapping[str, float] | None = None,
        vertex: CountOrZero = 0,
        start: Annotated[NonNegative, Unit("s")] = 0.3,
        duration: Annotated[Positive, Unit("s")] = 0.2,
    ) -> None:
        super().__init__(values)
        if vertex < 0 or start < 0 or not duration > 0:
            raise InputError(
                "anchor_slip: no such slip",
                where="effect=anchor_slip",
                expected="vertex >= 0, start >= 0 s, duration > 0 s",
                got=f"vertex {vertex}, start {start:g} s, duration {duration:g} s",
            )
        self._vertex, self._start, self._duration = vertex, start, duration

    def acts_on(self, around: Surroundings, motion: Tensor) -> Tensor:
        """See Effect: what is near the vertex that slips hangs from it, 1 there and 0 farthest off."""
        u, v = (
            places * side for places, side in zip(around.cloth.lines.places(), around.cloth_size, strict=True)
        )
        places = torch.cartesian_prod(u, v)
        away = (places - places[around.cloth.pinned[self._vertex]]).norm(dim=-1)
        return 1 - away / away.max()

    def boundary(self, boundary: Tensor, around: Surroundings) -> Tensor:
        """See AnchorEffect.

        Raises:
            InputError: fewer vertices are pinned.
        """
        if self._vertex >= boundary.shape[1]:
            raise InputError(
                "anchor_slip: no such pinned vertex",
                where="effect=anchor_slip",
                expected=f"vertex below {boundary.shape[1]}",
                got=str(self._vertex),
            )
        if not self.is_active:
            return boundary
        s = ((around.frame_times() - self._start) / self._duration).clamp(0.0, 1.0)
        ramp = s.square() * (3 - 2 * s)
        which = torch.zeros(boundary.shape[1], dtype=torch.float64)
        which[self._vertex] = 1.0
        return boundary + ramp[:, None, None] * which[None, :, None] * self.values
