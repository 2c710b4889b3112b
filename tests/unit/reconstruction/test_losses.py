"""Terms of the loss on values worked out by hand."""

from __future__ import annotations

import pytest
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from toile.errors import InputError
from toile.reconstruction.losses.base import VideoLoss
from toile.reconstruction.losses.force_regularization import ForceRegularization
from toile.reconstruction.losses.image import ImageLoss
from toile.reconstruction.losses.image_gradient import ImageGradientLoss
from toile.reconstruction.losses.image_pyramid import ImagePyramidLoss
from toile.reconstruction.losses.silhouette import SilhouetteLoss
from toile.rendering.base import RenderedImages


def rendered(rgb: Tensor | None = None, silhouette: Tensor | None = None) -> RenderedImages:
    if rgb is None:
        assert silhouette is not None
        rgb = torch.zeros(*silhouette.shape, 3)
    if silhouette is None:
        silhouette = torch.zeros(rgb.shape[:3])
    return RenderedImages(rgb, silhouette, torch.zeros(rgb.shape[:3]))


def test_image_loss_sums_channels_and_averages_pixels() -> None:
    rgb = torch.zeros(2, 2, 2, 3)
    rgb[0, 1, 0] = torch.tensor([1.0, 0.5, 0.25])
    frames = torch.zeros_like(rgb)
    frames[1, 0, 0, 2] = 0.5
    loss = ImageLoss(weight=2.0)(rendered(rgb), frames, torch.zeros(2, 2, 2))
    assert loss.item() == pytest.approx(2.0 * (1.75 + 0.5) / 8)


def test_image_pyramid_of_one_scale_is_the_image_loss() -> None:
    generator = torch.Generator().manual_seed(0)
    rgb, frames = (torch.rand(2, 9, 7, 3, generator=generator) for _ in range(2))
    given = rendered(rgb), frames, torch.ones(2, 9, 7)
    assert ImagePyramidLoss(2.0, [1])(*given).item() == pytest.approx(ImageLoss(2.0)(*given).item())


def test_image_pyramid_pulls_where_the_image_loss_does_not() -> None:
    """A dot 5 px beside its place: at scale 1 a small move costs nothing, at scale 16 it pays."""
    columns = torch.arange(32.0)

    def dot(x: Tensor) -> Tensor:
        line = torch.exp(-0.5 * (columns - x) ** 2)
        return line[None, None, :, None].expand(1, 16, 32, 3)

    def slope(loss: VideoLoss) -> float:
        x = torch.tensor(18.0, requires_grad=True)
        loss(rendered(dot(x)), dot(torch.tensor(10.0)), torch.ones(1, 16, 32)).backward()
        assert x.grad is not None
        return x.grad.item()

    assert abs(slope(ImageLoss(1.0))) < 0.05 * slope(ImagePyramidLoss(1.0, [16]))


def test_unusable_scales() -> None:
    with pytest.raises(InputError, match="at least 1"):
        ImagePyramidLoss(1.0, [1, 0])


def test_image_gradient_loss_does_not_see_brightness() -> None:
    frames = torch.rand(1, 9, 9, 3, generator=torch.Generator().manual_seed(0))
    loss = ImageGradientLoss(1.0)(rendered(frames + 0.25), frames, torch.ones(1, 9, 9))
    assert loss.item() == pytest.approx(0.0, abs=1e-6)


def test_image_gradient_loss_of_a_ramp() -> None:
    # 0.1 per pixel along x in one channel; half of it in the first and last column, where the image ends.
    rgb = torch.zeros(1, 3, 4, 3)
    rgb[..., 1] = 0.1 * torch.arange(4.0)
    loss = ImageGradientLoss(1.0)(rendered(rgb), torch.zeros_like(rgb), torch.ones(1, 3, 4))
    assert loss.item() == pytest.approx((0.05 + 0.1 + 0.1 + 0.05) / 4, rel=1e-5)


def test_silhouette_loss_of_one_pixel_is_its_share() -> None:
    # The blur spreads a pixel over 43 × 43 px but keeps its sum.
    silhouette = torch.zeros(1, 61, 61)
    silhouette[0, 30, 30] = 1.0
    loss = SilhouetteLoss(sigma=7.0, weight=1.0)(
        rendered(silhouette=silhouette), torch.zeros(1, 61, 61, 3), torch.zeros(1, 61, 61)
    )
    assert loss.item() == pytest.approx(1 / 61**2, rel=1e-4)


def test_silhouette_loss_pulls_over_a_gap() -> None:
    # Without overlap plain masks have no gradient; blurred ones ask for coverage towards the mask.
    mask = torch.zeros(1, 40, 40)
    mask[0, :, 30:] = 1.0
    silhouette = torch.zeros(1, 40, 40, requires_grad=True)
    SilhouetteLoss(7.0, 1.0)(rendered(silhouette=silhouette), torch.zeros(1, 40, 40, 3), mask).backward()
    assert silhouette.grad is not None
    assert silhouette.grad[0, 20, 25] < 0


def test_silhouette_loss_is_that_of_a_convolution() -> None:
    generator = torch.Generator().manual_seed(0)
    silhouette = torch.rand(2, 50, 71, generator=generator).requires_grad_()
    mask = torch.rand(2, 50, 71, generator=generator)
    blurred = gaussian_blur2d((silhouette - mask)[:, None], (43, 43), (7.0, 7.0), border_type="constant")
    expected = 3.0 * blurred.abs().mean()
    loss = SilhouetteLoss(7.0, 3.0)(rendered(silhouette=silhouette), torch.zeros(2, 50, 71, 3), mask)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    wanted, found = (torch.autograd.grad(value, silhouette)[0] for value in (expected, loss))
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3 * float(wanted.abs().max()))


def field() -> Tensor:
    """One vector of 2 that lasts for one frame on a 2 × 3 grid, over 2 frames."""
    t = torch.zeros(2, 2, 3, 3, dtype=torch.float64)
    t[0, 0, 0, 1] = 2.0
    return t


@pytest.mark.parametrize(
    ("weights", "total", "mean"),
    [
        ((1.0, 0.0, 0.0), 4.0, 4.0 / 12),  # 2 frames × 6 vertices
        ((0.0, 1.0, 0.0), 4.0, 4.0 / 6),  # 1 change in time × 6 vertices
        ((0.0, 0.0, 1.0), 8.0, 4.0 / 6 + 4.0 / 8),  # 2 frames × 3 changes along i, 4 along j
    ],
)
def test_force_regularization(weights: tuple[float, float, float], total: float, mean: float) -> None:
    assert ForceRegularization(*weights, "sum")(field()).item() == pytest.approx(total)
    assert ForceRegularization(*weights, "mean")(field()).item() == pytest.approx(mean)


def test_force_regularization_of_a_single_frame() -> None:
    assert ForceRegularization(1.0, 1.0, 0.0, "mean")(field()[:1]).item() == pytest.approx(4.0 / 6)


def test_unknown_convention() -> None:
    with pytest.raises(InputError, match=r"sum \(as printed\) or mean"):
        ForceRegularization(1.0, 1.0, 1.0, "average")  # type: ignore[arg-type]
