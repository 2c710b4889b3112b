"""What is compared with the converged solver: the surrogate, and what one gets without it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from toile.physics.cloth import Cloth
from toile.physics.hybrid.simulator import HybridSimulator
from toile.physics.implicit.integrators import Integrator
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.linearizable import LinearizableSimulator
from toile.physics.surrogate.problem import StepProblem
from toile.physics.surrogate.simulator import SurrogateSimulator

Build = Callable[[Cloth, float, Integrator], LinearizableSimulator]

CONVERGED = NewtonSettings(tolerance=1e-6, max_iterations=200, max_halvings=12)
EXTRAPOLATION = "extrapolation"
# Half as long again as two passes of the network take in a batch of 32.
LINE_SWEEPS = 8
RELAXATION = f"no network, {LINE_SWEEPS} line sweeps"
ONE_NEWTON_STEP = "one Newton step"
TWO_NEWTON_STEPS = "up to two Newton steps"
WITHOUT_NETWORK = (ONE_NEWTON_STEP, TWO_NEWTON_STEPS, RELAXATION, EXTRAPOLATION)
SOLVER = "solver"
FLOOR = "solver, start moved by 1e-4 edges"
HYBRID_CORRECTIONS = (1, 2)


class Silence(nn.Module):
    """Stands in for the network: no displacement."""

    def forward(self, problem: StepProblem, positions: Tensor, residual: Tensor) -> Tensor:
        return torch.zeros_like(residual)


class _NoNetwork:
    """Stands in for the network: the best start as it is."""

    def solve(self, problem: StepProblem, n_passes: int, sweeps: int) -> tuple[Tensor, Tensor]:
        start = problem.best_start()
        return start, problem.residual(start)


def surrogate_label(passes: int) -> str:
    """Name of the surrogate with a number of passes."""
    return f"surrogate, {passes} pass" + ("es" if passes > 1 else "")


def usual(passes: list[int]) -> int:
    """The number of passes that stands for the surrogate where one is enough."""
    return passes[len(passes) // 2]


def hybrid_label(passes: list[int], corrections: int) -> str:
    """Name of the hybrid: the fewest passes of the surrogate, then Newton corrections."""
    return f"{surrogate_label(passes[0])}, then {corrections} Newton step" + ("s" if corrections > 1 else "")


def contenders(weights: Path | None, passes: list[int]) -> dict[str, Build]:
    """All of them, by name."""

    def surrogate(n: int) -> Build:
        return lambda cloth, h, integrator: SurrogateSimulator(cloth, h, integrator, n, weights=weights)

    def hybrid(corrections: int) -> Build:
        def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
            def predictor(its_cloth: Cloth, step: float) -> LinearizableSimulator:
                return SurrogateSimulator(its_cloth, step, integrator, passes[0], weights=weights)

            return HybridSimulator(cloth, h, integrator, predictor, corrections)

        return build

    def without_network(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
        simulator: Any = SurrogateSimulator(cloth, h, integrator, 1, weights=weights)
        simulator.surrogate = _NoNetwork()
        return simulator  # type: ignore[no-any-return]

    def newton(steps: int) -> Build:
        def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
            return HybridSimulator(cloth, h, integrator, None, steps)

        return build

    found: dict[str, Build] = {surrogate_label(n): surrogate(n) for n in passes}
    for corrections in HYBRID_CORRECTIONS:
        found[hybrid_label(passes, corrections)] = hybrid(corrections)
    return found | {
        ONE_NEWTON_STEP: newton(1),
        TWO_NEWTON_STEPS: newton(2),
        RELAXATION: line_sweeps(LINE_SWEEPS),
        EXTRAPOLATION: without_network,
    }


def line_sweeps(count: int) -> Build:
    """The surrogate's step without its network, with all else: the lowest point after every sweep."""

    def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
        # The start is settled once before the first pass.
        simulator: Any = SurrogateSimulator(cloth, h, integrator, count - 1, sweeps=1)
        simulator.surrogate.network = Silence()
        return simulator  # type: ignore[no-any-return]

    return build


def solver(cloth: Cloth, h: float, integrator: Integrator) -> ImplicitSimulator:
    """The converged one."""
    return ImplicitSimulator(cloth, h, integrator, CONVERGED)
