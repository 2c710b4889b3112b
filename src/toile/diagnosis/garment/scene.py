"""The numbers that a roll-out of a garment on a moving body depends on."""

from __future__ import annotations

from dataclasses import dataclass, replace


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

    @property
    def moving(self) -> Scene:
        """What the motion depends on: the bias of masks does not move anything."""
        return replace(self, bias=0.0)
