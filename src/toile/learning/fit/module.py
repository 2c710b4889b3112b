"""A fit as a Lightning module: one training step is one cycle of a recipe."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from typing import Any

import torch
from lightning import LightningDataModule, LightningModule
from torch import Tensor

from toile.errors import InputError
from toile.reconstruction.effects import FitEffects
from toile.reconstruction.parameters import ClothParameters
from toile.reconstruction.problem import Reconstruction
from toile.reconstruction.recipe import CycleReport, Recipe

STATE = "toile_fit"
"""Key in Lightning's checkpoint."""
PER_FRAME = "loss per frame"
"""Column of the history: the loss over the number of frames that it is a sum over."""
PROCESSOR_SECONDS = "processor seconds"
"""Column of the history: processor time of a cycle, which other programs on the machine do not lengthen."""
_COUNTS = "_iterations"  # a recipe's numbers that are work, not losses, end like this


class FitModule(LightningModule):
    """Runs a recipe cycle by cycle; Lightning brings the loop, checkpoints and loggers.

    The recipe changes the parameters itself: optimisation is manual, and Lightning sees no optimiser. A cycle
    of Gauss-Newton solves a window of its own choice, and takes a step only if the objective falls. Adam's is
    no loss, backward and step either: where the simulation fails, the previous update is halved until it
    succeeds; the pinned vertices' motion and the effects are optimised in other variables than the
    parameters', which get their gradients from theirs; and back-propagation goes through the renderer in
    parts, and through time from there. Recipes also run without Lightning, in the diagnosis.

    A checkpoint always holds the state after a complete cycle, also one that is written in the middle of the
    next because of an exception; a fit resumed from it is bit-identical to one that was never interrupted.

    Args:
        reconstruction: the problem; its parameters become the module's.
        recipe: how to solve it.
        seed: of the random numbers, kept with the checkpoint.

    Attributes:
        cycles_done: number of complete cycles.
        history: one row of plain numbers per cycle, see ``row``.
        report: of the last cycle, None before the first.
    """

    def __init__(self, reconstruction: Reconstruction, recipe: Recipe, seed: int) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.reconstruction = reconstruction
        self.cloth_parameters = reconstruction.parameters
        self.effects = reconstruction.effects
        self.recipe = recipe
        self.seed = seed
        self.n_cycles = recipe.n_cycles(reconstruction)
        self.cycles_done = 0
        self.history: list[dict[str, float]] = []
        self.report: CycleReport | None = None
        self._complete: dict[str, Any] = {}

    def setup(self, stage: str) -> None:
        """Seed, and prepare the recipe for the scene; Lightning restores a checkpoint afterwards."""
        torch.manual_seed(self.seed)
        self.recipe.start(self.reconstruction)
        self._complete = self._snapshot()

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """None that Lightning should know of."""
        return []

    def training_step(self, batch: int, batch_idx: int) -> None:
        """Run the next cycle."""
        started, processor = time.perf_counter(), time.process_time()
        report = self.recipe.cycle(self.reconstruction, self.cycles_done)
        seconds, processor = time.perf_counter() - started, time.process_time() - processor
        self.history.append(row(self.cycles_done, self.cloth_parameters, report, seconds, self.effects))
        self.history[-1][PROCESSOR_SECONDS] = processor
        self.report = report
        self.cycles_done += 1
        self._complete = self._snapshot()
        last = self.history[-1]
        self.log_dict({scalar_tag(name): value for name, value in last.items() if name != "cycle"})
        self.log("step", last["cycle"])

    def roll_back(self) -> None:
        """Undo what an interrupted cycle may have changed."""
        if self._complete:
            self.load_state_dict(self._complete["parameters"])
            self.cycles_done = self._complete["cycles_done"]
            del self.history[self.cycles_done :]

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the state after the last complete cycle: plain tensors, numbers, lists and dictionaries."""
        checkpoint["state_dict"] = self._complete["parameters"]
        checkpoint[STATE] = {
            "recipe": self._complete["recipe"],
            "cycles_done": self._complete["cycles_done"],
            "history": [dict(r) for r in self.history[: self._complete["cycles_done"]]],
            "seed": self.seed,
            "random_state": self._complete["random_state"],
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Inverse of on_save_checkpoint; Lightning restores the parameters.

        Raises:
            InputError: the checkpoint is that of another fit.
        """
        try:
            state = checkpoint[STATE]
            self.cycles_done = int(state["cycles_done"])
            self.history = [dict(r) for r in state["history"]]
            self.seed = int(state["seed"])
            torch.set_rng_state(state["random_state"])
            self.load_state_dict(checkpoint["state_dict"])
            self.recipe.load_state_dict(copy.deepcopy(state["recipe"]))
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise InputError(
                "The checkpoint does not fit this run",
                where="checkpoints/last.ckpt",
                expected=f"one with {self.n_cycles} cycles of {type(self.recipe).__name__}",
                got=f"{type(error).__name__}: {str(error).splitlines()[0]}",
            ) from error
        self._complete = self._snapshot()

    def _snapshot(self) -> dict[str, Any]:
        return {
            "parameters": {name: t.detach().clone() for name, t in self.state_dict().items()},
            "recipe": copy.deepcopy(self.recipe.state_dict()),
            "cycles_done": self.cycles_done,
            "random_state": torch.get_rng_state(),
        }


class CyclesOfFit(LightningDataModule):
    """The cycle indices of a fit: Lightning runs one training step for each.

    The recipe chooses the frames of a cycle. A DataLoader would warn about missing worker processes;
    Lightning takes any iterable with a length.

    Args:
        module: tells how many cycles are done already when the loop starts.
    """

    def __init__(self, module: FitModule) -> None:
        super().__init__()
        self._module = module

    def train_dataloader(self) -> CyclesOfFit:
        """All cycles, in one epoch."""
        return self

    def __len__(self) -> int:
        return self._module.n_cycles

    def __iter__(self) -> Iterator[int]:
        return iter(range(self._module.cycles_done, self._module.n_cycles))


def scalar_tag(column: str) -> str:
    """Tag of a column of the history: its name without what TensorBoard does not allow in tags."""
    name = column.replace("²", "2").replace(" [", "_").replace("]", "").replace(" ", "_").replace("/s", "_s")
    return f"fit/{name}"


def row(
    index: int,
    parameters: ClothParameters,
    report: CycleReport,
    seconds: float,
    effects: FitEffects | None = None,
) -> dict[str, float]:
    """One row of the history: names with units, plain numbers.

    Args:
        index: of the cycle.
        parameters: after the cycle.
        report: of the cycle; its losses are those that the cycle saw.
        seconds: duration of the cycle.
        effects: after the cycle.
    """
    result: dict[str, float] = {"cycle": index}
    terms = {name: float(value) for name, value in report.losses.items() if not name.endswith(_COUNTS)}
    # A recipe that minimises something else than the sum of its terms says so.
    result["loss"] = terms.pop("objective") if "objective" in terms else sum(terms.values())
    # Windows grow while more frames are covered; a sum over them would look like divergence.
    result[PER_FRAME] = result["loss"] / report.frames_in_loss
    for name, value in terms.items():
        result[f"loss {name}"] = value
    for name in ClothParameters.STIFFNESSES:
        result[f"{name} [network units]"] = parameters.get_parameter(name).item()
    for axis, wind in zip("xyz", parameters.wind.tolist(), strict=True):
        result[f"wind {axis} [m/s²]"] = wind
    if effects is not None:
        result.update(zip(effects.names, effects.current().tolist(), strict=True))
    result["turbulence rms [m/s²]"] = _rms(parameters.turbulence[: report.n_frames - 1])
    result["boundary motion rms [mm]"] = 1e3 * _rms(parameters.boundary_motion[: report.n_frames])
    result["frames"] = report.n_frames
    for name, value in report.losses.items():
        if name.endswith(_COUNTS):
            result[name.replace("_", " ")] = float(value)
    result["seconds"] = seconds
    return result


def _rms(vectors: Tensor) -> float:
    """Root mean square length of vectors (..., 3)."""
    if vectors.numel() == 0:
        return 0.0
    return float(vectors.detach().square().sum(-1).mean().sqrt())
