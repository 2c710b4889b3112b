"""The paper's recipe (section 3.3.2): Adam through the whole simulation, over successively more frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, final

import torch
from torch import Tensor

from toile.errors import InputError
from toile.limits import Count, NonNegative, Positive, TwoOrMore, Unit
from toile.physics.rollout import Rollout
from toile.physics.simulator import SimulationError
from toile.reconstruction.losses.base import VideoLoss
from toile.reconstruction.losses.force_regularization import ForceRegularization
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.recipe import CycleReport, Recipe

_EPSILON = 1e-8  # of Adam, in network units
_MAX_HALVINGS = 5  # of an update after which the simulation fails

Loss = VideoLoss | ForceRegularization


@final
class SuccessiveFramesAdam(Recipe):
    """One Adam step per cycle on the loss of the first frames, whose number grows with the cycles.

    Gradients come from back-propagation through the renderer and through time. One optimiser holds a named
    group per kind of parameter. Adam's steps have the length of the learning rate whatever the size of the
    gradient, so the units of the learning rates matter:

    | group | unit of the learning rate | paper |
    |---|---|---|
    | stretching, shearing, bending | network units | 50, 0.1, 0.01 |
    | wind | magnitude of gravity | 0.05 |
    | turbulence | network units of force, m L / Δt² | 0.001 |
    | boundary_motion | grid spacings per frame | 0.001 |
    | texture_offset | texture coordinates | 0.0002 |
    | effects | each coefficient's scale | not there |

    The paper moves the pinned vertices by the turbulence stored at them, read as their velocity. Here they
    have parameters of their own, and Adam acts on their motion from frame to frame: with the paper's learning
    rate that is the paper's motion, but the force regularisation does not touch it.

    Where the simulation fails after an update, the update is halved until it succeeds, and a note says so.

    Args:
        losses: terms by name, VideoLoss or ForceRegularization; None leaves a term out.
        learning_rates: by group, see above; a group that is absent or None stays as it is.
        minimum: lower bounds of stretching, shearing and bending [network units].
        cycles: number of cycles; 250 in the paper.
        first_frames: frames covered from the start, 10 in the paper; None for all.
        cycles_per_frame: cycles after which one more frame is covered, 5 in the paper.
        frames_per_render: frames rendered at once; bounds the memory, changes the result by rounding only.

    Raises:
        InputError: an unknown group or term, or a number out of range.
    """

    def __init__(
        self,
        losses: Mapping[str, Loss | None],
        learning_rates: Mapping[str, NonNegative | None],
        minimum: Mapping[str, Positive],
        cycles: Count,
        first_frames: Annotated[TwoOrMore, Unit("frames")] | None,
        cycles_per_frame: Count,
        frames_per_render: Count,
    ) -> None:
        self.losses = {name: loss for name, loss in losses.items() if loss is not None}
        self.learning_rates = {name: rate for name, rate in learning_rates.items() if rate is not None}
        self.minimum = dict(minimum)
        self.cycles = cycles
        self.first_frames = first_frames
        self.cycles_per_frame = cycles_per_frame
        self.frames_per_render = frames_per_render
        _known("learning_rates", self.learning_rates, (*ClothParameters.NAMES, "effects"))
        _known("minimum", self.minimum, ClothParameters.STIFFNESSES)
        for name, value, least in (
            ("cycles", cycles, 0),
            ("first_frames", 2 if first_frames is None else first_frames, 2),
            ("cycles_per_frame", cycles_per_frame, 1),
            ("frames_per_render", frames_per_render, 1),
        ):
            if value < least:
                raise _wrong(name, f"a whole number of at least {least}", value)
        if not any(isinstance(loss, VideoLoss) for loss in self.losses.values()):
            raise _wrong(
                "losses", "at least one term that looks at the video", ", ".join(self.losses) or "none"
            )
        self._variables: dict[str, Tensor] = {}
        self._optimizer: torch.optim.Adam | None = None
        self._before: dict[str, Tensor] = {}
        self._warm_start: Tensor | None = None

    def n_cycles(self, reconstruction: Reconstruction) -> int:
        """See Recipe."""
        return self.cycles

    def n_frames(self, index: int, total: int) -> int:
        """Frames covered in cycle ``index`` of a video of ``total`` frames."""
        if self.first_frames is None:
            return total
        return min(total, self.first_frames + index // self.cycles_per_frame)

    def start(self, reconstruction: Reconstruction) -> None:
        """See Recipe."""
        p = reconstruction.parameters
        self._before, self._warm_start = {}, None
        effects = reconstruction.effects
        of_cloth = [name for name in self.learning_rates if name != "effects"]
        self._variables = {name: p.get_parameter(name) for name in of_cloth}
        if "effects" in self.learning_rates and effects.values is not None:
            self._variables["effects"] = (effects.current() / effects.scales).requires_grad_()
        if "boundary_motion" in self._variables:
            motion = p.boundary_motion.detach().diff(dim=0)
            self._variables["boundary_motion"] = motion.requires_grad_()
        self._variables = {name: v for name, v in self._variables.items() if v.numel()}
        units = p.units
        acceleration = units.length / units.time**2
        # In SI units per unit of the learning rate, and per network unit.
        scales = {
            "wind": (float(reconstruction.gravity.norm()), acceleration),
            "turbulence": (acceleration, acceleration),
            "boundary_motion": (units.length, units.length),
        }
        groups = []
        for name, variable in self._variables.items():
            rate_unit, network_unit = scales.get(name, (1.0, 1.0))
            groups.append(
                {
                    "name": name,
                    "params": [variable],
                    "lr": self.learning_rates[name] * rate_unit,
                    # Adam is blind to the scale of the gradient but for epsilon.
                    "eps": _EPSILON / network_unit,
                }
            )
        self._optimizer = torch.optim.Adam(groups) if groups else None

    def cycle(self, reconstruction: Reconstruction, index: int) -> CycleReport:
        """See Recipe."""
        notes: list[str] = []
        p = reconstruction.parameters
        n = self.n_frames(index, reconstruction.scene.n_frames)
        p.zero_grad(set_to_none=True)
        reconstruction.effects.zero_grad(set_to_none=True)
        motion = self._simulate(reconstruction, n, notes)
        self._warm_start = motion.all_positions
        positions = motion.positions[0]
        losses, gradient = self._compare(reconstruction, positions.detach())
        if positions.requires_grad:
            positions.backward(gradient)
        losses.update(self._regularize(reconstruction, n))
        self._before = {name: v.detach().clone() for name, v in self._variables.items()}
        if self._optimizer is not None:
            self._update(reconstruction, notes)
        return CycleReport(losses, n, positions.detach(), tuple(notes))

    def substep_positions(self) -> Tensor | None:
        """See Recipe."""
        return self._warm_start

    def state_dict(self) -> dict[str, Any]:
        """See Recipe."""
        return {
            "optimizer": None if self._optimizer is None else self._optimizer.state_dict(),
            "variables": {name: v.detach() for name, v in self._variables.items()},
            "before": dict(self._before),
            "warm_start": self._warm_start,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See Recipe."""
        if self._optimizer is not None:
            self._optimizer.load_state_dict(state["optimizer"])
        with torch.no_grad():
            for name, variable in self._variables.items():
                variable.copy_(state["variables"][name])
        self._before = dict(state["before"])
        self._warm_start = state["warm_start"]

    def _simulate(self, reconstruction: Reconstruction, n_frames: int, notes: list[str]) -> Rollout:
        """Simulate, with the last update halved as often as it takes."""
        for halvings in range(_MAX_HALVINGS + 1):
            try:
                return reconstruction.simulate(n_frames, self._warm_start)
            except SimulationError as error:
                if not self._before:
                    raise
                with torch.no_grad():
                    for name, before in self._before.items():
                        if halvings < _MAX_HALVINGS - 1:
                            self._variables[name].lerp_(before, 0.5)
                        else:
                            self._variables[name].copy_(before)
                self._write(reconstruction)
                taken = "halved" if halvings < _MAX_HALVINGS - 1 else "taken back"
                notes.append(f"the last update was {taken}: {error}")
        return reconstruction.simulate(n_frames, self._warm_start)

    def _compare(self, reconstruction: Reconstruction, positions: Tensor) -> tuple[dict[str, float], Tensor]:
        """Terms that look at the video, and their gradient with respect to the positions (n, N, 3).

        Gradients with respect to the texture coordinates accumulate in the parameters.
        """
        scene, p = reconstruction.scene, reconstruction.parameters
        n = len(positions)
        terms = {name: loss for name, loss in self.losses.items() if isinstance(loss, VideoLoss)}
        totals = dict.fromkeys(terms, 0.0)
        gradients = []
        for part in torch.arange(n).split(self.frames_per_render):
            window = slice(int(part[0]), int(part[-1]) + 1)
            x = positions[window].clone().requires_grad_()
            uv = reconstruction.texture_coordinates + p.texture_offset
            rendered = reconstruction.renderer.render(
                x, reconstruction.faces, uv, scene.texture, scene.camera
            )
            masks = scene.masks[window]
            frames = scene.frames[window] * masks[..., None]
            values = {name: len(part) / n * term(rendered, frames, masks) for name, term in terms.items()}
            torch.stack(list(values.values())).sum().backward()
            gradients.append(torch.zeros_like(x) if x.grad is None else x.grad)
            for name, value in values.items():
                totals[name] += value.item()
        return totals, torch.cat(gradients)

    def _regularize(self, reconstruction: Reconstruction, n_frames: int) -> dict[str, float]:
        """Terms that look at the turbulent forces of the first frames; gradients go to the parameters."""
        p = reconstruction.parameters
        losses = {}
        for name, loss in self.losses.items():
            if isinstance(loss, ForceRegularization):
                fields = p.turbulence[: n_frames - 1].reshape(n_frames - 1, *reconstruction.scene.grid, 3)
                value = loss(fields * (p.units.time**2 / p.units.length))
                value.backward()
                losses[name] = value.item()
        return losses

    def _update(self, reconstruction: Reconstruction, notes: list[str]) -> None:
        """One step of Adam, then back to what is allowed."""
        assert self._optimizer is not None
        p = reconstruction.parameters
        motion = self._variables.get("boundary_motion")
        if motion is not None:
            # The motion between frames t and t + 1 moves every later frame.
            later = p.boundary_motion.grad
            motion.grad = None if later is None else later[1:].flip(0).cumsum(0).flip(0)
        effects = reconstruction.effects
        if "effects" in self._variables and effects.values is not None:
            slope = effects.values.grad
            self._variables["effects"].grad = None if slope is None else slope * effects.scales
        bad = [
            n for n, v in self._variables.items() if v.grad is not None and not bool(v.grad.isfinite().all())
        ]
        if bad:
            notes.append(f"no update: the gradient of {', '.join(bad)} is not finite")
            return
        self._optimizer.step()
        with torch.no_grad():
            for name, least in self.minimum.items():
                p.get_parameter(name).clamp_(min=least)
            down = reconstruction.gravity / reconstruction.gravity.norm().clamp(min=1e-12)
            p.wind.sub_((p.wind @ down) * down)
            if "effects" in self._variables:
                bounds = effects.low / effects.scales, effects.high / effects.scales
                self._variables["effects"].clamp_(*bounds)
        self._write(reconstruction)

    def _write(self, reconstruction: Reconstruction) -> None:
        """Give the parameters those variables that are others than theirs."""
        effects = reconstruction.effects
        if "effects" in self._variables and effects.values is not None:
            with torch.no_grad():
                effects.values.copy_(
                    (self._variables["effects"] * effects.scales).clamp(effects.low, effects.high)
                )
        motion = self._variables.get("boundary_motion")
        if motion is not None:
            with torch.no_grad():
                moved = reconstruction.parameters.boundary_motion
                moved[1:] = moved[0] + motion.cumsum(0)


def _known(where: str, given: Mapping[str, object], names: tuple[str, ...]) -> None:
    unknown = [name for name in given if name not in names]
    if unknown:
        raise _wrong(where, f"some of {', '.join(names)}", ", ".join(unknown))


def _wrong(where: str, expected: str, got: object) -> InputError:
    return InputError("The fit cannot be set up", where=where, expected=expected, got=str(got))
