"""``toile capture data``: motions of one's own, and what it says before it makes anything."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from toile.capture.data.estimate import Estimate
from toile.capture.motion.source import MotionFiles
from toile.errors import InputError

TINY = (
    "preset=tiny",
    "folder=set",
    "settings.n_frames=3",
)

BVH = """HIERARCHY
ROOT Hips
{{
  OFFSET 0 90 0
  CHANNELS 3 Xposition Yposition Zposition
  JOINT LeftUpLeg
  {{
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {{
      OFFSET 0 -42 0
      CHANNELS 0
      JOINT LeftFoot
      {{
        OFFSET 0 -42 0
        CHANNELS 0
        End Site
        {{
          OFFSET 0 -6 10
        }}
      }}
    }}
  }}
  JOINT RightUpLeg
  {{
    OFFSET -10 0 0
    CHANNELS 0
    JOINT RightLeg
    {{
      OFFSET 0 -42 0
      CHANNELS 0
      JOINT RightFoot
      {{
        OFFSET 0 -42 0
        CHANNELS 0
      }}
    }}
  }}
  JOINT LeftArm
  {{
    OFFSET 18 50 0
    CHANNELS 0
    JOINT LeftForeArm
    {{
      OFFSET 28 0 0
      CHANNELS 0
      JOINT LeftHand
      {{
        OFFSET 25 0 0
        CHANNELS 0
      }}
    }}
  }}
  JOINT RightArm
  {{
    OFFSET -18 50 0
    CHANNELS 0
    JOINT RightForeArm
    {{
      OFFSET -28 0 0
      CHANNELS 0
      JOINT RightHand
      {{
        OFFSET -25 0 0
        CHANNELS 0
      }}
    }}
  }}
}}
MOTION
Frames: {frames}
Frame Time: 0.0333333
{rows}
"""


def step_to_the_side(path: Path, frames: int = 3) -> Path:
    """The left leg turns outwards by 20 degrees while the hips go 10 cm to the left."""
    share = np.linspace(0.0, 1.0, frames)
    rows = "\n".join(f"{10 * s:.4f} 90 0 {20 * s:.4f} 0 0" for s in share)
    path.write_text(BVH.format(frames=frames, rows=rows))
    return path


def test_a_motion_of_ones_own_makes_a_clip(toile) -> None:
    step_to_the_side(Path("aside.bvh"))
    asked = (*TINY, "motion=file", "motion.path=aside.bvh", "settings.n_frames=18")
    made = toile("capture", "data", *asked)
    assert made.status == 0, made.err
    with np.load("set/000-aside/truth.npz") as truth:
        body = truth["body_positions"]
        assert len(body) == 18
        # The passage from rest comes first; at the end of it the hips have moved.
        assert np.abs(body[-1] - body[0]).max() > 0.05
        assert truth["converged"].mean() > 0.98
    assert list(json.loads(Path("set/data.json").read_text())["motion_files"]) == ["aside"]
    step_to_the_side(Path("aside.bvh"), frames=4)
    other = toile("capture", "data", *asked)
    assert other.status == 2
    assert "another motion_files" in other.err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("motion=file", "motion.path=nothing.bvh"), "nothing.bvh"),
        (("motion=file", "motion.path=aside.bvh", "settings.motions=[walk]"), "Unknown motion"),
        (("motion=file", "motion.path=aside.bvh", "settings.n_frames=500"), "too short"),
        (("motion=file", "motion.path=[aside.bvh,aside.bvh]"), "names"),
        (("motion=file", "motion.path=torn.bvh"), "torn.bvh"),
        (("motion=file",), "motion.path"),
    ],
)
def test_what_is_wrong_with_a_motion_is_said_before_anything_is_made(
    toile, arguments: tuple[str, ...], says: str
) -> None:
    file = step_to_the_side(Path("aside.bvh"))
    Path("torn.bvh").write_text(file.read_text()[:200])
    outcome = toile("capture", "data", *TINY, *arguments)
    assert outcome.status == 2, outcome.err
    assert says in outcome.err
    assert "Traceback" not in outcome.err
    assert not Path("set").exists()


def test_names_of_motion_files_differ() -> None:
    assert list(MotionFiles(["a/walk.bvh", "b/run.glb"]).names) == ["walk", "run"]
    with pytest.raises(InputError, match="names"):
        MotionFiles(["a/walk.bvh", "b/walk.glb"])


@pytest.mark.parametrize(("preset", "images"), [("standard", 17600), ("paper", 356400)])
def test_large_presets_say_what_they_would_make(toile, preset: str, images: int) -> None:
    said = toile("capture", "data", f"preset={preset}", "folder=set", "dry_run=true")
    assert said.status == 0, said.err
    assert f"{images:,} images" in said.out
    vertices = [int(n.replace(",", "")) for n in re.findall(r"(?:garment|truth) ([\d,]+)", said.out)]
    assert vertices[1] > 1.4 * vertices[0] > 1000
    assert re.search(r"time: about [\d.]+ (min|h) on one core", said.out)
    assert re.search(r"disk: about [\d,]+ MB", said.out)
    assert not Path("set").exists()


def test_a_dry_run_is_of_data_only(toile) -> None:
    refused = toile("capture", "page", "run=set", "dry_run=true")
    assert refused.status == 2
    assert "dry_run" in refused.err


def test_estimates_grow_with_what_is_made() -> None:
    """The demo took 32 s; twice the clips take twice as much, a finer truth more than in proportion."""
    demo = Estimate(2, 40, 4, 128, 5, 13718, 446, 580)
    assert demo.seconds == pytest.approx(32, rel=0.2)
    double = replace(demo, clips=4)
    assert double.seconds == pytest.approx(2 * demo.seconds)
    assert double.size == pytest.approx(2 * demo.size)
    fine, finer = (replace(demo, true_vertices=n, views=0).seconds for n in (4000, 8000))
    assert finer > 2.2 * fine
    assert replace(demo, simulated=False).seconds is None
    assert "not known" in replace(demo, simulated=False).lines()[2]
