"""Effects of a fit: which of their coefficients are found, and in what bounds."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from torch import Tensor, nn

from toile.effects.base import (
    BoundaryEffect,
    Effect,
    ElementEffect,
    ForceEffect,
    MassEffect,
    TimeEffect,
    VertexEffect,
)
from toile.effects.catalogue import CATALOGUE
from toile.errors import InputError

MOTION = (VertexEffect, ElementEffect, ForceEffect, MassEffect, BoundaryEffect, TimeEffect)
"""Kinds of effects that a fit takes: those that act between forces and positions."""

STEP_TERMS = (VertexEffect, ElementEffect)


class FitEffects(nn.Module):
    """Effects that act in a fit, as a module whose state is the k coefficients that the fit may change.

    Args:
        effects: with the coefficients that the fit starts from.
        fixed: names of effects whose coefficients stay as they are.

    Attributes:
        names: (k) "air_drag linear [1/s]".
        values: (k,) in the parameters' units; None if nothing is fitted.
        start: (k,) where the fit begins.
        scales: (k,) prior standard deviations around ``start``.
        low, high: (k,) bounds.
        in_step_terms: (k,) whether a coefficient belongs to a term of the step.
        change_inertia: whether masses or the time step depend on any of them.

    Raises:
        InputError: an effect of the image, or a fixed effect that is none of the fit's.
    """

    values: nn.Parameter | None

    def __init__(self, effects: Sequence[Effect] = (), fixed: Collection[str] = ()) -> None:
        super().__init__()
        self._effects = tuple(effects)
        self._check(fixed)
        free = [effect for effect in self._effects if effect.NAME not in fixed]
        self._free = frozenset(effect.NAME for effect in free)
        parameters = [(effect, p) for effect in free for p in effect.parameters]
        self.names = tuple(_label(effect, p.name, p.unit) for effect, p in parameters)
        self.start, self.scales, self.low, self.high = (
            torch.tensor(values, dtype=torch.float64)
            for values in (
                [v for effect in free for v in effect.values.tolist()],
                [p.scale for _, p in parameters],
                [p.low for _, p in parameters],
                [p.high for _, p in parameters],
            )
        )
        self.register_parameter("values", nn.Parameter(self.start.clone()) if self.names else None)
        term = [isinstance(effect, STEP_TERMS) for effect, _ in parameters]
        self.in_step_terms = torch.tensor(term, dtype=torch.bool)
        self.change_inertia = any(isinstance(effect, MassEffect | TimeEffect) for effect in free)

    def __len__(self) -> int:
        """Number of effects, fitted or not."""
        return len(self._effects)

    def current(self) -> Tensor:
        """The coefficients that are fitted, as they are now, (k,), without gradients."""
        return torch.zeros(0, dtype=torch.float64) if self.values is None else self.values.detach()

    def acting(self, values: Tensor | None = None, *, as_leaves: bool = False) -> tuple[Effect, ...]:
        """All effects, in the given order.

        Args:
            values: coefficients (k,) that are fitted; None takes ``values``, with gradients where those are
                enabled.
            as_leaves: let the coefficients of every fitted effect be a tensor of its own that requires
                gradients, as LinearizedRollout wants them.
        """
        if values is None:
            values = self.current() if self.values is None or not torch.is_grad_enabled() else self.values
        found: list[Effect] = []
        first = 0
        for effect in self._effects:
            if effect.NAME not in self._free:
                found.append(effect)
                continue
            own = values[first : first + len(effect.parameters)]
            first += len(own)
            found.append(effect.with_values(own.detach().clone().requires_grad_() if as_leaves else own))
        return tuple(found)

    def coefficients(self) -> dict[str, float]:
        """Coefficients of all effects by name and unit, fitted or not."""
        with torch.no_grad():
            return {
                _label(effect, p.name, p.unit): float(v)
                for effect in self.acting()
                for p, v in zip(effect.parameters, effect.values, strict=True)
            }

    def _check(self, fixed: Collection[str]) -> None:
        others = [effect.NAME for effect in self._effects if not isinstance(effect, MOTION)]
        if others:
            raise InputError(
                "A fit takes effects on the motion, none on the image",
                where=f"effect={','.join(others)}",
                expected=", ".join(name for name, kind in CATALOGUE.items() if issubclass(kind, MOTION)),
                got=", ".join(others),
            )
        names = [effect.NAME for effect in self._effects]
        unknown = [name for name in fixed if name not in names]
        if unknown:
            raise InputError(
                "What is to stay fixed is no effect of the fit",
                where="fixed_effects",
                expected=f"some of {', '.join(names)}" if names else "none, as there are no effects",
                got=", ".join(unknown),
            )
        if len(set(names)) < len(names):
            raise InputError(
                "An effect acts twice", where="effect", expected="each once", got=", ".join(names)
            )


def _label(effect: Effect, name: str, unit: str) -> str:
    return f"{effect.NAME} {name} [{unit}]"
