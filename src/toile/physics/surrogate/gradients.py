"""Two derivatives of the surrogate's step, as interchangeable objects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, final

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from toile.physics.surrogate.differentiable import DifferentiableStepProblem
from toile.physics.surrogate.problem import StepProblem
from toile.physics.surrogate.surrogate import Surrogate


class StepGradient(ABC):
    """How positions that the surrogate has found depend on what it was asked."""

    @abstractmethod
    def positions(
        self,
        of_minimum: Callable[[], Tensor],
        of_computation: Callable[[], Tensor],
    ) -> Tensor:
        """The positions (B, N, 3) [m] with one of the two derivatives.

        Args:
            of_minimum: the positions with the derivative of the minimum that they come close to.
            of_computation: the positions with the derivative of how they were computed.
        """


@final
class ImplicitFunction(StepGradient):
    """Of the minimum: the implicit function theorem at the positions that were found.

    One Hessian and one factorisation per step. As exact as the positions are.
    """

    def positions(self, of_minimum: Callable[[], Tensor], of_computation: Callable[[], Tensor]) -> Tensor:
        """See StepGradient."""
        return of_minimum()


@final
class Backpropagation(StepGradient):
    """Of the computation: through every pass of the network and every line relaxation.

    What the paper does (section 3.3). Exact for the motion that was computed, however far that is from the
    solver's. Gradients with respect to masses and time step remain those of the minimum.
    """

    def positions(self, of_minimum: Callable[[], Tensor], of_computation: Callable[[], Tensor]) -> Tensor:
        """See StepGradient."""
        return of_computation()


class UnrolledStep(torch.autograd.Function):
    """Positions that the surrogate has found, with the derivative of how it found them.

    The backward pass computes the step once more, with a graph: memory does not grow with the steps.
    """

    @staticmethod
    def forward(
        ctx: Any,
        surrogate: Surrogate,
        passes: int,
        sweeps: int,
        problem: StepProblem,
        found: Tensor,
        starts: Tensor,
        prediction: Tensor,
        forces: Tensor,
        stiffness: Tensor,
    ) -> Tensor:
        """The positions as they are.

        Args:
            ctx: of autograd.
            surrogate: which found them.
            passes: of its network.
            sweeps: relaxations of the lines after each pass.
            problem: masses, free vertices and rest lengths are taken from it.
            found: (B, H, W, 3).
            starts: of the problem, as are the others; these have gradients.
            prediction: see StepProblem.
            forces: see StepProblem.
            stiffness: see StepProblem.
        """
        ctx.surrogate, ctx.passes, ctx.sweeps, ctx.problem = surrogate, passes, sweeps, problem
        ctx.save_for_backward(starts, prediction, forces, stiffness)
        return found.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        """Back through the step, computed again."""
        asked = [t.detach().requires_grad_() for t in ctx.saved_tensors]
        starts, prediction, forces, stiffness = asked
        given: StepProblem = ctx.problem
        with torch.enable_grad():
            problem = DifferentiableStepProblem(
                prediction=prediction,
                starts=starts,
                forces=forces,
                stiffness=stiffness,
                masses=given.masses,
                free=given.free,
                rest_lengths_i=given.rest_lengths_i,
                rest_lengths_j=given.rest_lengths_j,
            )
            found, _ = ctx.surrogate.unrolled(problem, ctx.passes, ctx.sweeps)
        return (None, None, None, None, None, *torch.autograd.grad(found, asked, gradients[0]))
