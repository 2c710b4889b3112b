"""``toile diagnose``: from a generated clip to diagnosis.json."""

from __future__ import annotations

import contextlib
import logging
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hydra import compose, initialize_config_dir

from toile.cli.configuration import CONF, register_resolvers
from toile.cli.diagnose import SessionProblem, _problem, diagnose_scene, diagnose_session_folder
from toile.cli.main import main
from toile.diagnosis import session_diagnosis
from toile.diagnosis.arrays import HELD_OUT_FILE, SCREENING_FILE
from toile.diagnosis.record import DIAGNOSIS_FILE, Covered, GapReport
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import TIMES_FILE, read_times
from toile.diagnosis.stages import FILES, TRACKED_FILE
from toile.effects.gusts import FacingGusts, Gusts
from toile.errors import InputError

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
SMALL_SESSION = (
    "diagnosis=quick",
    "diagnosis.sides=[8]",
    "optimization.stages.track.term.per_side=24",
)
SMALL = (*SMALL_SESSION, "diagnosis.shooting.modes=2", "diagnosis.shooting.window=4")


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene without any effect."""
    folder = tmp_path_factory.mktemp("made")
    with contextlib.chdir(folder):
        assert main(("generate", *SCENE, "folder=clip")) == 0
    return folder / "clip"


@pytest.fixture(scope="module")
def answered(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its diagnosis, in one go."""
    folder = tmp_path_factory.mktemp("answered")
    diagnose_scene(clip, folder, SMALL)
    return folder


@pytest.fixture
def data(clip: Path, tmp_path: Path) -> Path:
    """The scene in the data folder."""
    return shutil.copytree(clip, tmp_path / "data" / "clip")


def test_diagnose(answered: Path) -> None:
    report = GapReport.read(answered / DIAGNOSIS_FILE)
    assert report.protocol.frames_used == tuple(range(9))
    assert report.protocol.frames_held_out == (9, 10, 11)
    assert {effect.name for effect in report.effects} >= {"air_drag", "focal_error", "shading", "mask_bias"}
    total = sum(effect.probability for effect in report.effects)
    assert 0 <= total <= 1
    assert report.where.vertices is not None
    gap = np.load(answered / report.where.vertices)
    assert gap.shape == (8, 8)
    assert np.isfinite(gap).all()
    matrix = np.array(report.alias.matrix)
    np.testing.assert_allclose(matrix, matrix.T)
    np.testing.assert_allclose(np.diag(matrix), 1)


def test_what_is_there_is_named_and_what_is_not_is_not(clip: Path, answered: Path, tmp_path: Path) -> None:
    """Masks that are four pixels too large; the same clip with its own masks has nothing of the kind."""
    grown = shutil.copytree(clip, tmp_path / "grown")
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    for path in (grown / "masks").iterdir():
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert mask is not None
        assert cv2.imwrite(str(path), cv2.dilate(mask, disc))
    diagnose_scene(grown, tmp_path / "run", SMALL)
    report = GapReport.read(tmp_path / "run" / DIAGNOSIS_FILE)
    assert report.verdict.effect == "mask_bias"
    assert report.verdict.stage == "observation"
    assert report.verdict.probability > 0.9
    found = report.effect("mask_bias")
    assert found is not None
    growth = found.parameters["growth"]
    assert growth.unit == "px"
    assert growth.estimate == pytest.approx(4.0, abs=0.5)
    null = GapReport.read(answered / DIAGNOSIS_FILE)
    assert null.verdict.effect in ("none", "ambiguous")
    assert null.verdict.candidates[0] == "none"
    for name in ("mask_bias", "focal_error", "lens_distortion", "shading"):
        effect = null.effect(name)
        assert effect is not None
        assert effect.probability < 0.02
        assert name not in null.verdict.candidates


def test_what_is_remarkable_about_the_scene_is_said(
    clip: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is in the answer as well; refused it is without force=true."""
    slow = (*SMALL, "scene.fps=0.5", "diagnosis.longest_substep=1", "simulator.longest_substep=1")
    with pytest.raises(InputError, match="force=true"):
        diagnose_scene(clip, tmp_path / "refused", slow)
    diagnose_scene(clip, tmp_path / "run", (*slow, "force=true"))
    (warning,) = GapReport.read(tmp_path / "run" / DIAGNOSIS_FILE).warnings
    assert "frame rate" in warning
    assert warning in caplog.messages


class Interruption:
    """Ctrl-C as soon as a stage has been stored; ``stages`` are those, in their order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.stages: list[str] = []
        write = StageStore._write

        def interrupted(store: StageStore, path: Path, *arguments: object) -> None:
            write(store, path, *arguments)  # type: ignore[arg-type]
            self.stages.append(str(path.name))
            raise KeyboardInterrupt

        monkeypatch.setattr(StageStore, "_write", interrupted)


def test_stopped_after_every_stage_it_ends_with_the_same_bytes(
    toile, data: Path, answered: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path("run")
    with monkeypatch.context() as patch:
        stopped = Interruption(patch)
        outcome = toile("diagnose", "scene=clip", *SMALL, "workers=1", "hydra.run.dir=run")
        while outcome.status == 130:
            assert "toile diagnose resume=" in outcome.out
            assert not (run / DIAGNOSIS_FILE).exists()
            if len(stopped.stages) == 1:
                overrides = (run / "overrides.yaml").read_bytes()
                check_other_settings_are_refused(toile, run)
            outcome = toile("diagnose", "resume=run")
    assert outcome.status == 0
    assert stopped.stages == [Path(file).name for file in FILES.values()]
    assert (run / DIAGNOSIS_FILE).read_bytes() == (answered / DIAGNOSIS_FILE).read_bytes()
    for name in (SCREENING_FILE, HELD_OUT_FILE):
        with np.load(run / name) as pieces, np.load(answered / name) as whole:
            assert set(pieces) == set(whole)
            for key in whole:
                np.testing.assert_array_equal(pieces[key], whole[key])
    for name in ("gap_vertices.npy", "gap_frames_vertices.npy"):
        assert (run / name).read_bytes() == (answered / name).read_bytes()
    # What stages took is not forgotten on the way.
    times = read_times(run / TIMES_FILE)
    assert list(times) == list(FILES)
    assert all(taken.cached and taken.wall is not None for taken in times.values())
    report = GapReport.read(run / DIAGNOSIS_FILE)
    assert report.verdict.reason.split(".")[0] in " ".join(outcome.out.split())
    check_it_is_not_run_again(toile, run, outcome.out)
    assert (run / "overrides.yaml").read_bytes() == overrides


def check_other_settings_are_refused(toile, run: Path) -> None:
    """And those of the run stay what they were; only Hydra's own record is of the later call."""
    files = [path for path in run.rglob("*") if path.is_file() and path.suffix != ".log"]
    before = {path: path.read_bytes() for path in files if path.parent.name != ".hydra"}
    for arguments in (
        ("resume=run", "seed=3"),
        ("scene=clip", *SMALL, "diagnosis.stiffness=[1,1,1]", "hydra.run.dir=run"),
    ):
        outcome = toile("diagnose", *arguments)
        assert outcome.status == 2
        assert "other settings" in outcome.err
    assert "diagnosis.stiffness" in outcome.err
    for path, content in before.items():
        assert path.read_bytes() == content


def check_it_is_not_run_again(toile, run: Path, said: str) -> None:
    """A finished diagnosis says once more what it has found."""
    page = (run / "index.html").stat().st_mtime_ns
    # The number of workers has no say in the answer.
    outcome = toile("diagnose", "resume=run", "workers=2")
    assert outcome.status == 0
    assert "finished before" in outcome.out
    assert said.strip() in outcome.out
    assert (run / "index.html").stat().st_mtime_ns == page
    assert toile("diagnose", "resume=run", "seed=3").status == 2


def test_however_many_share_the_work_all_digits_are_the_same(clip: Path, tmp_path: Path) -> None:
    several = ("diagnosis.refitted=[3,2]", *SMALL)
    diagnose_scene(clip, tmp_path / "first", several)
    diagnose_scene(clip, tmp_path / "second", (*several, "workers=2"))
    first, second = tmp_path / "first", tmp_path / "second"
    assert (second / DIAGNOSIS_FILE).read_bytes() == (first / DIAGNOSIS_FILE).read_bytes()
    with np.load(first / SCREENING_FILE) as alone, np.load(second / SCREENING_FILE) as shared:
        for name in alone:
            np.testing.assert_array_equal(alone[name], shared[name])


def again(caplog: pytest.LogCaptureFixture) -> dict[str, str]:
    """Stages that were computed again, and why; the log starts anew."""
    said = [message.split(": computed again, ") for message in caplog.messages if "again" in message]
    caplog.clear()
    return {name: why.partition(" was made from other ")[2] for name, why in said}


def test_what_was_made_from_something_else_is_made_again(
    clip: Path, answered: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Late settings leave early stages alone; another scene leaves none."""
    caplog.set_level(logging.INFO, "toile.diagnosis.stage_store")
    run = shutil.copytree(answered, tmp_path / "run")
    diagnose_scene(clip, run, SMALL)
    assert again(caplog) == {}
    diagnose_scene(clip, run, (*SMALL, "diagnosis.placebos=3"))
    assert again(caplog) == {"held-out frames": "settings.placebos", "maps": "settings.placebos"}
    # Lighter pictures: other data under the same name, and nothing of the old answer is left.
    other = shutil.copytree(clip, tmp_path / "clip")
    for path in (other / "rgbs").iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None
        assert cv2.imwrite(str(path), (0.8 * picture).astype(np.uint8))
    diagnose_scene(other, run, (*SMALL, "diagnosis.placebos=3"))
    reasons = again(caplog)
    assert list(reasons) == list(FILES)
    assert all(reason.startswith("scene") for reason in reasons.values())
    diagnose_scene(other, tmp_path / "fresh", (*SMALL, "diagnosis.placebos=3"))
    assert (run / DIAGNOSIS_FILE).read_bytes() == (tmp_path / "fresh" / DIAGNOSIS_FILE).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("scene.n_frames=7",), ("too short", "8 frames or more", "7 frames")),
        (("diagnosis.held_out=0.5", "scene.n_frames=10"), ("too short", "12 frames or more")),
        (("optimization=adam", "loss=none"), ("optimization=track",)),
        (("optimization=tracking",), ("one stage", "calibrate, track")),
        (("optimization=identification",), ("one stage", "match, polish")),
        (("loss=paper",), ("loss=none",)),
        (("simulator=surrogate",), ("simulator=implicit", "SurrogateSimulator")),
        (("simulator/integrator=backward_euler",), ("integrator=bdf2", "BackwardEuler")),
        (("parameters.stretching=5",), ("parameters.stretching",)),
        (("+parameters.stretching=5",), ("diagnosis.stiffness",)),
        (("+effect=air_drag",), ("effect@candidates",)),
        (("candidates.air_drag.values.linear=0.5",), ("candidates.air_drag.values", "linear: 0.5")),
        (("candidates=null",), ("nothing to choose from",)),
        (("workers=0",), ("workers",)),
        (("scene.gravity=[0,9810,0]",), ("far too strong", "force=true")),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else None,
)
def test_what_would_be_passed_over_is_refused(
    toile, data: Path, arguments: tuple[str, ...], said: tuple[str, ...]
) -> None:
    """By one message, before anything is computed, and without settings left in the folder."""
    outcome = toile("diagnose", "scene=clip", "diagnosis=quick", *arguments, "hydra.run.dir=run")
    assert outcome.status == 2
    assert outcome.err.count("error:") == 1
    for text in said:
        assert text in outcome.err
    # Hydra's own record, the lock and the log are no settings that a later call has to agree with.
    left = [path.name for path in Path("run").rglob("*") if path.is_file() and path.parent.name != ".hydra"]
    assert set(left) <= {".lock", "diagnose.log"}


def test_nothing_to_resume(toile) -> None:
    outcome = toile("diagnose", "resume=nowhere")
    assert outcome.status == 2
    assert "no diagnosis to continue" in outcome.err


def test_overrides_are_noted_as_they_were_given(toile, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Interruption(monkeypatch)
    given = (*SMALL, "diagnosis.usual_cost=12.5", "scene.gravity=[0,9.8,0]")
    assert toile("diagnose", "scene=data/clip", *given, "hydra.run.dir='a run'").status == 130
    noted = yaml.safe_load(Path("a run/overrides.yaml").read_text())
    assert noted[-len(given) :] == list(given)
    assert toile("diagnose", "resume=a run").status == 130


def test_held_out_images_have_no_part_in_the_fitted_frames(clip: Path, tmp_path: Path) -> None:
    """Neither by the coarse pass of tracking nor by the fine one."""
    coarse = [
        f"+diagnosis.coarse.{item}"
        for item in (
            "_target_=toile.diagnosis.tracked.CoarseTracking",
            "blur=6.0",
            "per_side=16",
            "cg_iterations=10",
        )
    ]
    spoilt = shutil.copytree(clip, tmp_path / "spoilt")
    for path in sorted((spoilt / "rgbs").iterdir())[9:]:
        picture = cv2.imread(str(path))
        assert cv2.imwrite(str(path), np.ascontiguousarray(picture[::-1, ::-1]))
    positions = []
    for folder in (clip, spoilt):
        run = tmp_path / "run" / folder.name
        diagnose_scene(folder, run, (*SMALL, *coarse))
        with np.load(run / TRACKED_FILE) as tracked:
            positions.append(tracked["positions"])
    assert np.abs(positions[0][9:] - positions[1][9:]).max() > 1e-3
    np.testing.assert_array_equal(positions[0][:9], positions[1][:9])


def test_frames_after_tracking_has_lost_the_cloth_do_not_count(
    clip: Path, answered: Path, tmp_path: Path
) -> None:
    run = shutil.copytree(answered, tmp_path / "run")
    with np.load(run / TRACKED_FILE) as stored:
        tracked = dict(stored)
    tracked["positions"][7:] += [0.2, 0.0, 0.0]
    np.savez_compressed(run / TRACKED_FILE, **tracked)
    diagnose_scene(clip, run, SMALL)
    report = GapReport.read(run / DIAGNOSIS_FILE)
    assert report.protocol.frames_used == tuple(range(7))
    assert "loses the cloth in frame 7" in report.verdict.reason
    # Of what is not known no prediction is measured.
    assert all(effect.shrink is None for effect in report.effects)


def test_gusts_of_a_session_have_the_modes_that_its_longest_clip_asks_for(clip: Path, tmp_path: Path) -> None:
    """12 frames at 50 fps are 0.22 s: two half waves reach 3 Hz; one clip alone keeps the usual six.

    Those of a session have a number more: the share that only pushes what faces them.
    """
    again = shutil.copytree(clip, tmp_path / "again")
    (tmp_path / "session.yaml").write_text(f"clips: [{{scene: {clip}}}, {{scene: {again}}}]\n")

    register_resolvers()

    def modes(*overrides: str) -> list[int]:
        with initialize_config_dir(str(CONF), version_base=None):
            cfg = compose("diagnose", ["effect@candidates=[air_drag,gusts]", *overrides])
        problem = _problem(cfg)
        clips = problem.clips if isinstance(problem, SessionProblem) else (problem,)
        of_session = isinstance(problem, SessionProblem)
        gusts = [effect for one in clips for effect in one.effects if effect.NAME == Gusts.NAME]
        assert all(isinstance(effect, FacingGusts if of_session else Gusts) for effect in gusts)
        return [len(effect.values) // 2 for effect in gusts]

    session = f"session={tmp_path}"
    assert modes(session) == [2, 2]
    assert modes(session, "candidates.gusts.n_modes=5") == [5, 5]
    (tmp_path / "session.yaml").write_text(
        f"clips: [{{scene: {clip}, motion: release}}, {{scene: {again}, motion: shake}}]\n"
    )
    # Where no wind blew in a clip, gusts have a mean.
    assert modes(session) == [3, 3]
    assert modes("scene=native", f"scene.name={clip}") == [6]


@pytest.fixture(scope="module")
def two_clips(clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips of one cloth, which are one and the same."""
    folder = tmp_path_factory.mktemp("session")
    for name in ("first", "second"):
        shutil.copytree(clip, folder / name)
    (folder / "session.yaml").write_text(
        "clips:\n- scene: first\n- {scene: second, motion: fan-off}\nplumb_line: true\n"
    )
    return folder


@pytest.mark.parametrize("searched", [True, False])
def test_clips_of_a_session_have_one_answer(
    searched: bool,
    two_clips: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    small = (
        *(() if searched else ("session_model.touched=null", "session_model.stand_ins=[]")),
        "session_model.side=6",
        "session_model.modes=2",
        "session_model.window=0.16",
        "session_model.fit.passes=2",
        "session_model.refining.rounds=1",
        "session_model.refining.passes=2",
        "session_model.placebos=1",
        "session_model.fitted=2",
        "session_model.draws=4",
        "effect@candidates=[air_drag,gravity_tilt,gusts,shading]",
    )
    with contextlib.chdir(tmp_path):
        assert (
            main(("diagnose", f"session={two_clips}", *SMALL_SESSION, *small, f"hydra.run.dir={tmp_path}"))
            == 0
        )
    report = GapReport.read(tmp_path / DIAGNOSIS_FILE)
    assert report.session is not None
    assert report.session.clips == ("first", "second")
    assert report.session.frames == (12, 12)
    assert sum(report.session.probabilities.values()) == pytest.approx(1.0)
    # A plumb line was in view.
    assert {effect.name for effect in report.effects} - {"contact"} == {"air_drag", "gusts", "shading"}
    assert ("contact" in report.session.probabilities) == searched
    # Looking for obstacles takes half a minute a clip: what is found is kept.
    assert (tmp_path / "fits" / "obstacles.npz").is_file() == searched
    assert len(report.where.frames) == 24
    assert (report.where.acts_on is not None) == (tmp_path / "acts_on_vertices.npy").is_file()
    assert set(report.session.material) >= {"stretching", "shearing", "bending"}
    neither = sum(report.session.probabilities.get(name, 0.0) for name in ("none", "unknown"))
    assert sum(report.where.stages.values()) == pytest.approx(1 - neither)
    assert "How probable it is that the gap lies in a stage" in (tmp_path / "index.html").read_text()
    asked = report.session.expected_information
    assert (report.verdict.effect in ("ambiguous", "unknown")) == bool(asked)
    assert report.session.next_clip in ("", *list(asked)[:1])
    shrunk = [effect.shrink for effect in report.effects if effect.shrink is not None]
    assert all(shrink.held_out == "the last clip" for shrink in shrunk)
    assert (tmp_path / report.where.vertices).is_file()
    # A word that nobody knows says nothing, and that is said.
    warning, copied = report.warnings
    assert "second: its motion 'fan-off' is none of" in warning
    assert copied.startswith("second: its images are those of first")
    assert warning in capsys.readouterr().err
    assert warning in (tmp_path / "index.html").read_text().replace("&#39;", "'")
    answer = (tmp_path / DIAGNOSIS_FILE).read_bytes()
    (tmp_path / DIAGNOSIS_FILE).unlink()
    judged: dict[str, list[Any]] = {}

    def noted(name: str, place: int) -> None:
        judge = getattr(session_diagnosis, name)

        def judging(*given: Any, **settings: Any) -> Any:
            judged.setdefault(name, []).append(given[place])
            judged.setdefault(f"{name}, settings", []).append(settings)
            return judge(*given, **settings)

        monkeypatch.setattr(session_diagnosis, name, judging)

    for name, place in (("with_slips", 1), ("moved_holders", 2), ("change_of_size", 1)):
        noted(name, place)
    diagnose_session_folder(two_clips, tmp_path, (*SMALL_SESSION, *small))
    assert (tmp_path / DIAGNOSIS_FILE).read_bytes() == answer
    # What holds the cloth is judged by the motion that the base model has refined, of every clip.
    (slips,), (moved,), sizes = judged["with_slips"], judged["moved_holders"], judged["change_of_size"]
    with np.load(tmp_path / "refined.npz") as arrays:
        for k, of_clip in enumerate(zip(slips, moved, sizes, strict=True)):
            for positions in of_clip:
                np.testing.assert_array_equal(positions, arrays[f"positions.{k}"])
    # Where the size seems to change, holders have gone with the cloth: neither slips nor moved ones are said.
    monkeypatch.setattr(session_diagnosis, "change_of_size", lambda clip, positions: -0.05)
    (tmp_path / DIAGNOSIS_FILE).unlink()
    diagnose_session_folder(two_clips, tmp_path, (*SMALL_SESSION, *small))
    again = GapReport.read(tmp_path / DIAGNOSIS_FILE)
    assert again.session is not None
    assert again.session.resized == {"first": -0.05, "second": -0.05}
    assert again.verdict.effect == "unknown"
    assert judged["with_slips, settings"] == [{"resized": False}, {"resized": True}]
    assert len(judged["moved_holders"]) == 1
    # What hides the cloth's print moves nothing, and another motion would not take it away.
    monkeypatch.setattr(session_diagnosis, "change_of_size", lambda clip, positions: None)
    shares = np.array([0.0, 0.2, 0.3, 0.0])
    monkeypatch.setattr(session_diagnosis, "hidden_in", lambda clip, settings: shares)
    (tmp_path / DIAGNOSIS_FILE).unlink()
    diagnose_session_folder(two_clips, tmp_path, (*SMALL_SESSION, *small))
    hidden = GapReport.read(tmp_path / DIAGNOSIS_FILE)
    assert hidden.session is not None
    assert hidden.session.covered == {"first": Covered(0.3, 1, 2), "second": Covered(0.3, 1, 2)}
    assert hidden.session.resized == {}
    assert hidden.verdict.effect == "unknown"
    assert "leave out what passes before the cloth" in hidden.verdict.next_recording
    assert hidden.session.next_clip == ""
    times = read_times(tmp_path / TIMES_FILE)
    assert all(stage.cached for stage in times.values())


@pytest.mark.parametrize(
    ("changed", "refused"), [("grid=[6,6]", "grid"), ("cloth_size=[0.41,0.41]", "a cloth of")]
)
def test_clips_of_other_cloths_are_refused(
    changed: str, refused: str, two_clips: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    with contextlib.chdir(tmp_path):
        kept = [s for s in SCENE if changed.partition("=")[0] not in s]
        assert main(("generate", *kept, f"settings.{changed}", "folder=other")) == 0
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "session.yaml").write_text(f"clips:\n- scene: {two_clips / 'first'}\n- scene: {other}\n")
    with pytest.raises(InputError, match=refused):
        diagnose_session_folder(folder, tmp_path / "out", SMALL_SESSION)


@pytest.mark.parametrize(
    "extra",
    [
        ("diagnosis.held_out=0.4",),
        ("scene.name=anything",),
        ("diagnosis.shooting.window=16",),
        ("diagnosis.shooting.modes=3",),
        ("diagnosis.placebos=10",),
        ("diagnosis=fine",),
    ],
)
def test_a_session_refuses_what_it_would_ignore(
    extra: tuple[str, ...], two_clips: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"session"):
        diagnose_session_folder(two_clips, tmp_path / "out", (*SMALL_SESSION, *extra))


def test_a_session_that_leaves_nothing_open_is_refused(two_clips: Path, tmp_path: Path) -> None:
    """Before anything is computed: a plumb line was in view."""
    with pytest.raises(InputError, match="plumb line"):
        diagnose_session_folder(
            two_clips, tmp_path / "out", (*SMALL_SESSION, "effect@candidates=[gravity_tilt]")
        )
    assert not list((tmp_path / "out").rglob("*.npz"))
