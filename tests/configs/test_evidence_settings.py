"""Which settings of a diagnosis its calibration belongs to."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from toile.cli.configuration import CONF, instantiate, register_resolvers
from toile.cli.made_with import made_with_of
from toile.diagnosis.decision import Calibration
from toile.diagnosis.made_with import AFTER_MEASURING, NO_EVIDENCE
from toile.diagnosis.settings import DiagnosisSettings


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def use(*overrides: str, command: str = "diagnose"):
    return Calibration.load().use(made_with_of(compose(command, list(overrides))))


def test_the_shipped_calibration_is_for_the_default_settings() -> None:
    """If settings were added or changed on purpose: make it anew, see docs/diagnosis/usage.md."""
    found = use()
    assert found.differences == ()
    assert found.calibrated


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("diagnosis=quick", "diagnosis.sides: [14], calibrated with [20]"),
        ("diagnosis=fine", "diagnosis.sides: [20, 32], calibrated with [20]"),
        ("diagnosis.weights.predictive=40", "diagnosis.weights.predictive: 40, calibrated with 20"),
        ("diagnosis.attachment_slip.along=4", "diagnosis.attachment_slip.along: 4, calibrated with 5"),
        ("diagnosis.coarse=null", "diagnosis.coarse: null, calibrated with given"),
        ("simulator.longest_substep=0.01", "simulator.longest_substep: 0.01, calibrated with 0.02"),
        ("simulator/integrator=backward_euler", "BackwardEuler, calibrated with BDF2"),
        (
            "optimization.stages.track.term.blur=3",
            "optimization.stages.track.term.blur: 3, calibrated with 4",
        ),
        ("windows@optimization.stages.track.windows=whole_clip", "optimization.stages.track.windows"),
        ("~effect@candidates", "candidates"),
    ],
)
def test_other_settings_are_uncalibrated(override: str, named: str) -> None:
    if override.startswith("~"):
        override = "effect@candidates=[air_drag,shading]"
    found = use(override)
    assert not found.calibrated
    assert any(named in line for line in found.differences), found.differences


@pytest.mark.parametrize(
    "override",
    [
        "workers=7",
        "seed=5",
        "paths.outputs=/elsewhere",
        "scene=R1",
        "diagnosis.compared=1",
        "diagnosis.verdict.likely=0.6",
        "diagnosis.calibration=mine.json",
        "diagnosis.coarse.blur=10",
        "optimization.stages.calibrate=null",
        "cloth.areal_density=0.2",
    ],
)
def test_what_evidence_does_not_depend_on_does_not_matter(override: str) -> None:
    assert use(override).calibrated


def test_calibrate_means_the_settings_of_diagnose() -> None:
    for overrides in ((), ("diagnosis=quick", "simulator.longest_substep=0.01")):
        assert use(*overrides, command="calibrate") == use(*overrides)


def test_settings_that_do_not_matter_are_settings() -> None:
    """A name that nothing has would leave its setting out of nothing."""
    cfg = compose("diagnose")
    for name in (*NO_EVIDENCE, *AFTER_MEASURING):
        assert OmegaConf.select(cfg, name, default="missing") != "missing", name


def test_every_constant_reaches_its_settings() -> None:
    """Overrides as a user writes them, and nothing else changes."""
    changed = {
        "diagnosis.outline.strengths": (1.0, 2.0),
        "diagnosis.brightness.noise": 0.05,
        "diagnosis.exposure.fewest": 10,
        "diagnosis.attachment_slip.sway": (0.0, 0.5),
        "diagnosis.evidence.internal": (0.1, 0.2),
        "diagnosis.refits.least_score": -1.0,
        "diagnosis.prediction.failed": -2.0,
        "diagnosis.verdict.ahead": 5.0,
        "diagnosis.shooting.damping.stronger": 7.0,
        "diagnosis.shooting.tangents.fastest": 3.0,
        "diagnosis.widened": 3.0,
        "diagnosis.fewest_frames": 4,
    }
    written = {name: list(v) if isinstance(v, tuple) else v for name, v in changed.items()}
    overrides = [f"{name}={value}".replace(" ", "") for name, value in written.items()]
    settings = instantiate(compose("diagnose", overrides).diagnosis)
    for name, value in changed.items():
        found = settings
        for part in name.split(".")[1:]:
            found = getattr(found, part)
        assert found == value, name
    assert instantiate(compose("diagnose").diagnosis) == DiagnosisSettings()
