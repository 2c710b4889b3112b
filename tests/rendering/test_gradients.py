"""Gradients against finite differences of the images, of colours inside and of the silhouette's area."""

import pytest
import torch
from wavy_cloth import CAMERA, smooth_texture, wavy_cloth

from toile.rendering import ReferenceRenderer, WarpRenderer

SAMPLES = 12


def area(vertices, faces):
    """Area (B,) [px²] by counting 12 × 12 samples per pixel: no antialiasing involved."""
    face = WarpRenderer().rasterize(vertices, faces, CAMERA.scaled(SAMPLES)).face
    return (face >= 0).double().sum(dim=(1, 2)) / SAMPLES**2


def directions(vertices):
    """Motions of the cloth, (V, 3) each [m], and by how many pixels of outline they sweep."""
    n = round(vertices.shape[1] ** 0.5)
    one = torch.zeros_like(vertices[0])
    moves = {}
    for axis, name in enumerate("xyz"):
        moves[name] = one.clone()
        moves[name][:, axis] = 1
    moves["scale"] = vertices[0] - vertices[0].mean(dim=0)
    moves["border vertex"] = one.clone()
    moves["border vertex"][n // 2, 1] = 1
    return moves


# Largest error over the four cloths as a part of the gradient of the area by scale [px²], measured with the
# step below: that unit stands for one outline's length, since the area's gradient by translation is near 0.
@pytest.mark.parametrize(
    ("n", "amplitude", "measured"),
    [
        (8, 0.06, {"x": 0.015, "y": 0.013, "z": 0.013, "scale": 0.016, "border vertex": 0.0005}),
        (16, 0.14, {"x": 0.029, "y": 0.029, "z": 0.016, "scale": 0.023, "border vertex": 0.0033}),
        # Faces of one pixel and less, in folds:
        (32, 0.14, {"x": 0.046, "y": 0.048, "z": 0.021, "scale": 0.035, "border vertex": 0.0018}),
    ],
)
def test_area_gradient(n, amplitude, measured):
    worst = dict.fromkeys(measured, 0.0)
    for seed in range(4):
        vertices, faces, coordinates = wavy_cloth(seed, n=n, batch=1, amplitude=amplitude, distance=1.7)
        vertices.requires_grad_()
        images = WarpRenderer().render(vertices, faces, coordinates, smooth_texture(4, 4), CAMERA)
        images.silhouette.sum().backward()
        # Measured 0.0015: the area itself is right to a few pixels.
        torch.testing.assert_close(
            images.silhouette.sum().double(), area(vertices.detach(), faces)[0], rtol=0.003, atol=0
        )
        step = 0.02  # about one pixel, hence many samples
        unit = None
        errors = {}
        for name, move in directions(vertices.detach()).items():
            with torch.no_grad():
                numeric = area(vertices + step * move, faces) - area(vertices - step * move, faces)
            numeric = numeric.item() / (2 * step)
            errors[name] = abs((vertices.grad[0] * move).sum().item() - numeric)
            unit = abs(numeric) if name == "scale" else unit
        worst = {name: max(worst[name], errors[name] / unit) for name in worst}
    assert all(worst[name] <= 1.5 * measured[name] for name in measured), worst


def test_area_gradient_of_one_border_vertex_on_a_plane():
    # A flat cloth, where the exact gradient is known: half the length of the two border edges at the vertex.
    n = 8
    vertices, faces, coordinates = wavy_cloth(0, n=n, batch=1, amplitude=0.0, distance=1.7)
    vertices.requires_grad_()
    images = WarpRenderer().render(vertices, faces, coordinates, smooth_texture(4, 4), CAMERA)
    images.silhouette.sum().backward()
    spacing = 0.84 / (n - 1)
    exact = -spacing * CAMERA.fx / 1.7 * CAMERA.fy / 1.7  # top border, y down: area grows upwards
    # Measured 1.3 %: the midpoint rule over the 4.2 columns that an edge spans.
    assert vertices.grad[0, n // 2, 1].item() == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("make", [WarpRenderer, ReferenceRenderer])
def test_colour_gradient_inside_the_cloth(make):
    # No folds, and a single cell of a bilinear texture, since the gradient jumps from cell to cell.
    vertices, faces, coordinates = wavy_cloth(4, n=6, batch=1, amplitude=0.05)
    coordinates = 0.25 + 0.5 * coordinates
    texture = torch.rand(2, 2, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    renderer = make()
    generator = torch.Generator().manual_seed(1)
    weight = torch.rand(1, CAMERA.height, CAMERA.width, 3, generator=generator, dtype=torch.float64)
    images = renderer.render(vertices, faces, coordinates, texture, CAMERA)
    inner = -torch.nn.functional.max_pool2d(-images.silhouette[:, None], 7, stride=1, padding=3)[:, 0]
    weight = weight * (inner >= 1)[..., None]
    assert bool((inner >= 1).sum() > 500)

    def loss(v, c, t):
        return (renderer.render(v, faces, c, t, CAMERA).rgb * weight).sum()

    inputs = [vertices, coordinates, texture]
    gradients = torch.autograd.grad(loss(*[x.requires_grad_() for x in inputs]), inputs)
    for index, (gradient, step) in enumerate(zip(gradients, (1e-3, 1e-3, 1e-1), strict=True)):
        direction = gradient / gradient.norm()  # a random one would mostly measure its own cancellation
        with torch.no_grad():
            ends = []
            for sign in (1, -1):
                moved = list(inputs)
                moved[index] = inputs[index] + sign * step * direction
                ends.append(loss(*moved))
        numeric = (ends[0] - ends[1]).item() / (2 * step)
        # Measured 4.4e-4 (vertices: kinks at the edges between faces), 9e-6 (coordinates), 4e-7 (texture).
        assert (gradient * direction).sum().item() == pytest.approx(numeric, rel=1.5e-3)
