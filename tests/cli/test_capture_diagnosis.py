"""``toile capture diagnose``: what the model of a clip lacks, from the clip's folder to diagnosis.json."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from toile.diagnosis.garment.effects import EFFECTS

TINY = (
    "preset=demo",
    "folder=set",
    "garment.vertices=210",
    "settings.motions=[squat]",
    "settings.world.vertices=1.1",
    "settings.world.substeps=1",
    "settings.ring.views=1",
    "settings.ring.side=32",
)
FAST = (
    "diagnosis.substeps=1",
    "diagnosis.fits.simulated=1",
    "diagnosis.fits.roll_outs=1",
)


def test_a_clip_is_diagnosed_and_what_is_no_clip_is_refused(toile) -> None:
    assert toile("capture", "data", *TINY, "settings.n_frames=8").status == 0
    clip = Path("set/000-squat")
    for wrong, says in (("n_frames=7", "Too few frames"), ("view=3", "No such camera")):
        refused = toile("capture", "diagnose", "run=set", wrong)
        assert refused.status == 2
        assert says in refused.err
    assert not (clip / "diagnosis.json").exists()

    done = toile("capture", "diagnose", "run=set", *FAST)
    assert done.status == 0, done.err
    found = json.loads((clip / "diagnosis.json").read_text())
    assert found["answer"] in ("none", "ambiguous", *EFFECTS)
    assert set(found["effects"]) == set(EFFECTS)
    assert sum(found["probabilities"].values()) == pytest.approx(1)
    assert found["candidates"][0] == max(found["probabilities"], key=found["probabilities"].__getitem__)
    for values in found["effects"].values():
        assert values["low"] <= values["change"] <= values["high"]
    # The calibration is of other images, frames and steps, and the file says so.
    assert found["calibrated"] is False
    assert any(text.startswith("width: 32 instead of") for text in found["not_as_calibrated"])
    assert "uncalibrated" in done.out

    for image in clip.glob("views/*/garment_mask_*.png"):
        image.unlink()
    refused = toile("capture", "diagnose", "run=set/000-squat")
    assert refused.status == 2
    assert "garment" in refused.err
