"""Stages of the training on a tiny data set: what they change, what they leave alone, and how they resume."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from torch import nn

from toile.capture.losses.simulation import LayerFrameStep, Stepped
from toile.capture.training.frames import Augmentation, TrainingSet
from toile.capture.training.weights import Networks
from toile.errors import InputError
from toile.learning.capture.adaptation import AdaptationSettings, AdaptationStage
from toile.learning.capture.physics_stage import PhysicsSettings, PhysicsStage
from toile.learning.capture.pose_stage import PoseSettings, PoseStage
from toile.learning.capture.stage import Stage
from toile.learning.capture.warm_stage import WarmSettings, WarmStage
from toile.learning.last_checkpoint import LastCheckpoint
from toile.learning.quiet import quiet_lightning

STILL = Augmentation(shift=0.0, scale=0.0, gain=0.0)


def fit(stage: Stage, *callbacks: Callback, checkpoint: Path | None = None) -> Stage:
    quiet_lightning()
    trainer = Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=1,
        logger=False,
        enable_checkpointing=any(isinstance(c, LastCheckpoint) for c in callbacks),
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=list(callbacks),
    )
    trainer.fit(stage, ckpt_path=checkpoint, weights_only=True)
    return stage


def state(network: nn.Module | None) -> dict[str, torch.Tensor]:
    assert network is not None
    return {name: value.clone() for name, value in network.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(value, second[name]) for name, value in first.items())


def test_landmarks_teach_pose_net_only(training_set: TrainingSet, networks: Networks) -> None:
    before = state(networks.sim_net)
    settings = PoseSettings(steps=25, batch=4, learning_rate=3e-3, augmentation=STILL)
    stage = fit(PoseStage(settings, networks, training_set, seed=0))
    first, last = (
        np.mean([row["landmarks"] for row in rows]) for rows in (stage.losses[:5], stage.losses[-5:])
    )
    assert last < 0.5 * first
    assert same(before, state(networks.sim_net))


def test_warm_start_begins_with_skinning_and_fits_the_outline(
    training_set: TrainingSet, networks: Networks
) -> None:
    before = state(networks.pose_net)
    stage = WarmStage(WarmSettings(steps=12, batch=4, augmentation=STILL), networks, training_set, seed=0)
    samples = [window[0] for window in training_set.draw(2, 1, np.random.default_rng(0))]
    batch = training_set.batch(samples)
    world, A, T = stage.deformed(batch, batch.images)
    angles, root = networks.pose_net(batch.images)
    skinned = stage.placed(batch, networks.deformation(angles, root)).garment
    assert not bool(A.any())
    assert not bool(T.any())
    assert torch.allclose(world.garment, skinned, atol=1e-6)
    fit(stage)
    assert stage.losses[-1]["silhouettes"] < 0.95 * stage.losses[0]["silhouettes"]
    assert same(before, state(networks.pose_net))
    # What was learned depends on the image.
    assert networks.sim_net is not None
    A, T = networks.sim_net(torch.stack((batch.images[0], torch.zeros_like(batch.images[0]))))
    assert not torch.allclose(T[0], T[1], atol=1e-4)


def gradients(stage: PhysicsStage) -> torch.Tensor:
    """Of the simulation term alone, by SimNet's last layer."""
    assert stage.sim_net is not None
    stage.on_fit_start()
    terms = stage.terms(0, np.random.default_rng(3))
    found = torch.autograd.grad(terms["simulation"], stage.sim_net.head.weight)[0]
    return found


def physics(networks: Networks, data: TrainingSet, **settings: Any) -> PhysicsStage:
    plain = {"steps": 1, "batch": 1, "substeps": 1, "window": 2, "simulation_every": 1, "augmentation": STILL}
    chosen = PhysicsSettings(**{**plain, **settings})
    return PhysicsStage(chosen, networks, data, seed=0)


def test_simulation_is_a_target_without_gradients(
    training_set: TrainingSet, networks: Networks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ṽ is V, 10 mm moved: with gradients through S nothing would be left of those of V."""

    def moved(self: LayerFrameStep, positions: torch.Tensor, velocities: torch.Tensor, *_: object) -> Stepped:
        return Stepped(positions + velocities * (1 / self.fps) + 0.01, True)

    monkeypatch.setattr(LayerFrameStep, "__call__", moved)
    # Ṽ = V + 0.01: cut, the gradient is that of a constant target; not cut, nothing is left of it.
    cut = gradients(physics(networks, training_set))
    through = gradients(physics(networks, training_set, through_layer=True))
    assert float(cut.abs().max()) > 0
    # Frame 0 stays a copy, so V¹ - V¹ is differentiated away and V⁰ does not enter.
    assert float(through.abs().max()) < 1e-3 * float(cut.abs().max())


def test_physics_takes_the_garment_out_of_the_body(training_set: TrainingSet, networks: Networks) -> None:
    stage = physics(networks, training_set, steps=8, silhouette_rays=True, potential_weight=0.0)
    fit(stage)
    assert stage.frames_simulated == 8
    # One step may go either way, by the last digits of a processor.
    assert stage.losses[-1]["simulation"] < 0.9 * stage.losses[0]["simulation"]


def test_the_potential_alone_lowers_the_energy_of_a_stretched_garment(
    training_set: TrainingSet, networks: Networks
) -> None:
    """Without a step of the layer; with a weight of 0 there is no such term."""
    stage = physics(
        networks,
        training_set,
        steps=12,
        learning_rate=3e-3,
        simulation_every=0,
        silhouette_weight=0.0,
        potential_weight=10.0,
    )
    assert stage.sim_net is not None
    with torch.no_grad():
        # Stretched and turned at random.
        stage.sim_net.head.bias.normal_(std=0.3, generator=torch.Generator().manual_seed(0))
    fit(stage)
    assert stage.frames_simulated == 0
    assert "simulation" not in stage.losses[0]
    assert np.mean([row["potential"] for row in stage.losses[-3:]]) < 0.7 * stage.losses[0]["potential"]
    assert "potential" not in physics(networks, training_set, potential_weight=0.0).terms(
        0, np.random.default_rng(0)
    )


@pytest.mark.parametrize(("window", "expected"), [(2, 1), (4, 3)])
def test_windows_have_as_many_targets(
    training_set: TrainingSet, networks: Networks, window: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def counted(self: LayerFrameStep, positions: torch.Tensor, *_: Any) -> Stepped:
        assert len(self.silhouettes) == window
        seen.append(_[-1])
        return Stepped(positions, True)

    monkeypatch.setattr(LayerFrameStep, "__call__", counted)
    physics(networks, training_set, window=window).terms(0, np.random.default_rng(0))
    assert seen == list(range(1, expected + 1))


def test_windows_in_processes_have_the_digits_of_the_loop(
    training_set: TrainingSet, networks: Networks
) -> None:
    stage = physics(networks, training_set, batch=2, replays=0)
    found = []
    for workers in (1, 2):
        stage.share(workers)
        found.append(float(stage.terms(0, np.random.default_rng(0))["simulation"].detach()))
        stage.teardown("fit")
    assert found[0] == found[1] > 0.0


def test_gradients_through_the_layer_stay_in_one_process(
    training_set: TrainingSet, networks: Networks
) -> None:
    stage = physics(networks, training_set, through_layer=True)
    stage.share(1)
    with pytest.raises(InputError, match="stay within one process"):
        stage.share(2)


def test_adaptation_changes_both_by_one_camera(training_set: TrainingSet, networks: Networks) -> None:
    pose, sim = state(networks.pose_net), state(networks.sim_net)
    settings = AdaptationSettings(steps=2, substeps=1, simulation_every=2, learning_rate=1e-3)
    stage = fit(AdaptationStage(settings, networks, training_set.only(1), seed=0))
    assert "simulation" in stage.losses[0]
    assert "simulation" not in stage.losses[1]
    assert not same(pose, state(networks.pose_net))
    assert not same(sim, state(networks.sim_net))


def test_what_moves_the_garment_does_not_pose_the_person(
    training_set: TrainingSet, networks: Networks
) -> None:
    """A folded person has less energy in the skirt: with those gradients joints ended a metre off."""
    settings = AdaptationSettings(steps=1, substeps=1, simulation_every=1, window=3, replays=1)
    stage = AdaptationStage(settings, networks, training_set.only(1), seed=0)
    rng = np.random.default_rng(0)
    stage.terms(0, rng)  # what is replayed next
    terms = stage.terms(1, rng)
    weights = list(networks.pose_net.parameters())

    def found(names: set[str]) -> float:
        loss = torch.stack([terms[name] for name in names]).sum()
        grads = torch.autograd.grad(loss, weights, retain_graph=True, allow_unused=True)
        return sum(float(g.abs().sum()) for g in grads if g is not None)

    assert found({"landmarks"}) > 0.0
    assert found(set(terms) - {"landmarks"}) == 0.0


class _Stops(Callback):
    """As if the machine had failed within a step."""

    def __init__(self, step: int) -> None:
        self.step = step

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        if batch_idx == self.step:
            raise RuntimeError("stopped")


def test_interrupted_training_ends_with_the_same_bits(
    set_folder: Path, training_set: TrainingSet, networks: Networks, tmp_path: Path
) -> None:
    settings = PoseSettings(steps=6, batch=3)

    def stage() -> PoseStage:
        new = Networks.new(training_set.subject, training_set.garment, networks.settings, seed=1)
        return PoseStage(settings, new, training_set, seed=1)

    whole = fit(stage())
    keep = LastCheckpoint(tmp_path, every=2, save_on_exception=False)
    with pytest.raises(RuntimeError, match="stopped"):
        fit(stage(), keep, _Stops(5))
    resumed = fit(stage(), checkpoint=keep.path)
    assert [row["step"] for row in resumed.losses] == [0, 1, 2, 3, 4, 5]
    assert resumed.losses == whole.losses
    assert same(state(whole.pose_net), state(resumed.pose_net))
    other = fit(PoseStage(settings, stage().networks, training_set, seed=2))
    assert not same(state(whole.pose_net), state(other.pose_net))


def test_networks_of_another_garment_are_refused(training_set: TrainingSet, networks: Networks) -> None:
    garment = replace(training_set.garment, rest_vertices=1.1 * training_set.garment.rest_vertices)
    other = TrainingSet(training_set.subject, garment, training_set.clips)
    with pytest.raises(InputError, match="another garment"):
        PoseStage(PoseSettings(), networks, other, seed=0)
    with pytest.raises(InputError, match="no SimNet"):
        WarmStage(WarmSettings(), replace(networks, sim_net=None), training_set, seed=0)
