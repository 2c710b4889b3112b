from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from toile.errors import InputError
from toile.evaluation.out_of_balance import OutOfBalanceForce, out_of_balance_force

GRAVITY = torch.tensor([0.0, 9.81, 0.0], dtype=torch.float64)
MASSES = torch.tensor([[0.25, 0.5, 0.25], [0.5, 1.0, 0.5]], dtype=torch.float64) * 1e-3
DT = 0.02


def no_force(x: Tensor) -> Tensor:
    return torch.zeros_like(x)


def measure(positions: Tensor, internal: object = no_force, **changes: object) -> OutOfBalanceForce:
    arguments: dict[str, object] = {
        "masses": MASSES,
        "internal_forces": internal,
        "external_forces": MASSES[..., None] * GRAVITY,
        "frame_time": DT,
        "gravity": GRAVITY,
    }
    return out_of_balance_force(positions, **(arguments | changes))  # type: ignore[arg-type]


def rest() -> Tensor:
    y, x = torch.meshgrid(torch.arange(2.0), torch.arange(3.0), indexing="ij")
    return torch.stack((x, y, torch.ones_like(x)), -1).double()


def falling(n: int = 6) -> Tensor:
    t = DT * torch.arange(n, dtype=torch.float64)[:, None, None, None]
    return rest() + 0.3 * t + 0.5 * GRAVITY * t**2


def test_free_fall_is_balanced() -> None:
    result = measure(falling())
    assert result.mean == pytest.approx(0.0, abs=1e-9)
    assert result.maximum == pytest.approx(0.0, abs=1e-9)
    assert result.residual.shape == (4, 2, 3, 3)


def test_cloth_hovering_without_support_misses_its_weight() -> None:
    result = measure(rest().expand(5, -1, -1, -1))
    # Every vertex misses m g; over the mean weight the mean is 1 and the heaviest vertex is 1 mg / 0.5 mg.
    assert result.mean == pytest.approx(1.0)
    assert result.maximum == pytest.approx(2.0)
    assert result.mean_weight == pytest.approx(0.5e-3 * 9.81)
    torch.testing.assert_close(result.residual[0], -MASSES[..., None] * GRAVITY)
    assert np.isnan(result.per_frame[[0, -1]]).all()
    assert result.per_frame[1:-1].tolist() == pytest.approx([1.0, 1.0, 1.0])


def test_supporting_internal_force_restores_balance_and_its_sign_matters() -> None:
    hover = rest().expand(4, -1, -1, -1)
    support = -MASSES[..., None] * GRAVITY
    assert measure(hover, support.expand_as).mean == pytest.approx(0.0, abs=1e-12)
    assert measure(hover, lambda x: -support.expand_as(x)).mean == pytest.approx(2.0)


def test_harmonic_motion_converges_with_the_square_of_the_time_step() -> None:
    omega, unit = 5.0, torch.ones(2, 3, 1, dtype=torch.float64) * torch.tensor([0.1, 0.0, 0.0])

    def error(dt: float) -> float:
        t = dt * torch.arange(round(1 / dt), dtype=torch.float64)[:, None, None, None]
        x = rest() + unit * torch.cos(omega * t)
        springs = lambda x: -MASSES[..., None] * omega**2 * (x - rest())  # noqa: E731
        return measure(x, springs, external_forces=torch.zeros(3), frame_time=dt).mean

    assert error(0.02) / error(0.01) == pytest.approx(4.0, rel=0.05)


def test_pinned_vertices_do_not_count() -> None:
    x = falling().clone()
    x[3, 0, 0] += 1.0
    assert measure(x).maximum > 1.0
    assert measure(x, pinned_vertices=(0,)).maximum == pytest.approx(0.0, abs=1e-9)


def test_external_forces_may_change_per_frame() -> None:
    wind = torch.zeros(4, 2, 3, 3, dtype=torch.float64)
    wind[2] = MASSES[..., None] * GRAVITY
    result = measure(falling(), external_forces=MASSES[..., None] * GRAVITY + wind)
    assert result.per_frame[1:-1].tolist() == pytest.approx([0.0, 0.0, 1.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(
    ("positions", "changes"),
    [
        (falling(2), {}),
        (falling(), {"frame_time": 0.0}),
        (falling(), {"masses": torch.ones(3, 3)}),
        (falling(), {"gravity": torch.zeros(3)}),
        (falling(), {"internal_forces": lambda x: x[0]}),
        (falling(), {"external_forces": torch.zeros(9, 4, 2, 3, 3)}),
        (falling(), {"pinned_vertices": tuple(range(6))}),
    ],
    ids=["frames", "time", "masses", "gravity", "internal", "external", "all pinned"],
)
def test_bad_input_is_named(positions: Tensor, changes: dict[str, object]) -> None:
    with pytest.raises(InputError, match="out-of-balance"):
        measure(positions, **changes)


def test_unevenly_spaced_frames_of_a_fall() -> None:
    """A parabola has no residual at any frame, and with one time between all frames it has."""
    t = torch.tensor([0.0, 0.02, 0.04, 0.12, 0.2, 0.22], dtype=torch.float64)
    x = rest() + 0.5 * GRAVITY * t[:, None, None, None] ** 2
    weight = MASSES[..., None] * GRAVITY
    assert measure(x, external_forces=weight, frame_time=t.diff()).maximum == pytest.approx(0.0, abs=1e-9)
    assert measure(x, external_forces=weight, frame_time=float(t.diff().mean())).maximum > 0.5
    for wrong in (t, -t.diff()):
        with pytest.raises(InputError, match="out-of-balance"):
            measure(x, external_forces=weight, frame_time=wrong)
