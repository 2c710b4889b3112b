"""Which points of a mesh are seen: folds, slanted cloth, and the border of the image."""

import pytest
import torch
from wavy_cloth import CAMERA, wavy_cloth

from toile.errors import InputError
from toile.geometry.camera import Camera
from toile.rendering import WarpRenderer, visible_points

SQUARE = Camera(8.0, 8.0, 4.0, 4.0, 8, 8)


def seen(vertices, faces, camera, point_faces, barycentrics, **options):
    fragments = WarpRenderer().rasterize(vertices, faces, camera)
    return visible_points(fragments, vertices, faces, camera, point_faces, barycentrics, **options)


def test_the_sheet_behind_a_fold_is_hidden():
    # A strip creased at x = 0.2: the front goes left at z = 1, the back returns left at z = 1.5.
    rows = [(-0.3, -1, 1), (0.2, -1, 1.2), (0.2, 1, 1.2), (-0.3, 1, 1), (-0.3, -1, 1.5), (-0.3, 1, 1.5)]
    vertices = torch.tensor([rows])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 1, 2], [4, 2, 5]])
    centre = torch.full((4, 3), 1 / 3)
    assert seen(vertices, faces, SQUARE, torch.arange(4), centre).tolist() == [[True, True, False, False]]
    # Within a tolerance larger than the gap between the sheets, both count as seen.
    assert bool(seen(vertices, faces, SQUARE, torch.arange(4), centre, tolerance=0.6).all())


def test_slanted_cloth_does_not_hide_itself():
    vertices, faces, _ = wavy_cloth(4, n=8, amplitude=0.0)
    vertices = vertices * torch.tensor([0.6, 0.6, 1.0])
    # Turned to 72° from the view: one pixel spans 0.06 m of depth, sixty times the tolerance.
    vertices[..., 2] += 3 * vertices[..., 0]
    generator = torch.Generator().manual_seed(0)
    barycentrics = torch.rand(500, 3, generator=generator)
    barycentrics = barycentrics / barycentrics.sum(dim=1, keepdim=True)
    point_faces = torch.randint(len(faces), (500,), generator=generator)
    visible = seen(vertices, faces, CAMERA, point_faces, barycentrics)
    points = (vertices[:, faces[point_faces]] * barycentrics[..., None]).sum(-2)
    x, y = CAMERA.project(points).unbind(-1)
    inside = (x >= 0) & (x < CAMERA.width) & (y >= 0) & (y < CAMERA.height)
    assert inside.float().mean() > 0.8
    assert torch.equal(visible, inside)


def test_points_outside_the_image_or_behind_the_camera_are_not_seen():
    rows = [(0.0, 0.0, 1.0), (0.49, 0.49, 1.0), (0.51, 0.0, 1.0), (0.0, -0.51, 1.0), (0.1, 0.1, -1.0)]
    faces = torch.tensor([[0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3], [4, 4, 4]])
    barycentrics = torch.tensor([1.0, 0, 0]).expand(5, 3)
    visible = seen(torch.tensor([rows]), faces, SQUARE, torch.arange(5), barycentrics)
    assert visible.tolist() == [[True, True, False, False, False]]


def test_wrong_shapes_are_named():
    vertices, faces, _ = wavy_cloth(0)
    fragments = WarpRenderer().rasterize(vertices, faces, CAMERA)
    with pytest.raises(InputError, match=r"expected: shape \(B, h, w\) = \(2, 8, 8\)"):
        visible_points(
            fragments, vertices, faces, SQUARE, torch.zeros(1, dtype=torch.int64), torch.ones(1, 3)
        )
    with pytest.raises(InputError, match=r"expected: shapes \(P,\) and \(P, 3\)"):
        visible_points(
            fragments, vertices, faces, CAMERA, torch.zeros(2, dtype=torch.int64), torch.ones(1, 3)
        )
