"""Ablations and experiments of ``toile fit``: each changes what it says and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from toile.cli.configuration import CONF, register_resolvers
from toile.reports.stiffness_note import stiffness_note

_FILE = "toile.scenes.texture_coordinates.from_file"
_TRACK = "optimization.stages.track"
# What an ablation means whatever the optimisation: the settings it changes, and what to; "*" stands for a
# whole choice of another group.
SHARED: dict[str, dict[str, Any]] = {
    "none": {},
    "surrogate": {"simulator.*": "simulator=surrogate"},
    "hybrid": {"simulator.*": "simulator=hybrid"},
    "backward_euler": {"simulator.*": "simulator/integrator=backward_euler"},
    "one_step_per_frame": {"simulator.substeps": 1},
    "uniform_rest_lengths": {"cloth.rest_lengths._target_": "toile.reconstruction.scene_cloth.uniform"},
    "uv_from_file": {"scene.texture_coordinates._target_": _FILE},
    "supersampled_renderer": {"renderer.supersampling": 2},
    "reference_renderer": {"renderer._target_": "toile.rendering.ReferenceRenderer"},
}
# What the others mean for each optimisation.
OF_OPTIMIZATION: dict[str, dict[str, dict[str, Any]]] = {
    "adam": {
        "no_silhouette": {"loss.silhouette": None},
        "no_force_regularization": {"loss.force_regularization": None},
        "no_turbulence": {"optimization.learning_rates.turbulence": None},
        "no_uv": {"optimization.learning_rates.texture_offset": None},
        "no_successive": {"optimization.first_frames": None},
    },
    "tracking": {
        "no_silhouette": {f"{_TRACK}.term.mask_weight": 0},
        "no_force_regularization": {
            f"{_TRACK}.priors.turbulence": 1000,
            f"{_TRACK}.priors.turbulence_time": 0,
            f"{_TRACK}.priors.turbulence_space": 0,
        },
        "no_turbulence": {f"{_TRACK}.priors.turbulence": None},
        "no_uv": {
            "scene.texture_coordinates._target_": _FILE,
            f"{_TRACK}.term.reference._target_": "toile.reconstruction.image_terms."
            "reference_image.drawn_template",
        },
        "no_successive": {
            f"{_TRACK}.windows.lag": None,
            f"{_TRACK}.windows.stride": None,
            f"{_TRACK}.windows.repeats": 6,
        },
        "no_calibration": {"optimization.stages.calibrate": None},
    },
}
CELLS = [
    (optimization, name, expected)
    for optimization, own in OF_OPTIMIZATION.items()
    for name, expected in (SHARED | own).items()
]


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def settings(*overrides: str) -> dict[str, Any]:
    """The composed configuration, flattened; references stay references."""

    def flatten(node: Any, prefix: str) -> dict[str, Any]:
        if not isinstance(node, dict):
            return {prefix: node}
        flat: dict[str, Any] = {}
        for key, value in node.items():
            flat.update(flatten(value, f"{prefix}.{key}".lstrip(".")))
        return flat

    return flatten(OmegaConf.to_container(compose("fit", ["scene=R1", *overrides]), resolve=False), "")


def changes(base: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Settings that differ; those below a term that was removed count as the term."""
    found = {k: other.get(k) for k in other.keys() | base.keys() if base.get(k, "-") != other.get(k, "-")}
    removed = [k for k, v in found.items() if v is None and k in other]
    below = tuple(f"{term}." for term in removed)
    return {k: v for k, v in found.items() if not k.startswith(below)}


def test_every_ablation_is_listed() -> None:
    dependent = set().union(*OF_OPTIMIZATION.values())
    assert {path.stem for path in (CONF / "ablation").glob("*.yaml")} == dependent | set(SHARED)
    for optimization, own in OF_OPTIMIZATION.items():
        assert {p.stem for p in (CONF / "ablation_of" / optimization).glob("*.yaml")} == set(own)


@pytest.mark.parametrize(("optimization", "name", "expected"), CELLS)
def test_an_ablation_changes_one_factor(optimization: str, name: str, expected: dict[str, Any]) -> None:
    base = settings(f"optimization={optimization}")
    found = changes(base, settings(f"optimization={optimization}", f"ablation={name}"))
    assert found.pop("ablation", "none") == name
    for key, value in list(expected.items()):
        if key.endswith(".*"):
            other = changes(base, settings(f"optimization={optimization}", str(value)))
            assert other
            assert {k.split(".")[0] for k in other} == {key.split(".")[0]}
            assert found == other
            return
    assert found == expected


@pytest.mark.parametrize("experiment", ["paper", "paper_network", "paper_network_short"])
@pytest.mark.parametrize("name", OF_OPTIMIZATION["adam"])
def test_an_ablation_of_the_papers_experiment_is_one_of_its_optimisation(experiment: str, name: str) -> None:
    base = f"experiment={experiment}"
    found = changes(settings(base), settings(base, f"ablation={name}"))
    assert found == {"ablation": name} | OF_OPTIMIZATION["adam"][name]


def test_the_papers_experiment_with_its_network_is_that_of_the_solver_but_for_the_simulator() -> None:
    by_hand = ("experiment=paper", "simulator=surrogate", "simulator/gradient=backprop")
    assert not changes(settings(*by_hand), settings("experiment=paper_network"))


def test_the_short_experiment_is_the_papers_but_for_its_length() -> None:
    whole = settings("experiment=paper_network")
    changed = changes(whole, settings("experiment=paper_network_short"))
    assert set(changed) == {"scene.n_frames", "optimization.cycles", "optimization.cycles_per_frame"}
    growing = changed["optimization.cycles_per_frame"] * (
        changed["scene.n_frames"] - whole["optimization.first_frames"]
    )
    assert 0 < growing < changed["optimization.cycles"], "every frame is covered before the end"


def test_an_ablation_that_an_optimisation_does_not_know_is_no_silent_repetition() -> None:
    for optimization, name in (("adam", "no_calibration"), ("identification", "no_silhouette")):
        cfg = compose("fit", overrides=[f"optimization={optimization}", f"ablation={name}"])
        assert OmegaConf.is_missing(cfg, "ablation")


def test_a_term_goes_by_one_override() -> None:
    removed = settings("optimization=adam", "loss.silhouette=null")
    assert changes(settings("optimization=adam"), removed) == {"loss.silhouette": None}


def test_a_term_the_default_optimisation_does_not_have_cannot_be_removed() -> None:
    with pytest.raises(ConfigCompositionException, match=r"loss\.silhouette"):
        settings("loss.silhouette=null")


def test_conventions_of_the_force_regularization_differ_as_documented() -> None:
    prefix = "loss.force_regularization."
    printed = settings("experiment=paper", "loss=paper")
    assert [printed[prefix + k] for k in ("alpha", "beta", "gamma")] == [1e-2, 1e-3, 1e-2]
    assert changes(printed, settings("experiment=paper", "loss=published_code")) == {
        f"{prefix}beta": 1e-2,
        f"{prefix}gamma": 1e-3,
        f"{prefix}reduction": "mean",
    }
    for adam in ("experiment=paper", "optimization=adam"):
        assert settings(adam)[prefix + "reduction"] == "mean"


def test_paper_experiment() -> None:
    paper = settings("experiment=paper")
    assert paper["optimization._target_"].endswith("SuccessiveFramesAdam")
    assert paper["simulator.build.integrator._target_"].endswith("BackwardEuler")
    assert paper["simulator.substeps"] == 1
    assert paper["cloth.rest_lengths._target_"].endswith("uniform")
    assert paper["scene.texture_coordinates._target_"].endswith("from_file")
    assert [paper[f"parameters.{k}"] for k in ("stretching", "shearing", "bending")] == [3000, 8, 0.5]
    rates = "optimization.learning_rates."
    assert [paper[rates + k] for k in ("stretching", "shearing", "bending")] == [50, 0.1, 0.01]
    assert [paper[rates + k] for k in ("wind", "turbulence", "texture_offset")] == [0.05, 1e-3, 2e-4]
    assert paper["optimization.cycles"] == 250
    assert paper["optimization.first_frames"] == 10
    assert paper["optimization.cycles_per_frame"] == 5
    regularization = "loss.force_regularization."
    assert [paper[regularization + k] for k in ("alpha", "beta", "gamma")] == [1e-2, 1e-2, 1e-3]
    assert paper[regularization + "reduction"] == "mean"


def test_the_surrogate_has_two_derivatives() -> None:
    """And no other simulator has a choice."""
    through = settings("simulator=surrogate", "simulator/gradient=backprop")
    kinds = changes(settings("simulator=surrogate", "simulator/gradient=implicit"), through)
    assert list(kinds) == ["simulator.build.gradient._target_"]
    with pytest.raises(ConfigCompositionException, match="simulator/gradient"):
        settings("simulator=implicit", "simulator/gradient=backprop")


def test_pages_know_what_the_stiffness_of_a_recipe_is_worth() -> None:
    def note(*overrides: str) -> str:
        cfg = compose("fit", ["scene=R1", *overrides])
        return stiffness_note({"optimization": OmegaConf.to_container(cfg.optimization, resolve=False)})

    for free in ((), ("optimization=adam",), ("experiment=paper",)):
        assert "no measurement" in note(*free)
        assert "optimization=identification measures it" in note(*free)
    assert "a measurement where gravity and steady wind" in note("optimization=identification")
    assert "was not fitted" in note("optimization.stages.calibrate=null")
    assert "no measurement" not in note("optimization=adam", "optimization.learning_rates.turbulence=null")


def test_the_first_pass_of_the_default_recipe_can_be_left_out() -> None:
    """It takes its settings from the second one, so one override removes it and one changes both."""
    without = compose("fit", overrides=["optimization.stages.calibrate=null"]).optimization.stages
    assert without.calibrate is None
    assert without.track.windows.lag == 6
    longer = compose("fit", overrides=["optimization.stages.track.windows.lag=9"]).optimization.stages
    assert longer.calibrate.windows.lag == 9


def apart_from_callbacks(base: str, other: str) -> dict[str, Any]:
    return {
        key: value
        for key, value in changes(settings(base), settings(other)).items()
        if not key.startswith("callbacks.")
    }


def test_the_stability_experiment_is_the_papers_but_for_its_length() -> None:
    assert apart_from_callbacks("experiment=paper", "experiment=stability") == {"optimization.cycles": 10000}


def test_the_stability_of_the_default_recipe_is_tested_by_more_passes() -> None:
    track = "optimization.stages.track.windows"
    changed = apart_from_callbacks("optimization=tracking", "experiment=stability_tracking")
    assert {k: v for k, v in changed.items() if not k.startswith("optimization.stages.calibrate.")} == {
        f"{track}.repeats": 79
    }
    usual = compose("fit", []).optimization.stages
    longer = compose("fit", ["experiment=stability_tracking"]).optimization.stages
    assert longer.calibrate.windows == usual.calibrate.windows
    # One pass of calibration and one of tracking is what a fit does.
    assert 1 + longer.track.windows.repeats == 40 * (1 + usual.track.windows.repeats)
    # Both passes still take their windows from one place.
    wider = compose("fit", ["experiment=stability_tracking", f"{track}.lag=9"]).optimization.stages
    assert wider.calibrate.windows.lag == 9


@pytest.mark.parametrize(
    ("override", "order"),
    [
        ("optimization=tracking", ["calibrate", "track"]),
        ("experiment=stability_tracking", ["calibrate", "track"]),
        ("optimization=identification", ["calibrate", "track", "match", "polish"]),
    ],
)
def test_stages_run_in_the_order_they_are_meant_to(override: str, order: list[str]) -> None:
    """They run as composed, and a group that is put into one of them could come before the others."""
    assert list(compose("fit", [override]).optimization.stages) == order
