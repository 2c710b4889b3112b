"""What a training descends along: derivatives against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from toile.learning.surrogate.objectives import BehindTheSweeps, PassesApart, Progress
from toile.learning.surrogate.pool import Pool
from toile.learning.surrogate.schedules import UnrolledSteps
from toile.physics.surrogate import surrogate as of_passes
from toile.physics.surrogate.surrogate import Surrogate

MakePool = Callable[..., Pool]
BATCH = torch.arange(4)
WHOLE_RUN = Progress(0, 1)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Surrogate:
    """One that says something, in a training that limits nothing."""
    monkeypatch.setattr(of_passes, "_LARGEST_GRADIENT", 1e9)
    torch.manual_seed(0)
    surrogate = Surrogate((4, 8))
    for head in (surrogate.network.vertex_head, *surrogate.network.heads):
        nn.init.normal_(nn.Module.get_parameter(head, "weight"), std=0.02)
    return surrogate


def calm(make_pool: MakePool) -> Pool:
    """Soft cloths in motion, without random numbers in their problems."""
    pool = make_pool(noise_share=0.0)
    pool.states.stiffness[:] = torch.tensor([50.0, 0.1, 0.01])
    for _ in range(3):
        pool.advance(BATCH, pool.problem(BATCH).starts[:, 1])
    return pool


def along(surrogate: Surrogate, directions: list[Tensor]) -> float:
    """Derivative in a direction of the weights that the backward pass has left."""
    pairs = zip(surrogate.parameters(), directions, strict=True)
    return sum(float((p.grad * d).sum()) for p, d in pairs if p.grad is not None)


def directions(surrogate: Surrogate) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(p.shape, generator=generator) * 0.1 for p in surrogate.parameters()]


def moved(surrogate: Surrogate, by: list[Tensor], step: float) -> None:
    with torch.no_grad():
        for p, d in zip(surrogate.parameters(), by, strict=True):
            p.add_(step * d)


def test_the_gradient_goes_through_the_sweeps(make_pool: MakePool, network: Surrogate) -> None:
    pool = calm(make_pool)
    problem, stored = pool.problem(BATCH), pool.state_dict()
    with torch.no_grad():
        begun = network.begin(problem)
        x, r = begun.last

    def after() -> Tensor:
        with torch.no_grad():
            found, _ = network.improve(problem, begun, network.network(problem, x, r), 2).last
            return problem.potential(found)

    scale = of_passes.loss_scale(problem, r, after() - problem.potential(x))
    turn = BehindTheSweeps(2, UnrolledSteps(())).turn(network, pool, BATCH, 1, WHOLE_RUN)
    turn.loss.backward()  # type: ignore[no-untyped-call]
    by, step, sides = directions(network), 1e-2, []
    for sign in (1, -1):
        moved(network, by, sign * step)
        sides.append(float((after() / scale).mean()))
        moved(network, by, -sign * step)
    assert along(network, by) == pytest.approx((sides[0] - sides[1]) / (2 * step), rel=0.1)
    pool.load_state_dict(stored)


def test_unrolled_steps_depend_on_the_steps_before(make_pool: MakePool, network: Surrogate) -> None:
    pool = calm(make_pool)
    stored = pool.state_dict()
    found = []
    for after in ((), (0.0,)):
        pool.load_state_dict(stored)
        network.zero_grad()
        turn = BehindTheSweeps(1, UnrolledSteps(after)).turn(network, pool, BATCH, 1, WHOLE_RUN)
        turn.loss.backward()  # type: ignore[no-untyped-call]
        assert (pool.states.age[BATCH] == 4 + len(after)).all()
        found.append(torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None]))
    assert all(gradient.isfinite().all() for gradient in found)
    assert not torch.allclose(found[0], found[1], rtol=0.01)


def test_a_problem_depends_on_where_the_steps_before_have_led(make_pool: MakePool) -> None:
    pool = calm(make_pool)
    plain = pool.problem(BATCH)
    newest = pool.states.history[BATCH, 0].clone().requires_grad_()
    problem = pool.problem(BATCH, [newest])
    torch.testing.assert_close(problem.prediction, plain.prediction)
    torch.testing.assert_close(problem.starts, plain.starts)
    (gradient,) = torch.autograd.grad(problem.prediction[0, 2, 2, 0], newest)
    weight = 8 / 3 if pool.states.bdf2[0] else 2.0
    assert gradient[0, 2, 2, 0].item() == pytest.approx(weight)
    assert gradient.count_nonzero() == 1


def test_a_cloth_far_from_balance_does_not_spoil_the_others(make_pool: MakePool, network: Surrogate) -> None:
    pool = calm(make_pool)
    pool.states.history[1, 0] *= 30.0
    for objective in (PassesApart(), BehindTheSweeps(1, UnrolledSteps((0.0,)))):
        stored = pool.state_dict()
        network.zero_grad()
        objective.turn(network, pool, BATCH, 2, WHOLE_RUN).loss.backward()  # type: ignore[no-untyped-call]
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        assert any(g.abs().max() > 0 for g in gradients)
        assert all(g.isfinite().all() for g in gradients)
        pool.load_state_dict(stored)
