"""One suite over every renderer: what the interface promises, on pixels worked out by hand."""

import pytest
import torch

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.rendering import NvdiffrastRenderer, ReferenceRenderer, WarpRenderer

CAMERA = Camera(8.0, 8.0, 4.0, 4.0, 8, 8)
WHITE = torch.ones(2, 2, 3)


def make(name, supersampling=1):
    if name == "nvdiffrast":
        try:
            return NvdiffrastRenderer(supersampling), torch.device("cuda")
        except InputError as error:
            pytest.skip(f"nvdiffrast: {error.got}")
    return {"warp": WarpRenderer, "reference": ReferenceRenderer}[name](supersampling), torch.device("cpu")


@pytest.fixture(params=["warp", "reference", "nvdiffrast"])
def back_end(request):
    return request.param


def at(*points, camera=CAMERA):
    """Vertices (1, V, 3) that project to the pixel positions (x, y) at depth z."""
    rows = [((x - camera.cx) * z / camera.fx, (y - camera.cy) * z / camera.fy, z) for x, y, z in points]
    return torch.tensor([rows], dtype=torch.float64)


def draw(back_end, vertices, faces, uv=None, texture=WHITE, camera=CAMERA, supersampling=1):
    renderer, device = make(back_end, supersampling)
    uv = torch.zeros(vertices.shape[1], 2) if uv is None else uv
    faces = torch.as_tensor(faces, device=device)
    return renderer.render(vertices.to(device), faces, uv.to(device), texture.to(device), camera)


def rasterized(back_end, vertices, faces, camera=CAMERA):
    renderer, device = make(back_end)
    return renderer.rasterize(vertices.to(device), torch.as_tensor(faces, device=device), camera)


def rectangle(left, top, right, bottom, z=1.0):
    return at((left, top, z), (right, top, z), (right, bottom, z), (left, bottom, z))


QUAD = [[0, 1, 2], [0, 2, 3]]


def test_outputs_have_the_promised_shapes_and_types(back_end):
    images = draw(back_end, rectangle(1, 1, 5, 5).repeat(3, 1, 1), QUAD, camera=Camera(8, 8, 4, 4, 6, 9))
    assert images.rgb.shape == (3, 6, 9, 3)
    assert images.silhouette.shape == images.depth.shape == (3, 6, 9)
    assert images.rgb.dtype == images.silhouette.dtype == images.depth.dtype == torch.float32


def test_triangle_covers_the_pixel_centres_inside_it(back_end):
    fragments = rasterized(back_end, at((1, 1, 2), (7.4, 1, 2), (1, 7.4, 2)), [[0, 1, 2]])
    row, column = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
    expected = (row >= 1) & (column >= 1) & (row + column <= 7)
    assert torch.equal(fragments.face[0].cpu() >= 0, expected)
    torch.testing.assert_close(fragments.depth[0].cpu(), 2.0 * expected, rtol=1e-6, atol=0)
    # Pixel (row 1, column 2), centre (2.5, 1.5): 1.5 of 6.4 towards b and 0.5 of 6.4 towards c.
    weights = fragments.barycentrics[0, 1, 2].cpu()
    torch.testing.assert_close(weights, torch.tensor([1 - 2 / 6.4, 1.5 / 6.4, 0.5 / 6.4]), rtol=0, atol=1e-6)


def test_both_sides_of_a_face_are_drawn(back_end):
    triangle = at((1, 1, 1), (7, 1, 1), (1, 7, 1))
    front = draw(back_end, triangle, [[0, 1, 2]])
    back = draw(back_end, triangle, [[0, 2, 1]])
    torch.testing.assert_close(front.silhouette, back.silhouette, rtol=0, atol=1e-6)


def test_edges_cover_the_exact_fraction_of_a_pixel(back_end):
    images = draw(back_end, rectangle(1.25, 1.9, 5.9, 6.3), QUAD)
    rows = images.silhouette[0].cpu()
    # Columns 1..5 of a row well inside, then rows 1..6 of a column well inside.
    torch.testing.assert_close(rows[4], torch.tensor([0, 0.75, 1, 1, 1, 0.9, 0, 0]), rtol=0, atol=1e-5)
    torch.testing.assert_close(rows[:, 3], torch.tensor([0, 0.1, 1, 1, 1, 1, 0.3, 0]), rtol=0, atol=1e-5)
    torch.testing.assert_close(images.rgb[0].cpu(), rows[..., None].expand(8, 8, 3), rtol=0, atol=1e-6)


def test_attributes_are_perspective_correct(back_end):
    # Left side at z = 1, right side at z = 3; u runs from 0 to 1 along the cloth.
    vertices = at((0, -1, 1), (8, -1, 3), (8, 9, 3), (0, 9, 1))
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    ramp = torch.tensor([0.0, 1.0])[None, :, None].expand(2, 2, 3)
    images = draw(back_end, vertices, QUAD, uv, ramp)
    # Pixel centre x = 4.5 is 0.5625 across the screen: 1/z = 0.4375 + 0.5625 / 3 = 0.625, u = 0.1875 / 0.625
    # = 0.3, which lies 0.1 past the first texel centre of two.
    assert images.depth[0, 4, 4].item() == pytest.approx(1.6, abs=1e-5)
    assert images.rgb[0, 4, 4, 0].item() == pytest.approx(0.1, abs=1e-5)


def test_texture_is_bilinear_and_clamped(back_end):
    texture = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(3))
    vertices = rectangle(-4, -4, 12, 12)  # u, v = 0..1 over twice the image, so texels are 4 pixels wide
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    rgb = draw(back_end, vertices, QUAD, uv, texture).rgb[0].cpu()
    # Pixel centre 2.5 is at u = 6.5 / 16, texel coordinate 1.125; centre 0.5 is at 4.5 / 16, 0.625.
    expected = 0.375 * texture[0, 1] + 0.625 * texture[1, 1]
    expected = 0.875 * expected + 0.125 * (0.375 * texture[0, 2] + 0.625 * texture[1, 2])
    torch.testing.assert_close(rgb[0, 2], expected, rtol=0, atol=1e-5)
    outside = torch.tensor([[-2.0, -2], [-1, -2], [-1, -1], [-2, -1]])
    rgb = draw(back_end, rectangle(-1, -1, 9, 9), QUAD, outside, texture).rgb[0].cpu()
    torch.testing.assert_close(rgb, texture[0, 0].expand(8, 8, 3), rtol=0, atol=1e-6)


def test_nearest_face_wins_whatever_its_index(back_end):
    near = at((1, 1, 1), (6, 1, 1), (1, 6, 1))
    far = at((0, 0, 2), (9, 0, 2), (0, 9, 2))
    vertices = torch.cat((far, near), dim=1)
    for faces, front in (([[0, 1, 2], [3, 4, 5]], 1), ([[3, 4, 5], [0, 1, 2]], 0)):
        fragments = rasterized(back_end, vertices, faces)
        assert fragments.face[0, 2, 2].item() == front
        assert fragments.depth[0, 2, 2].item() == pytest.approx(1, abs=1e-6)
        assert fragments.depth[0, 6, 1].item() == pytest.approx(2, abs=1e-5)


def test_intersecting_faces_switch_where_they_cross(back_end):
    # One plane runs from z = 1 to z = 2 along x, the other one from 2 to 1: they meet at x = 4.
    vertices = torch.cat(
        (
            at((0, -9, 1), (8, -9, 2), (8, 9, 2), (0, 9, 1)),
            at((0, -9, 2), (8, -9, 1), (8, 9, 1), (0, 9, 2)),
        ),
        dim=1,
    )
    face = rasterized(back_end, vertices, [*QUAD, [4, 5, 6], [4, 6, 7]]).face[0].cpu()
    assert bool((face[:, :4] < 2).all())
    assert bool((face[:, 4:] >= 2).all())


def test_equal_depth_goes_to_the_lowest_face(back_end):
    if back_end == "nvdiffrast":
        pytest.skip("nvdiffrast: chooses by itself between faces at equal depth")
    vertices = at((1, 1, 1.7), (7, 1, 2.3), (1, 7, 1.1))
    # The same triangle three times, from different corners and sides.
    fragments = rasterized(back_end, vertices, [[1, 2, 0], [0, 1, 2], [0, 2, 1]])
    assert set(fragments.face.unique().tolist()) == {-1, 0}


def test_faces_with_a_vertex_behind_the_camera_are_skipped(back_end):
    vertices = torch.cat((at((1, 1, 1), (6, 1, 1), (1, 6, 1)), torch.tensor([[[0.0, 0.0, -1.0]]])), dim=1)
    vertices.requires_grad_()
    images = draw(back_end, vertices, [[0, 1, 2], [0, 1, 3], [1, 2, 3]])
    alone = draw(back_end, vertices[:, :3].detach(), [[0, 1, 2]])
    # The edges of a skipped face count as border.
    torch.testing.assert_close(images.silhouette, alone.silhouette, rtol=0, atol=1e-6)
    images.silhouette.sum().backward()
    assert bool(vertices.grad.isfinite().all())
    assert vertices.grad[0, 3].tolist() == [0, 0, 0]


def test_faces_with_a_nan_vertex_are_skipped(back_end):
    if back_end == "nvdiffrast":
        pytest.skip("nvdiffrast: not known what it does with nan")
    vertices = torch.cat((rectangle(1, 1, 5, 5), torch.full((1, 1, 3), torch.nan)), dim=1)
    images = draw(back_end, vertices, [*QUAD, [0, 1, 4]])
    alone = draw(back_end, rectangle(1, 1, 5, 5), QUAD)
    assert torch.equal(images.silhouette, alone.silhouette)
    assert torch.equal(images.depth, alone.depth)


def test_nothing_in_view_is_black(back_end):
    for vertices in (rectangle(20, 20, 30, 30), -rectangle(1, 1, 5, 5)):
        images = draw(back_end, vertices, QUAD)
        assert images.rgb.abs().max() == images.silhouette.max() == images.depth.max() == 0


def test_the_front_of_a_fold_is_antialiased_over_the_back(back_end):
    # A strip folded over at x = 3.7: the front (z = 1) is black and the sheet behind it (z = 2) white.
    vertices = at(
        (-9, -9, 2), (9, -9, 2), (9, 9, 2), (-9, 9, 2), (-9, -9, 1), (3.7, -9, 1), (3.7, 9, 1), (-9, 9, 1)
    )
    uv = torch.tensor([[1.0, 0]] * 4 + [[0.0, 0]] * 4)
    ramp = torch.tensor([0.0, 1.0])[None, :, None].expand(2, 2, 3)
    images = draw(back_end, vertices, [*QUAD, [4, 5, 6], [4, 6, 7]], uv, ramp)
    torch.testing.assert_close(images.silhouette, torch.ones_like(images.silhouette))
    row = images.rgb[0, 4, :, 0].cpu()
    torch.testing.assert_close(row, torch.tensor([0, 0, 0, 0.3, 1, 1, 1, 1]), rtol=0, atol=1e-5)


def test_occluding_contour_of_a_fold_moves_with_its_crease(back_end):
    # Two sheets share the crease x = 5.8, one in front of the other: not a border of the mesh.
    vertices = at((1, -9, 1), (5.8, -9, 1.2), (5.8, 9, 1.2), (1, 9, 1), (1, -9, 1.5), (1, 9, 1.5))
    vertices.requires_grad_()
    faces = [[0, 1, 2], [0, 2, 3], [4, 1, 2], [4, 2, 5]]
    images = draw(back_end, vertices, faces)
    row = images.silhouette[0, 4].detach().cpu()
    torch.testing.assert_close(row, torch.tensor([0, 1, 1, 1, 1, 0.8, 0, 0]), rtol=0, atol=1e-5)
    images.silhouette.sum().backward()
    # Both ends of the crease by 1 m to the right: 8 / 1.2 px in each of the 8 rows.
    assert vertices.grad[0, 1:3, 0].sum().item() == pytest.approx(8 * 8 / 1.2, rel=1e-5)


def test_area_gradient_of_a_moving_side(back_end):
    vertices = rectangle(1.3, -9, 5.8, 9, z=2.0).requires_grad_()
    draw(back_end, vertices, QUAD).silhouette.sum().backward()
    # A side that spans the 8 rows sweeps 8 px of area per px; 1 m is 8 / 2 px.
    assert vertices.grad[0, 1:3, 0].sum().item() == pytest.approx(32, rel=1e-5)
    assert vertices.grad[0, [0, 3], 0].sum().item() == pytest.approx(-32, rel=1e-5)


def test_gradients_reach_all_three_inputs(back_end):
    vertices = rectangle(1.3, 1.2, 6.8, 6.1).requires_grad_()
    uv = torch.tensor([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]).requires_grad_()
    texture = torch.rand(5, 6, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    images = draw(back_end, vertices, QUAD, uv, texture)
    (images.rgb.square().sum() + images.depth.sum()).backward()
    for gradient, dtype in (
        (vertices.grad, torch.float64),
        (uv.grad, torch.float32),
        (texture.grad, torch.float32),
    ):
        assert gradient.dtype == dtype
        assert bool(gradient.isfinite().all())
        assert gradient.abs().max() > 0


def test_frames_of_a_batch_do_not_touch_each_other(back_end):
    vertices = torch.cat((rectangle(1.3, 1.2, 6.8, 6.1), rectangle(0.2, 2.3, 4.4, 7.7, z=1.5)))
    together = draw(back_end, vertices, QUAD)
    for b in range(2):
        alone = draw(back_end, vertices[b : b + 1], QUAD)
        assert torch.equal(together.rgb[b], alone.rgb[0])
        assert torch.equal(together.silhouette[b], alone.silhouette[0])
        assert torch.equal(together.depth[b], alone.depth[0])


def test_supersampling_keeps_size_and_improves_corners(back_end):
    vertices = rectangle(1.3, 1.7, 5.6, 6.2)
    area = (5.6 - 1.3) * (6.2 - 1.7)
    errors = []
    for factor in (1, 4):
        images = draw(back_end, vertices, QUAD, supersampling=factor)
        assert images.silhouette.shape == (1, 8, 8)
        errors.append(abs(images.silhouette.sum().item() - area))
        # The mean depth is over the samples that hit something, so it is not drawn towards zero.
        depth = images.depth[images.depth > 0]
        torch.testing.assert_close(depth, torch.ones_like(depth), rtol=0, atol=1e-6)
    assert errors[1] < 0.3 * errors[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"vertices": torch.zeros(4, 3)},
            r"expected: floating point \(B, V, 3\).*\n.*got: .*float32 \(4, 3\)",
        ),
        (
            {"vertices": torch.zeros(1, 4, 3, dtype=torch.int64)},
            r"expected: floating point.*\n.*got: .*int64",
        ),
        (
            {"faces": torch.tensor(QUAD, dtype=torch.int32)},
            r"expected: int64 \(T, 3\)\n.*got: .*int32 \(2, 3\)",
        ),
        ({"faces": torch.tensor([[0, 1, 4]])}, r"expected: indices in \[0, 4\)\n.*got: .*from 0 to 4"),
        ({"texture_coordinates": torch.zeros(3, 2)}, r"expected: floating point \(4, 2\)\n.*got: .*\(3, 2\)"),
        ({"texture": torch.zeros(3, 4, 4)}, r"expected: .*\(h_t, w_t, 3\)\n.*got: .*\(3, 4, 4\)"),
        ({"camera": Camera(8, 8, 4, 4, 0, 8)}, r"expected: height and width >= 1\n.*got: .*0 × 8"),
    ],
)
def test_wrong_input_is_named(back_end, change, message):
    renderer, device = make(back_end)
    arguments = {
        "vertices": rectangle(1, 1, 5, 5),
        "faces": torch.tensor(QUAD),
        "texture_coordinates": torch.zeros(4, 2),
        "texture": WHITE,
    }
    arguments = {
        k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in (arguments | change).items()
    }
    with pytest.raises(InputError, match=message):
        renderer.render(**({"camera": CAMERA} | arguments))


@pytest.mark.parametrize("factor", [0, 1.5, True])
def test_wrong_supersampling_is_named(back_end, factor):
    with pytest.raises(InputError, match="expected: a whole number >= 1"):
        {"warp": WarpRenderer, "reference": ReferenceRenderer, "nvdiffrast": NvdiffrastRenderer}[back_end](
            factor
        )
