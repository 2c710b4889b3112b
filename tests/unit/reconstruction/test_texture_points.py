"""The texture-point term: derivatives, geometry of the points, robustness to light."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toile.geometry.camera import Camera
from toile.geometry.mesh import grid_faces
from toile.reconstruction.image_terms.image_features import contrast_features
from toile.reconstruction.image_terms.texture_points import PointTermSettings, TexturePointTerm, grid_points

CAMERA = Camera(60.0, 60.0, 32.0, 32.0, 64, 64)
GRID = (5, 6)


def sheet() -> np.ndarray:
    i, j = np.meshgrid(np.linspace(-0.35, 0.35, GRID[0]), np.linspace(-0.35, 0.35, GRID[1]), indexing="ij")
    return np.stack((i, j, 1.0 + 0.1 * i), -1).reshape(-1, 3)


def pictures(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    waves = [torch.sin(0.3 * x + k) * torch.cos(0.25 * y - k) for k in range(3)]
    image = 0.5 + 0.3 * torch.stack(waves, -1)
    mask = ((x > 8) & (x < 56) & (y > 8) & (y < 56)).float()
    return image.expand(n, -1, -1, -1).contiguous(), mask.expand(n, -1, -1).contiguous()


def term(mask_weight: float = 50.0, **changes: float) -> TexturePointTerm:
    settings = PointTermSettings(12, 1.5, None, 100.0, mask_weight, **changes)
    frames, masks = pictures(2)
    points = grid_points(GRID, settings.per_side, 1.0, 0)
    features = contrast_features(frames, masks, 1.5, None)
    return TexturePointTerm(features, features[0], CAMERA, points, sheet(), settings)


def test_no_cost_where_nothing_moved() -> None:
    value = term().evaluate(np.stack((sheet(), sheet())), 0, None, derivatives=True)
    np.testing.assert_allclose(value.colour, 0, atol=1e-9)
    np.testing.assert_allclose(value.gradient, 0, atol=1e-5)


def test_gradient_against_finite_differences() -> None:
    """Sampled image gradients are central differences over a pixel: a few percent from the true slope."""
    t = term()
    x = np.stack((sheet(), sheet() + np.array((0.01, -0.008, 0.01))))
    rng = np.random.default_rng(1)
    gradient = t.evaluate(x, 0, None, derivatives=True).gradient
    for _ in range(3):
        d = rng.normal(size=x.shape) + 2 * np.sign(gradient)
        e = 1e-3
        values = [t.evaluate(x + s * e * d, 0, None, derivatives=False).total for s in (1, -1)]
        # Worst case measured: 4.5 %.
        assert (gradient * d).sum() == pytest.approx((values[0] - values[1]) / (2 * e), rel=0.15)


def test_gauss_newton_matrix_is_symmetric_and_positive() -> None:
    t = term()
    x = np.stack((sheet(), sheet() + 0.01))
    value = t.evaluate(x, 0, None, derivatives=True)
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=x.shape), rng.normal(size=x.shape)
    assert (t.apply(value, a) * b).sum() == pytest.approx((t.apply(value, b) * a).sum(), rel=1e-10)
    assert (t.apply(value, a) * a).sum() > 0


def test_hidden_points_do_not_count() -> None:
    t = term()
    x = np.stack((sheet(), sheet() + 0.02))
    seen = np.ones((2, t.n_points), np.float32)
    seen[1] = 0
    value = t.evaluate(x, 0, seen, derivatives=True)
    assert value.colour[1] == value.mask[1] == 0
    assert not value.gradient[1].any()


def test_mask_weight_zero_removes_the_silhouette() -> None:
    value = term(mask_weight=0.0).evaluate(np.stack((sheet(), sheet() + 0.02)), 0, None, derivatives=False)
    assert value.mask.sum() == 0
    assert value.colour.sum() > 0


def test_points_agree_with_the_triangles_of_a_flat_sheet() -> None:
    points = grid_points(GRID, 9, 1.0, 3)
    faces, barycentrics = points.triangle_coordinates(GRID)
    corners = sheet()[grid_faces(*GRID).numpy()[faces]]
    np.testing.assert_allclose(
        (corners * barycentrics[..., None]).sum(1), points.positions(sheet()), atol=1e-12
    )
    assert barycentrics.min() >= -1e-12


def test_jitter_depends_on_the_seed_and_keeps_the_border() -> None:
    a, b = grid_points(GRID, 9, 1.0, 0), grid_points(GRID, 9, 1.0, 1)
    assert np.abs(a.weights - b.weights).max() > 0
    assert a.border.sum() == 4 * 8
    np.testing.assert_array_equal(a.weights, grid_points(GRID, 9, 1.0, 0).weights)


def test_normalised_features_ignore_brightness_and_contrast() -> None:
    frames, masks = pictures(1)
    darker = 0.2 + 0.5 * frames
    same = contrast_features(frames, masks, 1.5, 6.0)
    changed = contrast_features(darker, masks, 1.5, 6.0)
    plain = contrast_features(frames, masks, 1.5, None) - contrast_features(darker, masks, 1.5, None)
    inside = masks[0] > 0
    # The contrast floor of 0.02 leaves a little: 6 % of the features' 0.15 measured.
    assert (same - changed)[0][inside].abs().mean() < 0.02
    assert plain[0][inside].abs().mean() > 0.05
