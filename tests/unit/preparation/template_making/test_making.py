"""Templates of a bent sheet whose grid is known: by mesh, points and (of a flat one) corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from toile.errors import InputError
from toile.geometry.io import write_mesh, write_point_cloud
from toile.preparation.template_making.axes import Axes
from toile.preparation.template_making.intrinsics import Intrinsics
from toile.preparation.template_making.making import make_template
from toile.preparation.template_making.mesh import MeshSurface
from toile.preparation.template_making.points import PointsSurface
from toile.preparation.template_making.sheet import SheetSurface
from toile.preparation.template_making.still import Still, read_still
from toile.preparation.template_making.surface import Layout, SurfaceGrid
from toile.preparation.template_making.writing import write_template
from toile.scenes.doctor import diagnose_folder
from toile.scenes.findings import Severity
from toile.scenes.native import load_native

SHAPE = (16, 13)
ANY_SIZE = Layout(SHAPE, None, None)
OPENCV = Axes(np.eye(3).tolist(), (0, 0, 0), 1.0)
PHI_SFT = Axes(np.diag([-1.0, -1, 1]).tolist(), (0, 0, 0), 1.0)


@pytest.fixture
def still(curved_sheet, tmp_path: Path) -> Still:
    c = curved_sheet.camera
    folder = curved_sheet.write_video(tmp_path / "scene")
    return read_still(folder, Intrinsics(None, c.fx, c.fy, c.cx, c.cy), fps=None, minimum_component=0.1)


@pytest.fixture
def mesh_file(curved_sheet, tmp_path: Path) -> Path:
    vertices, faces = curved_sheet.irregular_mesh()
    write_mesh(tmp_path / "scan.ply", torch.from_numpy(vertices), faces)
    return tmp_path / "scan.ply"


def cloud_file(points: np.ndarray, folder: Path) -> Path:
    write_point_cloud(folder / "cloud.npy", torch.from_numpy(points))
    return folder / "cloud.npy"


def mesh_surface(file: Path, axes: Axes = OPENCV) -> MeshSurface:
    return MeshSurface(file, axes, minimum_inside=0.8)


def points_surface(file: Path, axes: Axes = OPENCV) -> PointsSurface:
    return PointsSurface(file, axes, smoothing=1.0, minimum_cover=0.95, side_degree=8)


def made(still: Still, surface, layout: Layout = ANY_SIZE, **changes):
    settings = {"name": "bent", "pinned_vertices": None, "gravity": (0, 9.81, 0), "minimum_iou": 0.8}
    return make_template(still, surface, layout, **(settings | changes))


def test_mesh_gives_the_grid_of_equal_edges(still, curved_sheet, mesh_file) -> None:
    result = made(still, mesh_surface(mesh_file))
    error = np.linalg.norm(result.scene.template.numpy() - curved_sheet.grid(*SHAPE), axis=-1)
    assert error.max() < 0.001
    assert error[[0, 0, -1, -1], [0, -1, 0, -1]].max() < 1e-6
    np.testing.assert_allclose(result.scene.cloth_size, curved_sheet.cloth_size, rtol=0.003)
    for lengths in result.edges:
        assert lengths.std() < 0.005 * lengths.mean()
    assert np.abs(result.shear).max() < 0.5
    assert result.surface.to_surface.max() < 1e-6
    assert result.surface.to_template.max() < 0.002
    assert result.iou > 0.97
    assert result.scene.pinned_vertices == (0, (SHAPE[0] - 1) * SHAPE[1])


def test_noisy_points_give_nearly_the_same_grid(still, curved_sheet, tmp_path) -> None:
    file = cloud_file(curved_sheet.noisy_points(), tmp_path)
    result = made(still, points_surface(file))
    error = np.linalg.norm(result.scene.template.numpy() - curved_sheet.grid(*SHAPE), axis=-1)
    # A pixel is 2.6 mm here.
    assert error.mean() < 0.0013  # half
    assert error.max() < 0.0052  # two, at corners
    for lengths in result.edges:
        assert lengths.std() < 0.01 * lengths.mean()
    assert result.surface.to_template.mean() < 0.0012  # Gaussian noise of 1 mm: 0.8 mm


def test_texture_coordinates_are_the_projection(still, mesh_file) -> None:
    scene = made(still, mesh_surface(mesh_file)).scene
    pixels = scene.camera.project(scene.template)
    size = torch.tensor([scene.camera.width, scene.camera.height])
    torch.testing.assert_close(scene.texture_coordinates * size, pixels.float())
    # [0, 0] is at the upper left, axis 0 runs to the right, axis 1 down.
    assert bool((scene.texture_coordinates.diff(dim=0)[..., 0] > 0).all())
    assert bool((scene.texture_coordinates.diff(dim=1)[..., 1] > 0).all())


def test_a_mirrored_or_renumbered_file_gives_the_same_template(still, curved_sheet, tmp_path) -> None:
    vertices, faces = curved_sheet.irregular_mesh()
    order = np.random.default_rng(0).permutation(len(vertices))
    place = np.argsort(order)
    left_handed = (vertices * [-1, -1, 1])[order]
    write_mesh(tmp_path / "a.obj", torch.from_numpy(left_handed), place[faces][:, ::-1])
    found = made(still, mesh_surface(tmp_path / "a.obj", PHI_SFT)).scene.template.numpy()
    assert np.abs(found - curved_sheet.grid(*SHAPE)).max() < 0.001


def test_unit_and_translation_of_a_file(still, curved_sheet, tmp_path) -> None:
    vertices, faces = curved_sheet.irregular_mesh(300)
    write_mesh(tmp_path / "mm.ply", torch.from_numpy(1000 * (vertices - [0, 0, 1])), faces)
    axes = replace(OPENCV, translation=(0, 0, 1), scale=0.001)
    found = made(still, mesh_surface(tmp_path / "mm.ply", axes)).scene.template.numpy()
    assert np.abs(found - curved_sheet.grid(*SHAPE)).max() < 0.003


def test_given_corners_choose_the_first_vertex(still, curved_sheet, mesh_file) -> None:
    grid = curved_sheet.grid(*SHAPE)
    pixels = still.camera.project(torch.from_numpy(grid)).numpy()
    turned = pixels[[-1, -1, 0, 0], [0, -1, -1, 0]]  # from the upper right on
    result = made(still, mesh_surface(mesh_file), Layout((13, 16), None, turned), pinned_vertices=[0])
    found = result.scene.template.numpy()
    assert np.abs(found - grid.transpose(1, 0, 2)[:, ::-1]).max() < 0.001
    assert result.scene.pinned_vertices == (0,)
    for wrong, said in (
        (turned[::-1], "clockwise"),
        (turned + 60, "not on the outline"),
        (turned[:3], "cannot be understood"),
        (turned[[0, 0, 2, 3]] + [[0, 0], [0.01, 0.01], [0, 0], [0, 0]], "four corners"),
    ):
        with pytest.raises(InputError, match=said):
            made(still, mesh_surface(mesh_file), Layout((13, 16), None, wrong))


def test_written_scene_is_sound(still, mesh_file) -> None:
    result = made(still, mesh_surface(mesh_file))
    write_template(result, still.folder)
    findings = diagnose_folder(still.folder)
    assert [f.what for f in findings if f.severity is not Severity.INFO] == ["Few frames"]
    scene = load_native(still.folder, crop_margin=None)
    assert scene.n_frames == 2
    assert scene.fps == 30
    torch.testing.assert_close(scene.template, result.scene.template, rtol=0, atol=0)
    torch.testing.assert_close(scene.texture, scene.frames[0], rtol=0, atol=0)


@dataclass(frozen=True)
class MovedCorner:
    """A surface whose vertex [0, 0] is moved along the upper side by a share of an edge."""

    surface: MeshSurface
    share: float

    def lay_grid(self, still: Still, layout: Layout) -> SurfaceGrid:
        laid = self.surface.lay_grid(still, layout)
        positions = laid.positions.copy()
        positions[0, 0] += self.share * (positions[1, 0] - positions[0, 0])
        return replace(laid, positions=positions)


def test_a_corner_in_the_wrong_place_is_a_warning(still, mesh_file) -> None:
    surface = mesh_surface(mesh_file)
    assert not [f for f in made(still, surface).warnings if "sheared" in f.what]
    # Half an edge is less than the limit allows, a whole edge gives 45°.
    assert not [f for f in made(still, MovedCorner(surface, 0.5)).warnings if "sheared" in f.what]
    moved = made(still, MovedCorner(surface, -1.0))
    (warning,) = [f for f in moved.warnings if "sheared" in f.what]
    assert warning.where in ("vertex [0, 0]", "vertex [0, 1]")
    assert 43 < np.abs(moved.shear).max() < 47
    assert f"{np.abs(moved.shear).max():.0f}° there, 1 cell above 40°" in warning.got


def test_existing_template_is_kept(still, mesh_file) -> None:
    result = made(still, mesh_surface(mesh_file))
    write_template(result, still.folder)
    before = {p: p.read_bytes() for p in still.folder.iterdir() if p.is_file()}
    with pytest.raises(InputError, match="has a template already"):
        write_template(result, still.folder)
    assert {p: p.read_bytes() for p in still.folder.iterdir() if p.is_file()} == before
    write_template(result, still.folder, overwrite=True)


class TestWhatIsRefused:
    def test_cloth_size_of_another_cloth(self, still, mesh_file) -> None:
        with pytest.raises(InputError, match="cloth size disagree"):
            made(still, mesh_surface(mesh_file), Layout(SHAPE, (0.8, 0.7), None))
        with pytest.raises(InputError, match="not positive"):
            made(still, mesh_surface(mesh_file), Layout(SHAPE, (0.8, -0.7), None))

    def test_slightly_wrong_size_is_a_warning(self, still, mesh_file) -> None:
        result = made(still, mesh_surface(mesh_file), Layout(SHAPE, (0.57, 0.46), None))
        assert result.scene.cloth_size == (0.57, 0.46)
        assert any("cloth size disagree" in str(w) for w in result.warnings)

    def test_wrong_axes_are_named(self, still, mesh_file, curved_sheet, tmp_path) -> None:
        with pytest.raises(InputError, match="axes=phi_sft"):
            made(still, mesh_surface(mesh_file, PHI_SFT))
        file = cloud_file(curved_sheet.noisy_points(), tmp_path)
        opengl = Axes(np.diag([1.0, -1, -1]).tolist(), (0, 0, 0), 1.0)
        with pytest.raises(InputError, match="axes=opengl"):
            made(still, points_surface(file, opengl))
        with pytest.raises(InputError, match="no rotation"):
            made(still, mesh_surface(mesh_file, replace(OPENCV, rotation=(2 * np.eye(3)).tolist())))

    def test_unit_of_the_file(self, still, curved_sheet, tmp_path) -> None:
        # Farther away and larger by the same factor, it projects onto the mask all the same.
        vertices, faces = curved_sheet.irregular_mesh(200)
        write_mesh(tmp_path / "mm.ply", torch.from_numpy(1000 * vertices), faces)
        with pytest.raises(InputError, match="millimetres"):
            made(still, mesh_surface(tmp_path / "mm.ply"))

    def test_only_a_part_of_the_cloth(self, still, curved_sheet, tmp_path) -> None:
        s, t = np.meshgrid(np.linspace(0, 0.6, 20), np.linspace(0, 1, 20), indexing="ij")
        part = torch.from_numpy(curved_sheet.at(s.ravel(), t.ravel()))
        k = np.arange(400).reshape(20, 20)
        quads = np.stack((k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]), -1).reshape(-1, 4)
        write_mesh(tmp_path / "part.obj", part, quads)
        with pytest.raises(InputError, match="onto mask 0"):
            made(still, mesh_surface(tmp_path / "part.obj"))
        cloud = curved_sheet.noisy_points()
        with pytest.raises(InputError, match="does not cover the mask"):
            made(still, points_surface(cloud_file(cloud[cloud[:, 0] < 0.1], tmp_path)))

    def test_mesh_with_a_hole(self, still, curved_sheet, tmp_path) -> None:
        vertices, faces = curved_sheet.irregular_mesh()
        middle = np.linalg.norm(vertices[faces].mean(1) - curved_sheet.at(*np.array([[0.5], [0.5]])), axis=1)
        write_mesh(tmp_path / "hole.ply", torch.from_numpy(vertices), faces[middle > 0.05])
        with pytest.raises(InputError, match="not a disc"):
            made(still, mesh_surface(tmp_path / "hole.ply"))

    def test_few_points(self, still, curved_sheet, tmp_path) -> None:
        with pytest.raises(InputError, match="Too few points"):
            made(still, points_surface(cloud_file(curved_sheet.noisy_points(100), tmp_path)))

    def test_pinned_vertex_out_of_range(self, still, mesh_file) -> None:
        with pytest.raises(InputError, match="out of range"):
            made(still, mesh_surface(mesh_file), pinned_vertices=[SHAPE[0] * SHAPE[1]])


class TestFlatSheet:
    def test_corners_of_the_mask_give_the_pose(self, still, curved_sheet) -> None:
        """The bent sheet is narrower than its length says, so the flat one of the chord's size fits."""
        grid = curved_sheet.grid(*SHAPE)
        chord = float(np.linalg.norm(grid[-1, 0] - grid[0, 0]))
        result = made(still, SheetSurface(0.1), Layout(SHAPE, (chord, 0.4), None))
        found = result.scene.template.numpy()
        error = np.linalg.norm(found - grid, axis=-1)[[0, 0, -1, -1], [0, -1, 0, -1]]
        assert error.max() < 0.03
        assert result.edges[0].std() < 1e-9
        assert result.scene.cloth_size == (chord, 0.4)

    def test_size_is_needed(self, still) -> None:
        with pytest.raises(InputError, match="one camera cannot see it"):
            made(still, SheetSurface(0.1))

    def test_size_of_another_shape(self, still) -> None:
        with pytest.raises(InputError, match="not those of a flat rectangle"):
            made(still, SheetSurface(0.1), Layout(SHAPE, (0.4, 0.8), None))
