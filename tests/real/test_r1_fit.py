"""The default recipe on the first frames of R1, through the command line.

The data is found in ``$TOILE_DATA`` (default ``./data``).
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from toile.cli.main import main

DATA = Path(os.environ.get("TOILE_DATA", "data")).resolve()

pytestmark = pytest.mark.skipif(
    not (DATA / "phi_sft" / "R1" / "rgbs").is_dir(),
    reason=f"the video of R1 not found in {DATA}/phi_sft (set TOILE_DATA)",
)


def test_first_frames_of_r1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve frames: the still template is 1.07 off in squared Chamfer ×1e4, the fit 0.31 (measured)."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    status = main(
        [
            "fit",
            "scene=R1",
            f"paths.data={DATA}",
            "scene.n_frames=12",
            "optimization.stages.calibrate=null",
            "report.video=false",
            f"hydra.run.dir={run}",
        ]
    )
    assert status == 0
    numbers = json.loads((run / "metrics.json").read_text())
    assert numbers["metrics"]["chamfer"]["mean"] < 0.5
    # What was written is what the parameters give on their own.
    assert numbers["fit"]["difference to a rollout without warm start [mm]"] == 0.0
