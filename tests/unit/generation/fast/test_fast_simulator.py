from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from toile.generation.fast.clips import draw_batch, draw_sessions
from toile.generation.fast.effects import EFFECTS, LABELS, Around
from toile.generation.fast.kernels import LANES, SLOW
from toile.generation.fast.noise import tracking_noise
from toile.generation.fast.scenes import (
    GRAVITY,
    Cloth,
    Timing,
    draw_clip,
    draw_cloth,
    flat_start,
    make_sheet,
    settling_sheet,
)
from toile.generation.fast.sheet import Sheet, lattice, run

SETTLED = 1200


def plain_cloth(**changes: object) -> Cloth:
    cloth = draw_cloth(np.random.default_rng(0), (8, 8))
    parameters = dict.fromkeys(cloth.parameters, 0.0) | {"compression_edge": 1.0, "compression_diagonal": 1.0}
    plain = replace(
        cloth,
        size=(0.5, 0.5),
        density=0.15,
        stretching=200.0,
        shearing=2.0,
        bending=2e-4,
        diagonals=0.5,
        border_mass=1.0,
        border_stiffness=0.5,
        parameters=parameters,
    )
    return replace(plain, **changes)  # type: ignore[arg-type]


def free(sheet: Sheet) -> Sheet:
    """Its corners follow a free fall, so that nothing holds it."""
    fall = 0.5 * GRAVITY * sheet.times * (sheet.times + sheet.step)
    sheet.boundary = sheet.boundary + fall[:, None, None] * np.array([0, 1, 0])
    return sheet


def still_clip(seed: int = 0):
    clip = draw_clip(np.random.default_rng(seed), "release")
    return replace(
        clip, wind=np.zeros(3), amplitudes=np.zeros((2, 3)), own=np.zeros((2, 2, 3)), pinned_distance=1.0
    )


TIMING = Timing(20, 50.0, 20 * SLOW)


def test_a_free_sheet_falls_without_changing_its_shape() -> None:
    cloth = plain_cloth()
    clip = replace(still_clip(), initial_wind=np.zeros(3))
    grid = lattice(cloth.grid).places
    flat = np.stack([(grid[:, 1] - 0.5) * 0.5, grid[:, 0] * 0.5, 0 * grid[:, 0]], -1)
    motion = run([free(make_sheet(cloth, clip, TIMING)) for _ in range(LANES)], np.stack([flat] * LANES), 80)
    t = 19 / 50
    fallen = motion[0, -1] - motion[0, 0]
    assert fallen[:, 1] == pytest.approx(0.5 * GRAVITY * t**2, rel=2e-3)
    np.testing.assert_allclose(motion[0, -1] - motion[0, -1].mean(0), flat - flat.mean(0), atol=2e-5)


def swinging(change: Callable[[Sheet, Around], None] | None = None, **changes: object):
    """Energy per mass [J/kg] of a released sheet, frame by frame, and its motion."""
    cloth = plain_cloth(**changes)
    clip = replace(still_clip(), initial_wind=np.array([0, 0, 3.0]))
    start = run([settling_sheet(cloth, clip)] * LANES, np.stack([flat_start(cloth, clip)] * LANES), SETTLED)[
        :, -1
    ]
    timing = replace(TIMING, n_frames=40)
    sheet = make_sheet(cloth, clip, timing)
    if change is not None:
        change(sheet, Around(start[:1], 0.5, 0.8))
    motion = run([sheet] * LANES, start, timing.substeps)[0]
    v = np.diff(motion, axis=0) * 50
    m = sheet.masses / sheet.masses.sum()
    kinetic = 0.5 * (m * (v**2).sum(-1)).sum(-1)
    height = -GRAVITY * (m * 0.5 * (motion[1:] + motion[:-1])[..., 1]).sum(-1)
    return kinetic + height, motion


def test_energy_stays_where_nothing_dissipates_and_drag_takes_it() -> None:
    energy, motion = swinging()
    swing = 0.5 * ((np.diff(motion, axis=0) * 50) ** 2).sum(-1).mean(-1).max()
    assert swing > 0.05
    # Stretching and bending hold a part of it for a while.
    kept = energy[-10:].mean() - energy[:10].mean()
    assert abs(kept) < 0.35 * swing

    def drag(sheet: Sheet, around: Around) -> None:
        sheet.parameters |= {"drag": 2.0, "tangential": 1.0}

    slowed, _ = swinging(drag)
    assert slowed[-10:].mean() - slowed[:10].mean() < min(kept, 0.0) - 0.3 * swing


def test_hanging_cloth_stretches_by_its_weight() -> None:
    cloth = plain_cloth(stretching=150.0, shearing=60.0, diagonals=0.0)
    clip = replace(still_clip(), initial_wind=np.zeros(3))
    sheet = settling_sheet(cloth, clip)
    heavy = settling_sheet(replace(cloth, density=0.3), clip)
    sheets = [sheet] * 4 + [heavy] * 4
    start = np.stack([flat_start(cloth, clip)] * LANES)
    end = run(sheets, start, SETTLED)[:, -1].reshape(LANES, 8, 8, 3)
    below = np.linalg.norm(np.diff(end[:, :, 0], axis=1), axis=-1).sum(-1)
    assert below[0] > 0.5
    # Twice the weight, twice the stretch.
    assert (below[4] - 0.5) / (below[0] - 0.5) == pytest.approx(2.0, rel=0.15)


def test_every_effect_moves_the_sheet_by_more_with_more_strength() -> None:
    rng = np.random.default_rng(3)
    cloth, clip = plain_cloth(), draw_clip(rng, "sway")
    timing = Timing(25, 25.0, 40 * SLOW)
    start = run([settling_sheet(cloth, clip)] * LANES, np.stack([flat_start(cloth, clip)] * LANES), SETTLED)[
        :, -1
    ]
    twin = run([make_sheet(cloth, clip, timing)] * LANES, start, timing.substeps)[0]
    names = [name for name in EFFECTS if name not in ("frame_rate", "contact")]
    sheets = []
    for strength in (0.3, 1.0):
        for name in names:
            sheet = make_sheet(cloth, clip, timing)
            EFFECTS[name].change(sheet, np.random.default_rng(5), strength, Around(twin, 0.5, 0.96))
            sheets.append(sheet)
    sheets += sheets[: -len(sheets) % LANES]
    moved = []
    for i in range(0, len(sheets), LANES):
        motions = run(sheets[i : i + LANES], start, timing.substeps)
        moved += [np.linalg.norm(m - twin, axis=-1).mean() for m in motions]
    for i, name in enumerate(names):
        assert 1e-6 < moved[i] < moved[len(names) + i], name


def test_batches_are_the_same_twice_and_hold_effects_and_nulls() -> None:
    first, again = draw_batch(7, 0), draw_batch(7, 0)
    assert len(first) == len(again) > 8
    for a, b in zip(first, again, strict=True):
        assert a.label == b.label
        assert np.array_equal(a.positions, b.positions)
    assert {c.label for c in first} <= set(LABELS)
    assert any(c.label == "none" and c.size == 0 for c in first)
    assert all(0.5 <= c.size <= 14 for c in first if c.label != "none")


def test_clips_of_a_session_share_cloth_and_cause() -> None:
    sessions = draw_sessions(7, 0)
    assert sessions
    for clips in sessions:
        assert len({c.label for c in clips}) == len({c.cloth_size for c in clips}) == 1
        assert [c.motion for c in clips] == ["release", "shake", "sway"]


def test_tracking_noise_has_its_size_and_begins_at_nothing() -> None:
    error = tracking_noise(np.random.default_rng(1), (40, 12, 12), 25.0, 0.002)
    assert np.sqrt((error**2).sum(-1).mean()) == pytest.approx(0.002)
    assert not error[0].any()
    # Neighbours in space and time err alike, though not fully.
    rest = error[10:] - error[10:].mean()
    assert 0.1 < (rest[1:] * rest[:-1]).mean() / rest.var() < 1.0
