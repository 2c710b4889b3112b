"""What is compared with the converged solver: the surrogate, and what one gets without it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import Tensor

from toile.cloth.cloth import Cloth
from toile.simulators.hybrid.simulator import HybridSimulator
from toile.simulators.implicit.integrators import Integrator
from toile.simulators.implicit.newton import NewtonSettings
from toile.simulators.implicit.simulator import ImplicitSimulator
from toile.simulators.linearizable import LinearizableSimulator
from toile.simulators.surrogate.problem import StepProblem
from toile.simulators.surrogate.simulator import SurrogateSimulator

Build = Callable[[Cloth, float, Integrator], LinearizableSimulator]

CONVERGED = NewtonSettings(tolerance=1e-6, max_iterations=200, max_halvings=12)
EXTRAPOLATION = "extrapolation"
RELAXATION = "extrapolation, lines relaxed"
ONE_NEWTON_STEP = "one Newton step"
SOLVER = "solver"
FLOOR = "solver, start moved by 1e-4 edges"
HYBRID_CORRECTIONS = (1, 2)


class _NoNetwork:
    """Stands in for the network: the best start as it is."""

    def solve(self, problem: StepProblem, n_passes: int) -> tuple[Tensor, Tensor]:
        start = problem.best_start()
        return start, problem.residual(start)


def surrogate_label(passes: int) -> str:
    """Name of the surrogate with a number of passes."""
    return f"surrogate, {passes} pass" + ("es" if passes > 1 else "")


def usual(passes: list[int]) -> int:
    """The number of passes that stands for the surrogate where one is enough."""
    return passes[len(passes) // 2]


def hybrid_label(passes: list[int], corrections: int) -> str:
    """Name of the hybrid: the surrogate's usual passes, then Newton corrections."""
    return f"{surrogate_label(usual(passes))}, then {corrections} Newton step" + (
        "s" if corrections > 1 else ""
    )


def contenders(weights: Path | None, passes: list[int]) -> dict[str, Build]:
    """All of them, by name."""

    def surrogate(n: int) -> Build:
        return lambda cloth, h, integrator: SurrogateSimulator(cloth, h, integrator, n, weights)

    def hybrid(corrections: int) -> Build:
        def build(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
            def predictor(its_cloth: Cloth, step: float) -> LinearizableSimulator:
                return SurrogateSimulator(its_cloth, step, integrator, usual(passes), weights)

            return HybridSimulator(cloth, h, integrator, predictor, corrections)

        return build

    def without_network(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
        simulator: Any = SurrogateSimulator(cloth, h, integrator, 1, weights)
        simulator.surrogate = _NoNetwork()
        return simulator  # type: ignore[no-any-return]

    def without_passes(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
        simulator = SurrogateSimulator(cloth, h, integrator, 1, weights)
        simulator.passes = 0
        return simulator

    def one_step(cloth: Cloth, h: float, integrator: Integrator) -> LinearizableSimulator:
        return ImplicitSimulator(cloth, h, integrator, NewtonSettings(CONVERGED.tolerance, max_iterations=1))

    found: dict[str, Build] = {surrogate_label(n): surrogate(n) for n in passes}
    for corrections in HYBRID_CORRECTIONS:
        found[hybrid_label(passes, corrections)] = hybrid(corrections)
    return found | {ONE_NEWTON_STEP: one_step, RELAXATION: without_passes, EXTRAPOLATION: without_network}


def solver(cloth: Cloth, h: float, integrator: Integrator) -> ImplicitSimulator:
    """The converged one."""
    return ImplicitSimulator(cloth, h, integrator, CONVERGED)
