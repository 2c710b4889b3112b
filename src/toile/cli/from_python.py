"""The commands as functions of Python call them: the same configurations, the same messages, no terminal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.errors import HydraException, InstantiationException
from hydra.utils import get_object
from omegaconf import DictConfig, open_dict, read_write

from toile.cli.configuration import CONF
from toile.cli.failures import explain
from toile.cli.path_arguments import quoted
from toile.cli.settings import check_settings
from toile.cli.shown import composed
from toile.cli.suggestions import suggestion
from toile.effects.base import Effect
from toile.errors import InputError
from toile.physics.simulator import SimulationError

Settings = Mapping[str, object] | Sequence[str] | None
"""Settings of a command: ``{"optimization.stages.track.iterations": 2}``, or a list of ``key=value``."""

_PUBLISHED_SCENES = {path.stem for path in CONF.glob("scene/*.yaml")} - {"native", "phi_sft"}


def overrides(settings: Settings) -> list[str]:
    """Settings in Hydra's grammar, as they would stand on the command line.

    Args:
        settings: names with values, where a mapping as value means the settings below that name; or texts
            ``key=value`` that are taken as they are.

    Raises:
        InputError: a value that no setting can have, or a text without "=".
    """
    if settings is None:
        return []
    if isinstance(settings, Mapping):
        return [line for key, value in settings.items() for line in _lines(str(key), value)]
    texts = [settings] if isinstance(settings, str) else list(settings)
    for text in texts:
        if not isinstance(text, str) or ("=" not in text and not text.startswith("~")):
            raise InputError(
                "A setting cannot be understood",
                where="settings",
                expected='a mapping such as {"seed": 1}, or a list of texts key=value',
                got=repr(text),
            )
    return texts


def scene_overrides(name: str | Path) -> list[str]:
    """A scene by its name in the data folder or its own folder, as overrides."""
    if str(name) in _PUBLISHED_SCENES:
        return [f"scene={name}"]
    return ["scene=native", f"scene.name={quoted(str(name))}"]


def effect_overrides(effects: Sequence[Effect], group: str) -> list[str]:
    """Effects written in Python, as overrides that make the same ones.

    Args:
        effects: with the numbers they have.
        group: where they belong: "effect" or "candidates".

    Raises:
        InputError: an effect that its module, name and values alone do not make again.
    """
    found = []
    for effect in effects:
        if not isinstance(effect, Effect):
            raise InputError(
                "This is no effect",
                where="effects",
                expected="instances of subclasses of toile.effects.base.Effect",
                got=repr(effect),
            )
        kind = type(effect)
        target = f"{kind.__module__}.{kind.__qualname__}"
        values = {p.name: float(v) for p, v in zip(effect.parameters, effect.values, strict=True)}
        if not _is_made_by(effect, target, values):
            raise InputError(
                f"{effect.NAME} cannot be stored in a configuration",
                where="effects",
                expected="a class at the top of a module, whose only argument is values; others by settings, "
                'such as {"effect": "gusts", "effect.gusts.n_modes": 3}',
                got=target,
            )
        made = _value({"_target_": target, "values": values}, effect.NAME)
        found.append(f"+{group}.{effect.NAME}={made}")
    return found


@contextmanager
def called(command: str, arguments: Sequence[str], folder: Path | None = None) -> Iterator[DictConfig]:
    """The checked configuration of a command, while Hydra knows of it as in a run of that command.

    Args:
        command: its name.
        arguments: overrides, in Hydra's grammar.
        folder: of the run; None for the one that the configuration names.

    Raises:
        InputError: a setting is unknown or of no use; also in place of Hydra's own errors in the block.
    """
    given = [*arguments, *([] if folder is None else [f"hydra.run.dir={quoted(str(folder))}"])]
    with _hydra_of_its_own(), _plain_errors(command, given):
        whole = composed(command, given).cfg
        with read_write(whole.hydra), open_dict(whole.hydra):
            whole.hydra.runtime.output_dir = str(Path(str(whole.hydra.run.dir)).absolute())
        HydraConfig.instance().set_config(whole)
        cfg = deepcopy(whole)
        with read_write(cfg), open_dict(cfg):
            del cfg["hydra"]
        check_settings(cfg)
        yield cfg


@contextmanager
def _hydra_of_its_own() -> Iterator[None]:
    """Hydra keeps what it is working on in singletons; the caller may be such a work."""
    # get_state() copies everything there is and looks for plugins again, which takes longer than composing.
    kinds: tuple[type, ...] = (GlobalHydra, HydraConfig)
    instances = Singleton._instances
    outer = {kind: instances.pop(kind) for kind in kinds if kind in instances}
    try:
        yield
    finally:
        for kind in kinds:
            instances.pop(kind, None)
        instances.update(outer)


def names_in(cfg: DictConfig, group: str) -> list[str]:
    """Names of the effects that a part of a configuration holds."""
    return [str(name) for name, effect in (cfg.get(group) or {}).items() if effect is not None]


def setting_name(override: str) -> str:
    """The setting that an override is for."""
    return override.lstrip("+~").partition("=")[0].partition("@")[0]


@contextmanager
def _plain_errors(command: str, given: Sequence[str]) -> Iterator[None]:
    try:
        yield
    except (InputError, SimulationError):
        raise
    except Exception as error:
        # A choice that there is none of is an OSError to Hydra.
        if isinstance(error, OSError) and not isinstance(error, HydraException):
            raise
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, InputError | SimulationError):
                raise cause from cause.__cause__
            cause = cause.__cause__
        failure = explain(error)
        if failure is None:
            raise
        known = isinstance(error, HydraException) and not isinstance(error, InstantiationException)
        hint = suggestion(error, command, list(given)) if known else ""
        raise InputError(
            f"The settings do not fit toile {command}",
            where=", ".join(given) or "none given",
            expected=f"settings as `toile {command} --help` lists them",
            got=" ".join((failure.message.removeprefix("error: ") + hint).split()),
        ) from error


def _is_made_by(effect: Effect, target: str, values: Mapping[str, float]) -> bool:
    try:
        kind = get_object(target)
        again = kind(values=dict(values))
    except Exception:  # whatever a constructor of somebody else's raises, it does not make this effect
        return False
    if kind is not type(effect):
        return False
    mine, its = vars(effect).copy(), vars(again).copy()
    return torch.equal(mine.pop("values"), its.pop("values")) and mine == its


def _lines(key: str, value: object) -> Iterator[str]:
    # "+a.b" adds a whole part; a mapping below a known name changes what it names.
    if isinstance(value, Mapping) and value and not key.startswith("+"):
        for name, item in value.items():
            yield from _lines(f"{key}.{name}", item)
    else:
        yield f"{key}={_value(value, key)}"


def _value(value: object, key: str) -> str:
    """A value in Hydra's grammar."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str | Path):
        return quoted(str(value))
    plain: Any = getattr(value, "tolist", None)  # of NumPy and PyTorch
    if callable(plain):
        return _value(plain(), key)
    if isinstance(value, Mapping):
        text = ",".join(f"{name}:{_value(item, f'{key}.{name}')}" for name, item in value.items())
        return f"{{{text}}}"
    if not isinstance(value, list | tuple):
        raise InputError(
            "A setting cannot have such a value",
            where=key,
            expected="a number, a text, a path, true or false, None, or lists and mappings of these",
            got=repr(value)[:100],
        )
    return f"[{','.join(_value(item, key) for item in value)}]"
