"""PoseNet, SimNet, their backbone, and predictions on disk."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from toile.capture.body.limits import rotation_of_angles
from toile.capture.body.subject import load_subject
from toile.capture.deformation.deform import driven_joints
from toile.capture.networks.backbone import BackboneSettings, ResNet
from toile.capture.networks.pose_net import PoseNet
from toile.capture.networks.sim_net import SimNet
from toile.capture.prediction import Prediction
from toile.errors import InputError
from toile.geometry.camera import Camera

SMALL = BackboneSettings(width=0.125, side=32, grid=1)


@pytest.fixture(scope="module")
def limits() -> torch.Tensor:
    subject = load_subject()
    return subject.joint_limits[driven_joints(subject)]


@pytest.mark.parametrize(
    ("depth", "width", "side", "grid", "parameters"),
    # Of the convolutions alone He et al. have 4.9, 11.2 and 23.5 million.
    [(10, 1.0, 64, 2, 4.9e6), (18, 1.0, 128, 4, 11.2e6), (50, 1.0, 256, 8, 23.5e6)],
)
def test_sizes_of_the_backbones(depth, width, side, grid, parameters) -> None:
    """Shapes only, nothing is computed: also those of the preset paper."""
    with torch.device("meta"):
        network = ResNet(BackboneSettings(depth=depth, width=width, side=side, grid=grid))
        features = network(torch.empty(2, 4, side, side))
    assert features.shape == (2, network.n_features)
    assert sum(p.numel() for p in network.parameters()) == pytest.approx(parameters, rel=0.03)


def test_what_does_not_fit_the_backbone_is_refused() -> None:
    with pytest.raises(InputError, match="too small"):
        BackboneSettings(side=64, grid=4)
    with pytest.raises(InputError, match="No such backbone"):
        BackboneSettings(depth=34)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="do not fit the network"):
        ResNet(SMALL)(torch.zeros(1, 3, 32, 32))


def test_a_batch_is_each_image_alone() -> None:
    """No statistics over the batch: frames of one clip may go through together."""
    torch.manual_seed(0)
    network = ResNet(SMALL)
    images = torch.rand(3, 4, 32, 32)
    together = network(images)
    for k in range(3):
        assert torch.allclose(network(images[k : k + 1])[0], together[k], atol=1e-5)


def test_pose_net_starts_at_rest_and_keeps_the_limits(limits: torch.Tensor) -> None:
    torch.manual_seed(0)
    network = PoseNet(SMALL, limits)
    images = torch.rand(4, 4, 32, 32)
    angles, root = network(images)
    assert angles.shape == (4, len(limits), 3)
    with torch.no_grad():
        network.head.weight.zero_()
        angles, root = network(images)
        # Within 2 % of its range of the rest pose: a knee's rest is at its limit.
        reach = (limits[..., 1] - limits[..., 0]).float()
        assert bool((angles.abs() <= 0.011 * reach + 1e-6).all())
        assert torch.allclose(rotation_of_angles(root), torch.eye(3).expand(4, 3, 3), atol=1e-6)
        network.head.bias.normal_(std=30)
        angles, _ = network(images)
    low, high = limits.float().unbind(-1)
    assert bool(((angles >= low - 1e-5) & (angles <= high + 1e-5)).all())


def test_the_root_can_turn_all_the_way_round(limits: torch.Tensor) -> None:
    """As two columns of a matrix α has no jump where its angles have one."""
    network = PoseNet(SMALL, limits)
    images, turned = torch.zeros(1, 4, 32, 32), []
    with torch.no_grad():
        network.head.weight.zero_()
        for degrees in range(0, 361, 15):
            c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            network.head.bias[-6:] = torch.tensor([c, 0.0, -s, 0.0, 1.0, 0.0])
            turned.append(rotation_of_angles(network(images)[1])[0])
    steps = torch.stack([(a - b).norm() for a, b in zip(turned[1:], turned[:-1], strict=True)])
    assert float(steps.max()) == pytest.approx(float(steps.min()), rel=1e-3)
    assert torch.allclose(turned[0], turned[-1], atol=1e-5)


def test_sim_net_starts_with_no_deformation() -> None:
    A, T = SimNet(SMALL, 7)(torch.rand(2, 4, 32, 32))
    assert A.shape == T.shape == (2, 7, 3)
    assert not bool(A.any())
    assert not bool(T.any())


def made(**changes: object) -> Prediction:
    generator = torch.Generator().manual_seed(0)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    camera = Camera(90.0, 91.0, 32.0, 33.0, 64, 66).with_pose(
        torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), torch.tensor([0.1, 0.2, 3.0])
    )
    values = {
        "angles": numbers(3, 17, 3),
        "root": numbers(3, 3),
        "A": numbers(3, 5, 3),
        "T": numbers(3, 5, 3),
        "translation": numbers(3, 3),
        "camera": camera,
        "fps": 25.0,
    }
    return Prediction(**{**values, **changes})  # type: ignore[arg-type]


def test_predictions_survive_the_disk(tmp_path: Path) -> None:
    for prediction in (made(), made(A=None, T=None)):
        back = Prediction.load(prediction.save(tmp_path / "prediction.npz"))
        for name in ("angles", "root", "A", "T", "translation"):
            before, after = getattr(prediction, name), getattr(back, name)
            assert (before is None and after is None) or torch.equal(before, after)
        assert back.camera == prediction.camera
        assert back.fps == 25.0


def test_predictions_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="do not fit"):
        made(T=None)
    with pytest.raises(InputError, match="do not fit"):
        made(root=torch.zeros(2, 3))
    with pytest.raises(InputError, match="missing"):
        Prediction.load(tmp_path / "nothing.npz")
