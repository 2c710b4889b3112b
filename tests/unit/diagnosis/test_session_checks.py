"""What clips show otherwise than their session says."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from toile.diagnosis.joint_fit import JointFit
from toile.diagnosis.session_checks import (
    copied_clips,
    holders_away,
    moved_holders,
    short_of_memory,
    stand_still,
    stopped_short,
    unknown_motions,
    unlike_devices,
    wind_in_still_air,
)
from toile.scenes.session import Session, SessionClip

WIDTH, FRAMES = 0.5, 20


def seen(moved: np.ndarray, *, still: bool = True) -> tuple[Any, np.ndarray]:
    """A clip and its motion, the second corner ``moved`` (F, 3) [m] away from where the template has it."""
    template = np.array([[[0.1, 0.0, 1.0], [0.1, 0.5, 1.0]], [[0.6, 0.0, 1.0], [0.6, 0.5, 1.0]]])
    positions = np.tile(template.reshape(1, 4, 3), (FRAMES, 1, 1))
    positions[:, 2] += moved
    # The free ones go anywhere.
    positions[:, 1] += 0.2
    scene = SimpleNamespace(
        template=torch.from_numpy(template), pinned_vertices=[0, 2], cloth_size=(WIDTH, WIDTH)
    )
    return SimpleNamespace(problem=SimpleNamespace(scene=scene), held_still=still), positions


def said_of(motion: str, clip: Any, positions: np.ndarray) -> list[str]:
    """What is said of a session of this clip alone."""
    return moved_holders(Session("s", (SessionClip(Path("first"), motion),)), [clip], [positions])


def test_holders_that_move_although_nobody_moved_them_are_said() -> None:
    swayed = np.outer(0.04 * np.sin(np.arange(FRAMES) / 3), [0.0, 1.0, 0.0])
    (said,) = said_of("release", *seen(swayed))
    assert said.startswith("first: what holds the cloth moves by 27 mm")
    assert "'release'" in said
    # Where somebody is said to move them, that is as it should be.
    assert said_of("sway", *seen(swayed, still=False)) == []


def test_a_wind_in_a_clip_without_one_is_said() -> None:
    session = Session("s", tuple(SessionClip(Path(name), name) for name in ("release", "shake", "fan_off")))
    airs = [SimpleNamespace(around=SimpleNamespace(still_air=still)) for still in (True, False, True)]
    # Three numbers of the material, then the winds; a draught of 3 cm/s² is usual.
    base = SimpleNamespace(values=np.array([1.0, 1.0, 1.0, 0.12, -0.16, 2.0, 0.0, 0.03, 0.0]))
    (said,) = wind_in_still_air(session, cast(Any, airs), cast(JointFit, base))
    assert said.startswith("release: its cloth hangs as in a wind of 0.2 m/s² or more")
    assert "'release'" in said


def test_fits_that_have_not_arrived_are_said() -> None:
    there, short = (cast(JointFit, SimpleNamespace(converged=converged)) for converged in (True, False))
    assert stopped_short(there, {"gusts": there}) == []
    (said,) = stopped_short(short, {"gusts": there, "contact": short})
    assert "the fit of the base model and of contact has stopped" in said


def test_errors_of_the_motion_that_is_found_are_no_motion_of_the_holders() -> None:
    rng = np.random.default_rng(0)
    ray = np.array([0.6, 0.0, 1.0]) / np.hypot(0.6, 1.0)
    # Along the line of sight images say little; a few frames may be lost.
    errors = 0.03 * np.outer(rng.standard_normal(FRAMES), ray) + 0.001 * rng.standard_normal((FRAMES, 3))
    errors[:3] += 0.1
    assert holders_away(*seen(errors)).max() < 0.005
    assert said_of("release", *seen(errors)) == []


def test_where_all_holders_move_another_motion_was_recorded() -> None:
    swayed = np.outer(0.04 * np.sin(np.arange(FRAMES) / 3), [0.0, 1.0, 0.0])
    clip, slipping = seen(swayed)
    assert stand_still(clip, slipping)
    both = slipping.copy()
    both[:, 0] += swayed
    assert not stand_still(clip, both)
    assert not stand_still(*seen(swayed, still=False))


@pytest.mark.parametrize(("motion", "known"), [("", True), ("fan_off", True), ("fan-off", False)])
def test_a_motion_that_nobody_knows_is_said(motion: str, known: bool) -> None:
    said = unknown_motions(Session("s", (SessionClip(Path("second"), motion),)))
    assert (said == []) == known
    assert all("second" in one and motion in one for one in said)


@pytest.mark.parametrize(("n_frames", "measured"), [(40, 2.7), (80, 4.3), (240, 8.4)])
def test_what_may_be_ended_without_a_word_is_said_before(n_frames: int, measured: float) -> None:
    """By what sessions of 20 x 20 vertices have taken; a machine with half of that is too small."""
    assert short_of_memory(n_frames, 400, 1.2 * measured) == []
    (said,) = short_of_memory(n_frames, 400, 0.5 * measured)
    assert f"{n_frames} frames" in said
    assert f"{0.5 * measured:.1f} GB are free" in said


def test_clips_of_one_device_share_clock_and_lens() -> None:
    frames = torch.rand(3, 4, 4, 3, generator=torch.Generator().manual_seed(1))

    def filmed(fps: float, focal: float, images: torch.Tensor = frames) -> Any:
        return SimpleNamespace(fps=fps, camera=SimpleNamespace(fx=focal), frames=images)

    def of(*devices: str) -> Session:
        clips = [SessionClip(Path(f"clip_{k}"), "shake", device) for k, device in enumerate(devices)]
        return Session("s", tuple(clips))

    scenes = [filmed(50.0, 800.0), filmed(50.0, 801.0, 1 - frames), filmed(25.0, 1200.0)]
    rate, focal = unlike_devices(of("phone", "phone", "phone"), scenes)
    assert rate.startswith("clip_2: 25 frames per second where clip_0 has 50")
    assert focal.startswith("clip_2: 1200 px of focal length")
    assert unlike_devices(of("phone", "phone", "camera"), scenes) == []
    (copied,) = copied_clips(of("phone", "phone", "camera"), scenes)
    assert copied == "clip_2: its images are those of clip_0, so its evidence counts twice"
