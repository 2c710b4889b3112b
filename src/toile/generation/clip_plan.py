"""What is done in one clip of a session: a plan that every generator can carry out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from toile.errors import InputError
from toile.limits import Positive, TwoOrMore, Unit

MOTIONS = {
    "hang": "corners still, in a steady wind that changes at frame 0",
    "release": "corners still; a wind that has pushed the cloth aside stops at frame 0",
    "shake": "corners shaken by 1 to 3 cm, one to two times a second, in a weak wind",
    "sway": "corners moved slowly by 3 to 10 cm, in a weak wind",
    "turned": "as shake, but turned by 90°: held by the other pair of corners",
    "fan_off": "as shake, without any wind",
}
"""What may be done in a clip."""


@dataclass(frozen=True)
class ClipPlan:
    """One clip of a session.

    Attributes:
        motion: one of MOTIONS.
        n_frames: F.
        fps: frames per second, declared.
        place: of its random stream: two clips of one session with the same motion differ by it. Whether and
            in which order other clips are made changes nothing.

    Raises:
        InputError: no such motion, fewer than two frames, or a frame rate that is none.
    """

    motion: str
    n_frames: Annotated[TwoOrMore, Unit("frames")] = 80
    fps: Annotated[Positive, Unit("1/s")] = 50.0
    place: int = 0

    def __post_init__(self) -> None:
        if self.motion not in MOTIONS:
            raise InputError("No such motion", where="motion", expected=", ".join(MOTIONS), got=self.motion)
        for name, fine in (("n_frames", self.n_frames >= 2), ("fps", 0 < self.fps < math.inf)):
            if not fine:
                raise InputError(
                    "A clip cannot be planned",
                    where=name,
                    expected="at least 2 frames, and a rate above 0",
                    got=str(getattr(self, name)),
                )

    @property
    def stream(self) -> tuple[int, int]:
        """Numbers that tell the clip's random stream from those of the session's other clips."""
        return list(MOTIONS).index(self.motion), self.place


DEFAULT_CLIPS = (ClipPlan("release"), ClipPlan("shake"), ClipPlan("sway"))
"""Three clips of 80 frames at 50 frames per second."""
