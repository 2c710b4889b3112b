"""``toile generate``: a scene that the other commands take."""

from __future__ import annotations

from pathlib import Path

from toile.generation.truth import read_truth

TINY = (
    "settings.name=small",
    "settings.grid=[5,4]",
    "settings.cloth_size=[0.4,0.3]",
    "settings.n_frames=3",
    "settings.substeps=2",
    "settings.image_size=[64,80]",
    "settings.focal_length=80",
    "texture.height=64",
    "texture.width=64",
)
FOLDER = Path("data/generated/small")


def files() -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in FOLDER.rglob("*") if path.is_file()}


def test_generate(toile) -> None:
    status, out, err = toile("generate", *TINY, "pinned_motion=swing", "settings.pinned_motion.period=2")
    assert (status, err) == (0, "")
    assert out.strip() == str(FOLDER)
    truth = read_truth(FOLDER)
    assert truth["grid"] == [5, 4]
    assert truth["pinned_motion"]["period"] == 2
    status, out, _ = toile("doctor", "scene=small")
    assert status == 0
    assert "errors: 0" in out


def test_generate_twice(toile) -> None:
    assert toile("generate", *TINY).status == 0
    first = files()
    status, _, err = toile("generate", *TINY, "settings.seed=1")
    assert status == 2
    assert "overwrite=true" in err
    assert files() == first
    assert toile("generate", *TINY, "overwrite=true").status == 0
    assert files() == first


def test_generate_from_nothing(toile, tmp_path: Path) -> None:
    status, _, err = toile("generate", *TINY[:-2], "texture=null")
    assert status == 2
    assert "texture" in err
    assert list(tmp_path.iterdir()) == []


def test_generate_with_an_impossible_setting(toile) -> None:
    status, _, err = toile("generate", *TINY, "settings.fps=0")
    assert status == 2
    assert "fps" in err
    assert not FOLDER.exists()


def test_how_far_it_is_stands_in_the_log(toile, monkeypatch) -> None:
    assert toile("generate", *TINY).status == 0
    quiet = files()
    monkeypatch.setattr("toile.progress.SECONDS_BETWEEN_LINES", 0.0)
    _, _, err = toile("generate", *TINY, "overwrite=true")
    lines = err.splitlines()
    assert lines[0] == "settling: 0"
    # Two frames of two sub-steps after the first.
    assert [line.split(",")[0] for line in lines[1:5]] == [f"simulation: {k} of 4" for k in (1, 2, 3, 4)]
    assert lines[-2].startswith("frames: 3 of 3")
    assert lines[-1] == "writing: 0"
    assert files() == quiet
