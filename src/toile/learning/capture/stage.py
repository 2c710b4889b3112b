"""What the stages of the training have in common (Li et al. 2021, section 3.3)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from toile.capture.deformation.deform import Deformed
from toile.capture.deformation.translation import along_world, global_translation
from toile.capture.training.frames import Augmentation, Batch, TrainingSet
from toile.capture.training.weights import Networks
from toile.limits import Count, Fraction, NonNegative, Positive, Seed

STATE = "toile_capture"
"""Key in Lightning's checkpoint."""

S = TypeVar("S", bound="StageSettings")


@dataclass(frozen=True, kw_only=True)
class StageSettings:
    """What every stage has. Numbers are ours, the paper gives none.

    Attributes:
        steps: of the optimiser.
        batch: windows per step; a window is one frame where nothing is simulated.
        learning_rate: largest, of AdamW.
        warm_up: steps over which it rises; falls along a cosine afterwards.
        decay: of the weights.
        gradient_norm: longer gradients are shortened.
        augmentation: of the images.
    """

    steps: Count
    batch: Count = 8
    learning_rate: Positive = 1e-3
    warm_up: NonNegative = 10
    decay: NonNegative = 1e-4
    gradient_norm: Positive = 1.0
    augmentation: Augmentation = field(default_factory=Augmentation)
    final_rate: Fraction = 0.02

    def rate(self, step: int) -> float:
        """Learning rate of a step as a multiple of the largest one."""
        if step < self.warm_up:
            return (step + 1) / (self.warm_up + 1)
        share = min((step - self.warm_up) / max(self.steps - self.warm_up, 1), 1.0)
        return self.final_rate + (1 - self.final_rate) * 0.5 * (1 + math.cos(math.pi * share))


class Stage(LightningModule):
    """Trains one of the networks; the frames of a step follow from the seed and the step's number alone.

    So a run that was interrupted continues with the bits that it would have had.

    Args:
        settings: see StageSettings.
        networks: what is trained, and what stays as it is.
        data: what it is trained on.
        seed: of the frames.

    Attributes:
        networks: see above.
        losses: terms of the loss at every step.
        last: frames of the last step and what was made of them, for pictures; None before.
    """

    NAME: ClassVar[str]
    NUMBER: ClassVar[int]
    """Tells the stages' random numbers apart."""

    def __init__(self, settings: StageSettings, networks: Networks, data: TrainingSet, seed: Seed) -> None:
        super().__init__()
        networks.check_belongs(data.subject, data.garment, "data set")
        self.settings = settings
        self.networks = networks
        self.data = data
        self.seed = seed
        # Known to Lightning by names that do not depend on which of them is trained.
        self.pose_net = networks.pose_net
        self.sim_net = networks.sim_net
        self.losses: list[dict[str, float]] = []
        self.last: tuple[Batch, Deformed] | None = None

    @property
    @abstractmethod
    def trained(self) -> Sequence[nn.Module]:
        """Networks that this stage changes."""

    @abstractmethod
    def terms(self, step: int, rng: np.random.Generator) -> Mapping[str, Tensor]:
        """Terms of the loss, with their weights.

        Args:
            step: its number.
            rng: the step's random numbers.
        """

    def on_fit_start(self) -> None:
        """Only what is trained has gradients."""
        chosen = {id(p) for network in self.trained for p in network.parameters()}
        for parameter in self.parameters():
            parameter.requires_grad_(id(parameter) in chosen)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """AdamW, and the learning rate of every step."""
        settings = self.settings
        parameters = [p for network in self.trained for p in network.parameters()]
        optimizer = torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=settings.decay)
        scheduler = LambdaLR(optimizer, settings.rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def train_dataloader(self) -> StepNumbers:
        """The steps."""
        return StepNumbers(self.settings.steps)

    def training_step(self, batch: int, batch_idx: int) -> Tensor:
        """One step of the optimiser."""
        step = self.global_step
        terms = self.terms(step, np.random.default_rng([self.seed, self.NUMBER, step]))
        total = torch.stack([term.reshape(()) for term in terms.values()]).sum()
        numbers = {name: float(term.detach()) for name, term in terms.items()}
        self.losses.append({"step": float(step), "loss": float(total.detach()), **numbers})
        if self._trainer is not None and self.trainer.logger is not None:
            self.log_dict({f"{self.NAME}/{name}": value for name, value in self.losses[-1].items()})
        return total

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Shorten a gradient that is too long; one that is not finite leaves the step out."""
        parameters = [p for network in self.trained for p in network.parameters()]
        norm = float(torch.nn.utils.clip_grad_norm_(parameters, self.settings.gradient_norm))
        if not math.isfinite(norm):
            optimizer.zero_grad()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what Lightning does not know of."""
        checkpoint[STATE] = {"losses": [dict(row) for row in self.losses]}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Inverse of on_save_checkpoint."""
        self.losses = [dict(row) for row in checkpoint[STATE]["losses"]]

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return len(self.losses) >= self.settings.steps

    def images_of(self, batch: Batch, rng: np.random.Generator) -> Tensor:
        """The batch's images as the networks get them in training."""
        return self.settings.augmentation(batch.images.to(self.device), rng)

    def placed(self, batch: Batch, local: Deformed) -> Deformed:
        """What f gave, in the world, where the landmarks of all cameras that watch put the person.

        Args:
            batch: of the frames.
            local: in the cameras' axes, root-relative.
        """
        cameras = self.data.clips[0].cameras
        seen = [cameras[sample.camera] for sample in batch.samples]

        def turned(points: Tensor) -> Tensor:
            return torch.stack([along_world(c, x) for c, x in zip(seen, points, strict=True)])

        world = local.map(turned)
        place = global_translation(world.landmarks, self.data.cameras, batch.detections, batch.confidences)
        moved = world.map(lambda x: x + place[:, None])
        self.last = batch, moved
        return moved


class StepNumbers:
    """The numbers of the steps: Lightning's loop wants something to go through.

    Args:
        steps: how many.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps

    def __len__(self) -> int:
        return self._steps

    def __iter__(self) -> Iterator[int]:
        return iter(range(self._steps))

    def state_dict(self) -> dict[str, Any]:
        """Nothing: a step follows from its number, which Lightning stores."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of state_dict."""
