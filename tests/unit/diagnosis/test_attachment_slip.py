"""A displacement of a pinned vertex that comes quickly and stays is a slip; sway, drift, depth are not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from toile.diagnosis.attachment_slip import SlipSettings, slip_evidence
from toile.diagnosis.findings import finding
from toile.effects.anchor_slip import AnchorSlip
from toile.errors import InputError

Array = NDArray[np.float64]
FPS = 25.0
N_FRAMES = 30
PINNED = np.array([[-0.3, -0.3, 1.4], [0.3, -0.3, 1.4]])
PULL = PINNED.mean(0) + np.array([0.0, 0.3, 0.0]) - PINNED
TIMES = np.arange(N_FRAMES) / FPS
# Of the second pinned vertex: towards the first and down, as much across the view as it can be.
GIVES_WAY = np.array([-0.8, 0.6, 0.0])


def errors(rng: np.random.Generator, size: float, memory: float) -> Array:
    """Errors of tracking that last for ``memory`` [s] and are five times larger in depth."""
    keep = np.exp(-1 / FPS / memory)
    x = rng.standard_normal((N_FRAMES, 2, 3))
    for f in range(1, N_FRAMES):
        x[f] = keep * x[f - 1] + np.sqrt(1 - keep**2) * x[f]
    out: Array = size * (x + 0.2 * rng.standard_normal(x.shape)) * [1.0, 1.0, 5.0]
    return out


def motion(kind: str, rng: np.random.Generator) -> Array:
    """Pinned positions without a slip."""
    path = np.zeros((N_FRAMES, 2, 3))
    if kind == "shaken":
        path += 0.03 * np.sin(2 * np.pi * 2 * TIMES)[:, None, None] * [0.5, 0.0, 1.0]
    elif kind == "swinging":
        # Two hands, one of which moves further.
        swing = 0.5 * (1 - np.cos(2 * np.pi * TIMES / rng.uniform(0.9, 1.5)))
        difference = rng.uniform(0.15, 0.4)
        path += 0.05 * swing[:, None, None] * [0.7, 0.5, 1.0]
        path *= np.array([1 + difference, 1 - difference])[:, None]
    elif kind == "drifting":
        path += 0.005 * TIMES[:, None, None] / TIMES[-1] * rng.choice([-1, 1], (2, 3))
    return PINNED + path


def slipped(positions: Array, displacement: Array, start: float = 0.5, duration: float = 0.12) -> Array:
    """The second pinned vertex gives way."""
    s = np.clip((TIMES - start) / duration, 0, 1)
    out = positions.copy()
    out[:, 1] += (s * s * (3 - 2 * s))[:, None] * displacement
    return out


@pytest.mark.parametrize("kind", ["still", "shaken", "swinging", "drifting"])
def test_no_slip(kind: str) -> None:
    found = []
    for seed in range(50 if kind == "swinging" else 12):
        rng = np.random.default_rng(seed)
        positions = motion(kind, rng) + errors(rng, 0.0015, 0.3)
        found.append(slip_evidence(AnchorSlip(), positions, FPS, PULL).log_evidence)
    assert np.mean(np.array(found) < 0) >= 0.9
    assert max(found) < 2


def test_slip_is_found() -> None:
    evidence, vertices, seen = [], [], []
    for distance in (0.01, 0.02, 0.04):
        found = []
        for seed in range(8):
            rng = np.random.default_rng(seed)
            positions = slipped(motion("still", rng) + errors(rng, 0.0015, 0.3), distance * GIVES_WAY)
            found.append(slip_evidence(AnchorSlip(), positions, FPS, PULL))
        evidence.append(float(np.median([f.log_evidence for f in found])))
        vertices += [f.vertex for f in found if distance == 0.04]
        seen += [f for f in found if distance == 0.04]
    # A centimetre is what a tracker may do; it speaks neither for nor against.
    assert -2 < evidence[0] < 2
    assert evidence[1] > 2
    assert evidence[2] > 4
    assert vertices.count(1) >= 7
    for fit in seen:
        numbers = finding(AnchorSlip(), fit.log_evidence, fit.mean, fit.covariance)
        sign = 1 if fit.vertex == 1 else -1
        # Sway may have had a part of it.
        assert -0.045 < sign * numbers.mean["x"] < -0.015
        assert abs(fit.start + fit.duration / 2 - 0.56) < 0.13


def test_direction_is_that_of_the_effect() -> None:
    rng = np.random.default_rng(0)
    positions = slipped(motion("still", rng) + errors(rng, 0.0003, 0.3), 0.04 * GIVES_WAY)
    fit = slip_evidence(AnchorSlip(), positions, FPS, PULL)
    found = finding(AnchorSlip(), fit.log_evidence, fit.mean, fit.covariance).mean
    assert found["x"] == pytest.approx(0.04 * GIVES_WAY[0], abs=0.009)
    assert found["y"] == pytest.approx(0.04 * GIVES_WAY[1], abs=0.009)


def test_depth_is_not_claimed() -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        positions = motion("still", rng) + errors(rng, 0.0015, 0.3)
        positions = slipped(positions, np.array([0.0, 0.0, 0.02]))
        assert slip_evidence(AnchorSlip(), positions, FPS, PULL).log_evidence < 1


def test_what_returns_is_no_slip() -> None:
    rng = np.random.default_rng(0)
    positions = motion("still", rng) + errors(rng, 0.001, 0.3)
    bump = np.exp(-0.5 * ((TIMES - 0.6) / 0.15) ** 2)
    swayed = positions.copy()
    swayed[:, 1] += 0.02 * bump[:, None] * GIVES_WAY
    stayed = slip_evidence(AnchorSlip(), slipped(positions, 0.02 * GIVES_WAY), FPS, PULL)
    returned = slip_evidence(AnchorSlip(), swayed, FPS, PULL)
    assert returned.log_evidence < min(1.0, stayed.log_evidence)


def test_a_grip_gives_way_along_the_pull() -> None:
    rng = np.random.default_rng(0)
    positions = motion("still", rng) + errors(rng, 0.0005, 0.3)
    along = slip_evidence(AnchorSlip(), slipped(positions, 0.03 * GIVES_WAY), FPS, PULL)
    against = slip_evidence(AnchorSlip(), slipped(positions, -0.03 * GIVES_WAY), FPS, PULL)
    assert along.log_evidence > against.log_evidence + 1


def test_common_motion_does_not_matter() -> None:
    rng = np.random.default_rng(1)
    positions = motion("still", rng) + errors(rng, 0.001, 0.3)
    moved = positions + 0.05 * np.sin(TIMES)[:, None, None] * [0.0, 0.0, 0.02]
    one, other = (slip_evidence(AnchorSlip(), p, FPS).log_evidence for p in (positions, moved))
    assert one == pytest.approx(other, abs=0.1)


def test_three_pinned_vertices() -> None:
    rng = np.random.default_rng(0)
    positions = slipped(motion("still", rng) + errors(rng, 0.001, 0.3), 0.04 * GIVES_WAY)
    third = PINNED.mean(0) + errors(rng, 0.001, 0.3)[:, :1]
    fit = slip_evidence(AnchorSlip(), np.concatenate((positions, third), 1), FPS)
    assert fit.vertex == 1
    assert fit.log_evidence > 4


def test_nothing_to_compare_with() -> None:
    assert slip_evidence(AnchorSlip(), np.zeros((N_FRAMES, 1, 3)) + PINNED[0], FPS).log_evidence == 0
    assert slip_evidence(AnchorSlip(), np.zeros((5, 2, 3)) + PINNED, FPS).log_evidence == 0


def test_bad_input() -> None:
    with pytest.raises(InputError):
        slip_evidence(AnchorSlip(), np.zeros((N_FRAMES, 2)), FPS)
    with pytest.raises(InputError):
        slip_evidence(AnchorSlip(), np.zeros((N_FRAMES, 2, 3)) + PINNED, FPS, PULL[:1])


def test_hands_that_the_settings_let_sway_explain_a_slip() -> None:
    positions = slipped(motion("still", np.random.default_rng(3)), 0.03 * GIVES_WAY)
    positions = positions + errors(np.random.default_rng(3), 0.002, 0.3)
    usual = slip_evidence(AnchorSlip(), positions, FPS, PULL)
    assert usual.log_evidence > 2
    swaying = SlipSettings(sway=(0.05,), slow=0.1)
    assert slip_evidence(AnchorSlip(), positions, FPS, PULL, swaying).log_evidence < usual.log_evidence - 2
    # A ramp of a quarter of a second alone is tried.
    slow = slip_evidence(AnchorSlip(), positions, FPS, PULL, SlipSettings(durations=(0.24,)))
    assert slow.duration == 0.24
    late = slip_evidence(AnchorSlip(), positions, FPS, PULL, SlipSettings(first_frames=16))
    assert late.start >= 16 / FPS


def test_twice_the_frame_rate_leaves_the_times_as_they_are() -> None:
    """A jump while tracking leaves the template says nothing, and neither does one at the very end."""
    usual, quick, slow = (SlipSettings().at(fps) for fps in (25.0, 50.0, 5.0))
    assert usual == SlipSettings()
    assert (quick.first_frames, quick.stays) == (6, 6)
    assert (slow.first_frames, slow.stays) == (1, 1)
    times = np.arange(60) / 50
    still = np.zeros((60, 2, 3)) + PINNED
    early, slip, late = still.copy(), still.copy(), still.copy()
    early[:6, 1] -= 0.04 * GIVES_WAY
    slip[:, 1] += np.clip((times - 0.5) / 0.12, 0, 1)[:, None] * 0.04 * GIVES_WAY
    late[-5:, 1] += 0.04 * GIVES_WAY
    nothing, of_early, of_slip, of_late = (
        slip_evidence(AnchorSlip(), positions, 50.0, PULL).log_evidence
        for positions in (still, early, slip, late)
    )
    assert of_early == pytest.approx(nothing, abs=0.5)
    assert of_slip > 5
    assert of_slip > of_late + 3
    assert slip_evidence(AnchorSlip(), slip[::2], 25.0, PULL).log_evidence > 5
