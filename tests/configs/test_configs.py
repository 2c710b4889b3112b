"""Every configuration file composes, and fits the signatures of what it builds."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from toile.cli.commands import COMMANDS
from toile.cli.configuration import CONF, instantiate, register_resolvers
from toile.generation.demo import DEMO, DEMO_TEXTURE_SIZE
from toile.generation.presets import SHAKEN, STANDARD, SWUNG

HYDRAS_OWN = {"_target_", "_partial_", "_convert_", "_recursive_"}
PLAIN = (str, int, float, bool, tuple)
# Groups and options whose point is to differ from the defaults.
DELTAS = (
    "ablation",
    "preset",
    "experiment",
    "debug",
    "fabric",
    "diagnosis=quick",
    "training=further",
    "diagnosis=fine",
    "blind=tiny",
    "blind=sessions",
    "capture",
    "backbone",
)
OPTIONS = sorted(
    f"{path.parent.relative_to(CONF).as_posix()}={path.stem}"
    for path in CONF.rglob("*.yaml")
    if path.parent not in (CONF, CONF / "hydra")
)
PRIMARY = sorted(path.stem for path in CONF.glob("*.yaml"))


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield


def overrides(option: str) -> list[str]:
    """How a user chooses it."""
    group, _, name = option.partition("=")
    match group.split("/"):
        case ["windows"]:
            return [f"windows@optimization.stages.track.windows={name}"]
        case ["fabric"]:
            return [f"fabric@garment.material={name}"]
        case ["simulator", "gradient"]:
            return ["simulator=surrogate", option]
        case ["stage"]:
            return [f"stage@stages.{name}={name}"]
        case ["domain", "stage"]:
            return ["domain=blender", option]
        case ["ablation_of", optimization]:
            return [f"optimization={optimization}", f"ablation={name}"]
    return [option]


@cache
def groups(command: str) -> frozenset[str]:
    """What a command lets choose, with the places where that goes."""
    cfg = compose(command, return_hydra_config=True)
    return frozenset(cfg.hydra.runtime.choices)


def composed(option: str) -> dict[str, DictConfig]:
    """The option in every command that has its group."""
    found = {}
    chosen = overrides(option)
    first = chosen[0].partition("=")[0]
    for command in PRIMARY:
        # Most commands lack most groups, and to be refused takes as long as to be composed.
        if first not in groups(command):
            continue
        try:
            found[command] = compose(command, chosen)
        except ConfigCompositionException as error:
            if "Could not override" not in str(error):
                raise
    return found


def targets(node: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    if isinstance(node, dict):
        if "_target_" in node:
            yield path, node
        for key, value in node.items():
            yield from targets(value, f"{path}.{key}".lstrip("."))


def mismatches(cfg: DictConfig, *, defaults: bool = True) -> list[str]:
    """What is wrong between the settings and the signatures (and defaults) of their targets."""
    wrong = []
    for path, node in targets(OmegaConf.to_container(cfg, resolve=False)):
        target = node["_target_"]
        parameters = dict(inspect.signature(get_object(target)).parameters)
        keys, ours = set(node) - HYDRAS_OWN, target.startswith("toile.")
        takes_all = [name for name, p in parameters.items() if p.kind is p.VAR_KEYWORD]
        if not takes_all:
            wrong += [f"{path}.{key}: {target} takes no such argument" for key in keys - set(parameters)]
        for name, parameter in parameters.items():
            default, value = parameter.default, node.get(name)
            # No setting hides in our code: what is built here is written out in full.
            needed = ours or default is parameter.empty
            if needed and name not in keys and not node.get("_partial_") and name not in takes_all:
                wrong.append(f"{path}.{name}: missing, an argument of {target}")
            value = tuple(value) if isinstance(value, list) else value
            plain = isinstance(value, PLAIN) and "${" not in str(value)
            compared = defaults and ours and name in keys and plain and isinstance(default, PLAIN)
            if compared and default != value:
                wrong.append(f"{path}.{name}: {value} here, {default} in the code")
    return wrong


def test_every_command_has_a_configuration() -> None:
    assert set(PRIMARY) == set(COMMANDS)


@pytest.mark.parametrize("command", PRIMARY)
def test_commands(command) -> None:
    assert mismatches(compose(command)) == []


@pytest.mark.parametrize("option", OPTIONS)
def test_options(option) -> None:
    found = composed(option)
    assert found, f"no command takes {option}"
    for command, cfg in found.items():
        assert mismatches(cfg, defaults=not option.startswith(DELTAS)) == [], command


@pytest.mark.parametrize("command", PRIMARY)
def test_hydras_part_composes(command) -> None:
    cfg = compose(command, return_hydra_config=True)
    assert "toile" in cfg.hydra.help.app_name
    assert cfg.hydra.job_logging.handlers.console.stream == "ext://sys.stderr"


@pytest.mark.parametrize("number", range(1, 10))
def test_published_scenes_differ_in_name_only(number) -> None:
    cfg = compose("fit", [f"scene=R{number}"])
    assert cfg.scene.name == f"R{number}"
    cfg.scene.name = "R1"
    assert cfg == compose("fit", ["scene=R1"])


def test_integrator_changes_nothing_else() -> None:
    base = OmegaConf.to_container(compose("fit"))
    other = OmegaConf.to_container(compose("fit", ["simulator/integrator=backward_euler"]))
    assert base != other
    assert isinstance(base, dict)
    assert isinstance(other, dict)
    other["simulator"]["build"]["integrator"] = base["simulator"]["build"]["integrator"]
    assert base == other


PRESETS = {"demo": DEMO, "standard": STANDARD, "swung": SWUNG, "shaken": SHAKEN}


def test_presets_are_those_of_the_package() -> None:
    """They have been checked there; the files repeat their numbers."""
    assert {path.stem for path in (CONF / "preset").glob("*.yaml")} == set(PRESETS)
    for name, settings in PRESETS.items():
        assert instantiate(compose("generate", [f"preset={name}"]).settings) == settings, name
    texture = compose("generate", ["preset=demo"]).texture
    assert (texture.height, texture.width, texture.seed) == (DEMO_TEXTURE_SIZE, DEMO_TEXTURE_SIZE, DEMO.seed)
