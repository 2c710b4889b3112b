"""Plans of clips."""

from __future__ import annotations

import pytest

from toile.errors import InputError
from toile.generation.clip_plan import DEFAULT_CLIPS, MOTIONS, ClipPlan


def test_streams_differ() -> None:
    streams = {ClipPlan(motion, place=place).stream for motion in MOTIONS for place in (0, 1)}
    assert len(streams) == 2 * len(MOTIONS)


def test_a_motion_that_is_none() -> None:
    with pytest.raises(InputError, match="wave"):
        ClipPlan("wave")


def test_the_default_session() -> None:
    assert [clip.motion for clip in DEFAULT_CLIPS] == ["release", "shake", "sway"]
    assert {clip.n_frames / clip.fps for clip in DEFAULT_CLIPS} == {1.6}
