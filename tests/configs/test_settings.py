"""Every setting is checked against its declaration, and every number of a configuration has one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.utils import get_object
from omegaconf import OmegaConf, open_dict

from toile.cli.commands import COMMANDS
from toile.cli.configuration import CONF, instantiate, register_resolvers
from toile.cli.settings import COMMAND_SETTINGS, _annotations, check_settings, describe
from toile.errors import InputError
from toile.limits import Count, Fraction, Positive, Unit

NEEDED = {
    "masks": ["video=clip.mp4"],
    "template": ["surface.file=scan.ply"],
    "blind": ["name=set", "action=make"],
    "subject": ["file=person.npz"],
    "garment": ["file=skirt.npz"],
    **{command: ["run=folder"] for command in ("evaluate", "report", "tables", "export")},
}
OF_SCENES = ("fit", "diagnose", "masks", "template", "doctor")
# Hydra's own run folder is not known outside a run; nothing below these is a number.
OF_THE_RUN = ("training_name", "callbacks", "logger")


@pytest.fixture(autouse=True)
def _hydra() -> Iterator[None]:
    register_resolvers()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield
    HydraConfig.instance().cfg = None


def composed(command: str, *overrides: str) -> Any:
    scene = ["scene=native", "scene.name=tiny"] if command in OF_SCENES else []
    cfg = compose(command, [*scene, *NEEDED.get(command, []), *overrides])
    with open_dict(cfg):
        for key in OF_THE_RUN:
            if key in cfg:
                cfg[key] = None
    return cfg


@pytest.mark.parametrize("command", COMMANDS)
def test_what_the_files_say_is_allowed(command: str) -> None:
    check_settings(composed(command))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_number_and_switch_has_a_declaration(command: str) -> None:
    """An argument of something that is built, or an entry in COMMAND_SETTINGS."""

    def numbers(node: Any, place: str) -> Iterator[str]:
        if isinstance(node, dict):
            target = str(node.get("_target_", ""))
            ours = target.startswith("toile.")
            declared = _annotations(target) if ours else {}
            for key, value in node.items():
                foreign = target and not ours and not isinstance(value, dict)
                built = isinstance(value, dict) and "_target_" in value
                if not key.startswith("_") and not foreign and (key not in declared or built):
                    yield from numbers(value, f"{place}.{key}".lstrip("."))
        elif isinstance(node, int | float):
            yield place

    cfg = OmegaConf.to_container(composed(command), resolve=True)
    missing = [place for place in numbers(cfg, "") if place not in COMMAND_SETTINGS]
    # false or true is all that export asks of its texture; for generate it is what is printed on the cloth.
    assert missing == (["texture"] if command == "export" else [])


def test_annotations_of_all_that_is_built_are_known() -> None:
    targets = {
        line.split(":", 1)[1].split("#")[0].strip()
        for path in CONF.rglob("*.yaml")
        for line in path.read_text(encoding="utf-8").splitlines()
        if line.strip().startswith("_target_: toile.")
    }
    assert len(targets) > 60
    for target in targets:
        assert callable(get_object(target))
        assert all(map(describe, _annotations(target).values())), target


BAD = [
    ("fit", "parameters.stretching=-1", "parameters.stretching", "a number > 0 [network units]", "-1"),
    ("fit", "parameters.stretching=0", "parameters.stretching", "a number > 0", "0"),
    ("fit", "parameters.shearing=nan", "parameters.shearing", "a number > 0", "nan"),
    ("fit", "parameters.bending=inf", "parameters.bending", "a number > 0", "inf"),
    ("fit", "parameters.bending=stiff", "parameters.bending", "a number > 0", "the text 'stiff'"),
    ("fit", "parameters.bending=null", "parameters.bending", "a number > 0", "null"),
    ("fit", "cloth.areal_density=-0.15", "cloth.areal_density", "a number > 0 [kg/m²]", "-0.15"),
    ("fit", "simulator.substeps=0", "simulator.substeps", "a whole number >= 1 [per frame], or null", "0"),
    ("fit", "simulator.substeps=1.5", "simulator.substeps", "a whole number >= 1", "1.5"),
    ("fit", "simulator.longest_substep=0", "simulator.longest_substep", "a number > 0 [s]", "0"),
    ("fit", "simulator.build.newton.tolerance=0", "simulator.build.newton.tolerance", "a number > 0", "0"),
    ("fit", "optimization.stages.track.windows.lag=0", "windows.lag", "a whole number >= 1 [frames]", "0"),
    ("fit", "optimization.stages.track.term.per_side=1", "term.per_side", "a whole number >= 2", "1"),
    ("fit", "optimization.stages.track.visibility=2", "track.visibility", "true or false", "2"),
    ("fit", "report.video=maybe", "report.video", "true or false", "the text 'maybe'"),
    ("fit", "report.pictures=0", "report.pictures", "a whole number >= 1", "0"),
    ("fit", "seed=-1", "seed", "a whole number >= 0", "-1"),
    ("fit", "seed=one", "seed", "a whole number >= 0", "the text 'one'"),
    ("fit", "scene.n_frames=0", "scene.n_frames", "a whole number >= 1 [frames], or null", "0"),
    ("fit", "scene.gravity=[0,9.81,down]", "scene.gravity", "a list of 3, each a number [m/s²]", "down"),
    ("fit", "scene.gravity=[0,9.81]", "scene.gravity", "a list of 3, each a number [m/s²], or null", "9.81"),
    (
        "train",
        "training.widths=[]",
        "training.widths",
        "a list of at least 1, each a whole number >= 1",
        "[]",
    ),
    ("fit", "scene.fps=nan", "scene.fps", "a number > 0 [1/s], or null", "nan"),
    ("diagnose", "workers=0", "workers", "a whole number >= 1 [processes], or -1", "0"),
    ("generate", "settings.n_frames=1", "settings.n_frames", "a whole number >= 2 [frames]", "1"),
    ("generate", "settings.cloth_size=[0.6]", "settings.cloth_size", "a list of 2: a number > 0 [m]", "(0.6"),
    ("train", "training.batch_size=0", "training.batch_size", "a whole number >= 1", "0"),
    ("train", "max_minutes=-1", "max_minutes", "a number >= 0 [min], or null", "-1"),
    ("fit", "simulator.largest_time_error=-1", "simulator.largest_time_error", "a number > 0 [s]", "-1"),
    ("masks", "times=guessed", "times", "recorded, uniform", "the text 'guessed'"),
    (
        "masks",
        "uniform_tolerance=0.5",
        "uniform_tolerance",
        "a number >= 0 and < 0.5 [of the interval]",
        "0.5",
    ),
    ("masks", "every=0", "every", "a whole number >= 1 [frames]", "0"),
    ("template", "minimum_iou=2", "minimum_iou", "a number >= 0 and <= 1", "2"),
    ("evaluate", "n_frames=0", "n_frames", "a whole number >= 1 [frames], or null", "0"),
    ("report", "pictures=many", "pictures", "a whole number >= 0 [frames]", "the text 'many'"),
    ("blind", "out_of_family.fps=-25", "out_of_family.fps", "a number > 0 [1/s]", "-25"),
    ("blind", "alias=1.5", "alias", "a number >= 0 and <= 1", "1.5"),
]


@pytest.mark.parametrize(("command", "override", "name", "expected", "got"), BAD)
def test_a_bad_value_is_named(command: str, override: str, name: str, expected: str, got: str) -> None:
    with pytest.raises(InputError) as caught:
        check_settings(composed(command, override))
    error = caught.value
    assert name in error.where
    assert expected in error.expected
    assert got.strip("(") in error.got


def test_what_is_built_alone_is_checked_too() -> None:
    """Stored configurations of a run do not pass by a command line."""
    cfg = composed("fit")
    cfg.optimization.stages.track.windows.stride = 0
    with pytest.raises(InputError, match=r"windows.stride|stride"):
        instantiate(cfg.optimization)


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (Annotated[Positive, Unit("kg")], "a number > 0 [kg]"),
        (Fraction | None, "a number >= 0 and <= 1, or null"),
        (tuple[Count, Count], "a list of 2: a whole number >= 1; a whole number >= 1"),
        (tuple[Count, ...], "a list, each a whole number >= 1"),
    ],
)
def test_kinds_in_words(kind: Any, text: str) -> None:
    assert describe(kind) == text
