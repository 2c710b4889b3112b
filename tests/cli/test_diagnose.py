"""``toile diagnose``: from a generated clip to diagnosis.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toile.cli.diagnose import diagnose_scene
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
    """What was tracked is used again, and the answer is the same to the last digit."""
    assert toile("generate", *SCENE).status == 0
    scene = next(Path("data").rglob("scene.json")).parent
    diagnose_scene(scene, Path("first"), SMALL)
    diagnose_scene(scene, Path("second"), SMALL)
    first = (Path("first") / DIAGNOSIS_FILE).read_bytes()
    assert (Path("second") / DIAGNOSIS_FILE).read_bytes() == first
    (Path("first") / DIAGNOSIS_FILE).unlink()
    diagnose_scene(scene, Path("first"), SMALL)
    assert (Path("first") / DIAGNOSIS_FILE).read_bytes() == first


def test_a_recipe_that_does_not_track_is_refused(toile) -> None:
    assert toile("generate", *SCENE).status == 0
    status, _, err = toile("diagnose", "scene=clip", *SMALL[:1], "optimization=adam", "loss=none")
    assert status == 2
    assert "optimization=tracking" in err
