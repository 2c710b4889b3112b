"""``toile blind train`` on a handful of clips."""

from __future__ import annotations

from pathlib import Path

from toile.diagnosis.learned.decision import LearnedDecision

SMALL = (
    "learned.set.clips=24",
    "learned.set.sessions=8",
    "learned.trees.iterations=3",
    "learned.trees.least=2",
)


def test_train_makes_clips_grows_trees_and_goes_on_where_it_was(toile, tmp_path: Path) -> None:
    first = toile("blind", "train", *SMALL)
    assert first.status == 0, first.err
    folder = tmp_path / "outputs/learned"
    decision = LearnedDecision.load(folder / "weights.npz")
    assert decision.labels[0] == "none"
    assert abs(sum(decision.posterior({}).values()) - 1) < 1e-9
    assert "top-1 among effects" in (folder / "weights.csv").read_text()
    chunk = folder / "features_00000.npz"
    before, weights = chunk.stat().st_mtime_ns, (folder / "weights.csv").read_text()
    (folder / "features_00001.npz").unlink()
    assert toile("blind", "train", *SMALL).status == 0
    assert chunk.stat().st_mtime_ns == before
    # What was made again is what was there.
    assert (folder / "weights.csv").read_text() == weights
    assert toile("blind", "train", *SMALL, "learned.set.seed=21").status == 2
