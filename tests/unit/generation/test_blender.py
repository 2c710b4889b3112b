from __future__ import annotations

import ast
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from toile.errors import InputError
from toile.generation.blender import engine, process, scene, world
from toile.generation.blender.__main__ import main
from toile.generation.blender.balance import LARGEST_IMBALANCE, balanced, imbalance, imbalance_of
from toile.generation.blender.effects import EFFECTS, effect_named
from toile.generation.blender.exposure import distorted, expose, grown, srgb
from toile.generation.blender.scene import TWIN_FILE, blender_scene, matched
from toile.generation.blender.settings import BlenderSettings, random_settings
from toile.generation.textures import procedural_texture
from toile.scenes.native import load_native

Array = NDArray[np.float64]

TINY = BlenderSettings(
    name="tiny",
    grid=(8, 8),
    steps=8,
    n_frames=5,
    cloth_size=(0.5, 0.5),
    image_size=(64, 64),
    focal_length=75.0,
    distance=1.2,
    texture_size=64,
    samples=4,
    noise=0.0,
    seed=4,
)


def _missing() -> str:
    try:
        process.interpreter()
    except InputError as error:
        return (
            f"no bpy for Blender scenes: {error.got} (pip install 'toile[blender]', or {process.ENVIRONMENT})"
        )
    return ""


@pytest.fixture(scope="session")
def blender() -> None:
    reason = _missing()
    if reason:
        pytest.skip(reason)


def _simulated(settings: BlenderSettings, folder: Path, *, with_effect: bool = True) -> np.ndarray:
    request = world.simulation(settings, "motion", with_effect=with_effect)
    process.run({"threads": 1, "simulations": [request]}, folder)
    return np.load(folder / "motion.npy").astype(float)


def pendulum(force: float, fps: float = 100.0) -> np.ndarray:
    """A rigid square, 0.5 m, that swings about its upper side, pushed along its normal [m/s²]."""
    heights, times, angle, speed = np.linspace(0, 0.5, 9), [], 0.4, 0.0
    inertia, arm = (heights**2).mean(), heights.mean()
    for _ in range(int(fps)):
        times.append(angle)
        for _ in range(40):
            speed += ((-9.81 * np.sin(angle) + force) * arm / inertia) / (40 * fps)
            angle += speed / (40 * fps)
    away = np.array(times)[:, None] * np.ones(9)
    places = np.stack([0 * away, heights * np.cos(away), heights * np.sin(away)], -1)
    across = np.linspace(0, 0.5, 9)[:, None] * np.array([1.0, 0.0, 0.0])
    return across[None, :, None] + places[:, None]


class TestWithoutBlender:
    def test_an_effect_that_levels_off_is_not_driven_on(self, monkeypatch: pytest.MonkeyPatch) -> None:
        asked = []

        def moved(settings: BlenderSettings, work: Path, *, with_effect: bool, twin: object = None) -> Array:
            motion = np.zeros((5, 15, 15, 3))
            if with_effect:
                asked.append(settings.values["bend_factor"])
                motion[..., 0] = 0.01 * settings.cloth_size[0] * np.tanh(asked[-1] / 20)
            return motion

        monkeypatch.setattr(scene, "_simulated", moved)
        monkeypatch.setattr(scene, "balanced", lambda settings, work, with_effect: settings)
        found = matched(replace(TINY, effect="nonuniform_stiffness"), 0.03)
        assert asked[1] == found.values["bend_factor"] > asked[0]
        assert len(asked) == 2

    @pytest.mark.parametrize("force", [0.0, 0.3])
    def test_a_force_from_nowhere_is_found(self, force: float) -> None:
        found = imbalance(pendulum(force), [(0, 0), (8, 0)], np.array([0.0, 9.81, 0.0]), 100.0)
        assert found == pytest.approx(force, rel=0.02, abs=0.01)

    def test_missing_bpy_names_the_remedy(self, monkeypatch: pytest.MonkeyPatch) -> None:
        process._problem.cache_clear()
        with pytest.raises(InputError, match=r"toile\[blender\]"):
            process.interpreter("/nowhere/python")
        assert not process.available("/nowhere/python")
        monkeypatch.setenv(process.ENVIRONMENT, "/elsewhere/python")
        with pytest.raises(InputError, match="/elsewhere/python"):
            process.interpreter()

    def test_broken_bpy_is_named(self, tmp_path: Path) -> None:
        """What the system says, such as a library that is missing, reaches the user."""
        python = tmp_path / "python"
        python.write_text("#!/bin/sh\necho 'ImportError: libXi.so.6' >&2\nexit 1\n")
        python.chmod(0o755)
        with pytest.raises(InputError, match="libXi"):
            process.interpreter(str(python))

    @pytest.mark.parametrize(
        ("changes", "where"),
        [
            ({"effect": "ghosts"}, "effect"),
            ({"effect": "air_drag", "parameters": {"viscosity": 1.0}}, "parameters"),
            ({"effect": "anisotropic_stiffness", "parameters": {"ratio": 1.5}}, "parameters"),
            ({"effect": "motion_blur", "parameters": {"shutter": 2.0}}, "parameters"),
            ({"steps": 0}, "steps"),
            ({"tension": 0.0}, "tension"),
            ({"gravity": (1.0, 0.0, 0.0)}, "gravity"),
            ({"grid": (2, 8)}, "grid"),
        ],
    )
    def test_wrong_settings_are_refused(self, changes: dict[str, object], where: str) -> None:
        with pytest.raises(InputError) as caught:
            replace(TINY, **changes)  # type: ignore[arg-type]
        assert where in caught.value.where

    def test_random_settings_share_everything_but_the_effect(self) -> None:
        a, b = random_settings(7, "none"), random_settings(7, "air_drag")
        assert a == replace(b, effect="none")
        assert a != random_settings(8, "none")
        assert random_settings(7, small=True).grid == (24, 24)
        with pytest.raises(InputError, match="negative"):
            random_settings(-1)

    def test_effects_scale_by_one_of_their_parameters(self) -> None:
        for name, effect in EFFECTS.items():
            assert effect.name == name
            assert effect.scaled is None or effect.scaled in effect.defaults
        with pytest.raises(InputError, match="air_drag"):
            effect_named("drag")

    def test_engine_needs_only_bpy_and_numpy(self) -> None:
        """Checked in the source, function bodies included, and in a process without torch."""
        tree = ast.parse(Path(engine.__file__).read_text())
        names = {a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names}
        names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        foreign = {name.partition(".")[0] for name in names} - set(sys.stdlib_module_names)
        assert foreign == {"bpy", "mathutils", "numpy"}
        code = f"import sys; import {engine.__name__}; sys.exit('torch' in sys.modules)"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

    def test_pose_is_isometric_to_the_flat_sheet(self) -> None:
        settings = replace(TINY, grid=(40, 40), bend=20.0, yaw=10.0)
        pose = world.pose(settings, (79, 79))
        for axis in (0, 1):
            sides = np.linalg.norm(np.diff(pose, axis=axis), axis=-1)
            np.testing.assert_allclose(sides, 0.5 / 78, rtol=2e-4)
        corner = np.einsum("ijk,ijk->ij", np.diff(pose, axis=0)[:, :-1], np.diff(pose, axis=1)[:-1])
        assert np.abs(corner).max() < 0.01 * (0.5 / 78) ** 2
        flat = world.rest(settings, (79, 79))
        assert np.ptp(flat[..., 2]) == 0
        rolled = world.rest(settings, (79, 79), 6.0)
        np.testing.assert_allclose(np.linalg.norm(np.diff(rolled, axis=1), axis=-1), 0.5 / 78, rtol=1e-3)

    def test_pose_leans_away_and_hangs_below_its_corners(self) -> None:
        pose = world.pose(replace(TINY, bend=0.0, pitch=30.0), (9, 9))
        np.testing.assert_allclose(pose[4, -1] - pose[4, 0], [0, 0.5 * 0.75**0.5, 0.25], atol=1e-9)
        assert pose[0, 0, 0] < pose[-1, 0, 0]

    def test_pinned_corners_start_at_rest(self) -> None:
        times = np.array([0.0, 1e-3, 0.5, 1.0])
        motion = world.pinned_displacement(TINY, times)
        assert motion.shape == (4, 2, 3)
        assert not motion[0].any()
        assert np.abs(motion[1]).max() < 1e-5
        assert 0.005 < np.abs(motion[2:]).max() < 0.3
        assert not np.allclose(motion[3, 0], motion[3, 1])

    def test_same_cloth_on_another_grid(self) -> None:
        """Total mass and stiffness per width stay: finer grids have lighter vertices and softer springs."""
        reference, fine = world.cloth_of(TINY, (63, 63)), world.cloth_of(TINY, (125, 125))
        assert reference["mass"] == pytest.approx(TINY.mass)
        assert fine["mass"] * 125**2 == pytest.approx(reference["mass"] * 63**2)
        assert reference["tension_stiffness"] == pytest.approx(TINY.tension)
        assert fine["tension_stiffness"] == pytest.approx(0.5 * TINY.tension)

    def test_twin_shares_everything_but_the_effect(self) -> None:
        for name in EFFECTS:
            settings = replace(TINY, effect=name)
            twin = world.simulation(settings, "a", with_effect=False)
            assert twin == world.simulation(TINY, "a", with_effect=True), name

    def test_between_frames(self) -> None:
        times = np.arange(6.0)
        motion = np.stack((times, times**2, 0 * times), -1).reshape(6, 1, 1, 3)
        np.testing.assert_allclose(engine.between(motion, 2.5)[0, 0], [2.5, 6.25, 0])
        np.testing.assert_allclose(engine.between(motion, 4.0), motion[4])
        np.testing.assert_allclose(engine.between(motion, -0.3), motion[0])
        np.testing.assert_allclose(engine.between(motion, 5.5)[0, 0, 0], 5.5)

    @pytest.mark.parametrize("steps", [1, 8, 15])
    def test_number_of_steps_per_frame(self, steps: int) -> None:
        """Blender's loop in single precision takes as many steps as wanted, for any frame rate."""
        for fps in np.linspace(20, 60, 41):
            scale = np.float32(engine.time_scale(float(fps), steps))
            assert float(scale) == pytest.approx(1000**0.5 / fps, rel=1e-5)
            step, time, taken = np.float32(1 / np.float32(steps)) * scale, np.float32(0), 0
            while time < scale:
                time, taken = time + step, taken + 1
            assert taken == steps

    def test_lens_moves_points_as_it_says(self) -> None:
        image = np.zeros((101, 101, 1))
        image[50, 80] = 1  # 30 px beside the middle
        seen = distorted(image, 60.0, 0.2)[..., 0]
        column = (seen.sum(0) * np.arange(101)).sum() / seen.sum()
        assert column - 50 == pytest.approx(30 * (1 + 0.2 * 0.25), abs=0.15)
        np.testing.assert_allclose(distorted(image, 60.0, 0.0), image, atol=1e-12)

    def test_masks_grow_and_shrink(self) -> None:
        mask = np.zeros((30, 30), bool)
        mask[10:20, 10:20] = True
        assert grown(mask, 2.0)[:, 15].sum() == 14
        assert grown(mask, -2.0)[:, 15].sum() == 6
        assert grown(mask, 0.0) is mask

    def test_exposure(self) -> None:
        image = np.zeros((20, 20, 4))
        image[5:15, 5:15] = [0.2158605, 1.0, 0.0, 1.0]
        rng = np.random.default_rng(0)
        frame, mask = expose(TINY, image, rng)
        assert mask.sum() == 100
        np.testing.assert_allclose(frame[10, 10], [128 / 255, 1, 0], atol=1e-6)
        assert not frame[mask == 0].any()
        frame, mask = expose(replace(TINY, effect="mask_bias", parameters={"pixels": -2.0}), image, rng)
        assert mask.sum() == 36
        assert not frame[mask == 0].any()
        assert float(srgb(np.array(0.5))) == pytest.approx(0.7354, abs=1e-4)

    def test_command_line_reports_missing_bpy(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert main([str(tmp_path / "scene"), "--python", "/nowhere/python"]) == 2
        assert "bpy" in capsys.readouterr().err
        assert not (tmp_path / "scene").exists()


@pytest.mark.usefixtures("blender")
class TestWithBlender:
    def test_gravity_and_time_are_physical(self, tmp_path: Path) -> None:
        """A sheet that nobody holds falls by g t²/2 (1 + 1/n) after n steps of semi-implicit Euler."""
        settings = replace(TINY, bend=0.0, fps=40.0)
        request = world.simulation(settings, "motion", with_effect=True)
        request["pinned"], request["displacement"] = [], np.zeros((5, 0, 3)).tolist()
        process.run({"threads": 1, "simulations": [request]}, tmp_path)
        motion = np.load(tmp_path / "motion.npy")
        np.testing.assert_array_equal(motion[0], np.asarray(request["pose"], np.float32))
        frame = np.arange(1, 5)
        expected = 0.5 * 9.81 * (frame / 40.0) ** 2 * (1 + 1 / (frame * settings.steps))
        np.testing.assert_allclose((motion - motion[0])[1:, ..., 1].mean((1, 2)), expected, rtol=1e-3)
        assert np.abs((motion - motion[0])[..., [0, 2]]).max() < 1e-5

    def test_rest_shape_is_flat_although_frame_0_is_bent(self, tmp_path: Path) -> None:
        """Without gravity a bent sheet moves if its rest shape is flat, not if it is that pose."""
        settings = replace(TINY, bend=40.0, bend_waves=1.0, bending=20.0, motion_amplitude=0.0)
        request = world.simulation(settings, "motion", with_effect=True)
        request["gravity"] = [0.0, 0.0, 0.0]
        moved = []
        for rest in (request["rest"], request["pose"]):
            process.run({"threads": 1, "simulations": [{**request, "rest": rest}]}, tmp_path)
            motion = np.load(tmp_path / "motion.npy")
            moved.append(np.abs(motion[-1] - motion[0]).max())
        assert moved[0] > 1e-3
        assert moved[1] < 1e-5

    def test_pinned_corners_follow_their_motion(self, tmp_path: Path) -> None:
        motion = _simulated(TINY, tmp_path)
        moved = motion[:, [0, -1], 0] - motion[0, [0, -1], 0]
        expected = world.pinned_displacement(TINY, np.arange(5) / TINY.fps)
        np.testing.assert_allclose(moved, expected, atol=1e-6)

    @pytest.mark.parametrize(
        ("effect", "parameters"),
        [
            ("air_drag", {"air_damping": 2.0}),
            ("internal_damping", {"damping": 5.0}),
            ("gusts", {"strength": 1e5}),
            ("vortex_field", {"strength": 1e4}),
            ("turbulence", {"strength": 1e5}),
            ("internal_pressure", {"force": 100.0}),
            ("shrinking", {"fraction": 0.1}),
            ("anchor_slip", {"start": 0.0, "duration": 1.0}),
            ("gravity_tilt", {"angle": 10.0}),
            ("frame_rate", {"error": 0.1}),
            ("nonuniform_stiffness", {}),
            ("rest_curvature", {}),
            ("anisotropic_stiffness", {}),
        ],
    )
    def test_effects_change_the_motion(
        self, effect: str, parameters: dict[str, float], tmp_path: Path
    ) -> None:
        settings = replace(TINY, effect=effect, parameters=parameters, bending=5.0)
        twin = _simulated(settings, tmp_path, with_effect=False)
        truth = _simulated(settings, tmp_path)
        _, second = world.refinement(settings, with_effect=True)
        distance = np.linalg.norm(truth[:, ::2, ::second] - twin[:, ::2, ::2], axis=-1)
        assert np.isfinite(truth).all()
        assert distance[0].max() < 1e-6
        assert distance[-1].max() > 1e-5

    def test_scene_on_disk(self, tmp_path: Path) -> None:
        """Native layout; the projected truth falls on the printed colours; nothing tells the label."""
        settings = replace(TINY, effect="air_drag", parameters={"air_damping": 3.0}, image_size=(96, 96))
        settings = replace(settings, focal_length=112.0, samples=16)
        label = blender_scene(settings, tmp_path / "scene")
        scene = load_native(tmp_path / "scene", crop_margin=None)
        assert scene.n_frames == 5
        assert scene.pinned_vertices == (0, 56)
        assert scene.ground_truth is not None
        assert scene.ground_truth.vertices is not None
        vertices = scene.ground_truth.vertices
        assert torch.allclose(vertices[0].double(), scene.template, atol=1e-6)
        twin = np.load(tmp_path / "scene" / TWIN_FILE)
        gap = np.linalg.norm(vertices.numpy() - twin, axis=-1)[-2:].mean() / 0.5
        assert label["magnitude"]["mean_last_third"] == pytest.approx(gap)
        assert label["effect"] == "air_drag"
        assert label == json.loads(json.dumps(label))
        texts = [p.read_text() for p in (tmp_path / "scene").rglob("*") if p.suffix in (".json", ".obj")]
        assert not any("air" in text for text in texts)

        texture = procedural_texture(64, 64, settings.seed).numpy()
        texture = np.stack([gaussian_filter(texture[..., c], 0.8) for c in range(3)], -1)
        u, v = np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 1, 8), indexing="ij")
        inner = (slice(1, -1), slice(1, -1))

        def difference(frame: int, shift: tuple[float, float]) -> float:
            x, y = scene.camera.project(vertices[frame]).double().numpy().transpose(2, 0, 1) - 0.5
            seen, printed = (
                np.stack([map_coordinates(image[..., c], at, order=1) for c in range(3)], -1)
                for image, at in (
                    (scene.frames[frame].numpy(), (y + shift[1], x + shift[0])),
                    (texture, (v * 64 - 0.5, u * 64 - 0.5)),
                )
            )
            return float(np.abs(seen - printed)[inner].mean())

        for frame in (0, 4):
            here = difference(frame, (0.0, 0.0))
            for shift in ((1.5, 0.0), (-1.5, 0.0), (0.0, 1.5), (0.0, -1.5)):
                assert here < 0.7 * difference(frame, shift), (frame, shift)

    @pytest.mark.parametrize(
        "effect", ["shading", "motion_blur", "occluder", "focal_error", "lens_distortion"]
    )
    def test_effects_in_the_picture(self, effect: str, tmp_path: Path) -> None:
        """The motion is the twin's; only the frames differ, and an occluder leaves the masks alone."""
        plain = replace(TINY, n_frames=2)
        label = blender_scene(replace(plain, effect=effect), tmp_path / "with")
        blender_scene(plain, tmp_path / "without")
        a, b = (load_native(tmp_path / name, crop_margin=None) for name in ("with", "without"))
        assert a.ground_truth is not None
        assert b.ground_truth is not None
        assert a.ground_truth.vertices is not None
        assert b.ground_truth.vertices is not None
        assert label["magnitude"]["max_all"] == 0
        assert torch.equal(a.ground_truth.vertices, b.ground_truth.vertices)
        assert float((a.frames - b.frames).abs().mean()) > 1e-4
        assert a.camera == b.camera  # as declared
        if effect == "occluder":
            assert torch.equal(a.masks, b.masks)

    def test_steps_are_as_short_as_the_balance_needs(self, tmp_path: Path) -> None:
        """A stiff patch in long steps is turned by what the solver leaves over."""
        stiff = {"bend_factor": 3000.0}
        settings = replace(TINY, steps=2, effect="nonuniform_stiffness", parameters=stiff, bending=2.0)
        assert imbalance_of(settings, tmp_path, with_effect=True) > LARGEST_IMBALANCE
        found = balanced(settings, tmp_path, with_effect=True)
        assert found.steps > settings.steps
        assert found == replace(settings, steps=found.steps)
        assert imbalance_of(found, tmp_path, with_effect=True) <= LARGEST_IMBALANCE

    def test_matched_strength(self, tmp_path: Path) -> None:
        settings = replace(TINY, n_frames=9, effect="gravity_tilt", parameters={"angle": 1.0})
        found = matched(settings, 0.01)
        label = blender_scene(found, tmp_path / "scene")
        assert label["magnitude"]["mean_last_third"] == pytest.approx(0.01, rel=0.16)
        assert matched(TINY, 0.01) == TINY

    def test_cloth_outside_the_image_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="leaves the image"):
            blender_scene(replace(TINY, focal_length=300.0), tmp_path / "scene")
        assert not (tmp_path / "scene").exists()

    def test_a_crash_is_reported(self, tmp_path: Path) -> None:
        with pytest.raises(process.BlenderError, match="KeyError"):
            process.run({"threads": 1, "simulations": [{"name": "x"}]}, tmp_path)


def test_labels_name_the_vertices_that_an_effect_acts_on() -> None:
    """Not those that it moves: of what acts everywhere, none."""
    still = np.zeros((TINY.n_frames, 9, 7, 3))
    moved = still + 0.1

    def of(effect: str) -> list[int] | None:
        where = scene.label(replace(TINY, effect=effect, parameters={}), moved, still)["localisation"]
        found: list[int] | None = where["vertices"]
        return found

    # The second of the corners in world.simulation, which is the one that slips.
    assert of("anchor_slip") == [8 * 7]
    assert of("air_drag") is None
    assert of("none") is None
    stiff = of("nonuniform_stiffness")
    assert stiff is not None
    weights = world.patch(replace(TINY, effect="nonuniform_stiffness", parameters={}), (9, 7)).ravel()
    assert set(stiff) == set(np.flatnonzero(weights > 0.5))
