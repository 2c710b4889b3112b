"""``toile diagnose``: from a generated clip to diagnosis.json."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np

from toile.cli.diagnose import diagnose_scene
from toile.diagnosis.diagnose import SCREENING_FILE, TRACKED_FILE
from toile.evaluation.diagnosis_record import DIAGNOSIS_FILE, GapReport

SCENE = (
    "settings.name=clip",
    "settings.grid=[8,8]",
    "settings.refinement=1",
    "settings.cloth_size=[0.4,0.4]",
    "settings.n_frames=12",
    "settings.substeps=2",
    "settings.image_size=[120,120]",
    "settings.focal_length=170",
    "texture.height=120",
    "texture.width=120",
)
SMALL = (
    "diagnosis=quick",
    "diagnosis.sides=[8]",
    "diagnosis.shooting.modes=2",
    "diagnosis.shooting.window=4",
    "optimization.stages.track.term.per_side=24",
)


def test_diagnose(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    status, out, _ = toile("diagnose", "scene=clip", *SMALL, "hydra.run.dir=run")
    assert status == 0
    report = GapReport.read(Path("run") / DIAGNOSIS_FILE)
    assert report.verdict.reason.split(".")[0] in " ".join(out.split())
    assert report.protocol.frames_used == tuple(range(9))
    assert report.protocol.frames_held_out == (9, 10, 11)
    assert {effect.name for effect in report.effects} >= {"air_drag", "focal_error", "shading", "mask_bias"}
    total = sum(effect.probability for effect in report.effects)
    assert 0 <= total <= 1
    assert report.where.vertices is not None
    gap = np.load(Path("run") / report.where.vertices)
    assert gap.shape == (8, 8)
    assert np.isfinite(gap).all()
    matrix = np.array(report.alias.matrix)
    np.testing.assert_allclose(matrix, matrix.T)
    np.testing.assert_allclose(np.diag(matrix), 1)


def test_the_same_again_and_without_tracking_again(toile) -> None:
    """What was tracked is used again, and however many share the work, all digits are the same."""
    assert toile("generate", *SCENE).status == 0
    scene = next(Path("data").rglob("scene.json")).parent
    several = ("diagnosis.refitted=[3,2]", *SMALL)
    diagnose_scene(scene, Path("first"), several)
    diagnose_scene(scene, Path("second"), (*several, "workers=2"))
    first = (Path("first") / DIAGNOSIS_FILE).read_bytes()
    assert (Path("second") / DIAGNOSIS_FILE).read_bytes() == first
    with np.load(Path("first") / SCREENING_FILE) as alone, np.load(Path("second") / SCREENING_FILE) as shared:
        for name in alone:
            np.testing.assert_array_equal(alone[name], shared[name])
    (Path("first") / DIAGNOSIS_FILE).unlink()
    diagnose_scene(scene, Path("first"), several)
    assert (Path("first") / DIAGNOSIS_FILE).read_bytes() == first


def test_a_recipe_that_does_not_track_is_refused(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    status, _, err = toile("diagnose", "scene=clip", *SMALL[:1], "optimization=adam", "loss=none")
    assert status == 2
    assert "optimization=tracking" in err


def test_no_workers_are_refused(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    status, _, err = toile("diagnose", "scene=clip", *SMALL, "workers=0")
    assert status == 2
    assert "workers" in err


def test_held_out_images_have_no_part_in_the_fitted_frames(toile) -> None:
    """Neither by the coarse pass of tracking nor by the fine one."""
    assert toile("generate", *SCENE).status == 0
    scene = next(Path("data").rglob("scene.json")).parent
    coarse = [
        f"+diagnosis.coarse.{item}"
        for item in (
            "_target_=toile.diagnosis.tracked.CoarseTracking",
            "blur=6.0",
            "per_side=16",
            "cg_iterations=10",
        )
    ]
    spoilt = Path("spoilt")
    shutil.copytree(scene, spoilt)
    for path in sorted((spoilt / "rgbs").iterdir())[9:]:
        picture = cv2.imread(str(path))
        assert cv2.imwrite(str(path), np.ascontiguousarray(picture[::-1, ::-1]))
    positions = []
    for folder in (scene, spoilt):
        diagnose_scene(folder, Path("run") / folder.name, (*SMALL, *coarse))
        with np.load(Path("run") / folder.name / TRACKED_FILE) as tracked:
            positions.append(tracked["positions"])
    assert np.abs(positions[0][9:] - positions[1][9:]).max() > 1e-3
    np.testing.assert_array_equal(positions[0][:9], positions[1][:9])


def test_frames_after_tracking_has_lost_the_cloth_do_not_count(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    scene = next(Path("data").rglob("scene.json")).parent
    run = Path("run")
    diagnose_scene(scene, run, SMALL)
    assert GapReport.read(run / DIAGNOSIS_FILE).protocol.frames_used == tuple(range(9))
    with np.load(run / TRACKED_FILE) as stored:
        tracked = dict(stored)
    tracked["positions"][7:] += [0.2, 0.0, 0.0]
    np.savez_compressed(run / TRACKED_FILE, **tracked)
    diagnose_scene(scene, run, SMALL)
    report = GapReport.read(run / DIAGNOSIS_FILE)
    assert report.protocol.frames_used == tuple(range(7))
    assert "loses the cloth in frame 7" in report.verdict.reason
    # Of what is not known no prediction is measured.
    assert all(effect.shrink is None for effect in report.effects)
