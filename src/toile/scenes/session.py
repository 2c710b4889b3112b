"""A session: several clips of one cloth, in a folder with ``session.yaml``.

::

    name: tablecloth
    clips:
      - scene: release          # folder of a native scene, relative to session.yaml
        motion: release         # what was done: hang or release (nobody moved the corners), release or
                                # fan_off (no wind), shake, sway, turned; any other word is for people alone
        device: phone           # clips with the same one share camera, frame rate and gravity's direction
        changed: []             # since the clip before, for people: fan, grip, turned, ...
      - scene: shake
        motion: shake
        device: phone
    plumb_line: false           # gravity was measured by a plumb line in view: it is not tilted
    clock: false                # the frame rate was checked with a clock in view: it is right

Only ``clips`` with their ``scene`` are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from toile.atomic_file import write_text
from toile.errors import InputError
from toile.json_file import place

SESSION_FILE = "session.yaml"
DEVICE = "camera"
"""Of clips that name none."""


@dataclass(frozen=True)
class SessionClip:
    """One clip of a session.

    Attributes:
        folder: of its native scene.
        motion: what was done.
        device: that filmed it.
        changed: since the clip before.
    """

    folder: Path
    motion: str = ""
    device: str = DEVICE
    changed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Session:
    """Several clips of one cloth.

    Attributes:
        name: of the session.
        clips: in the order of recording, one or more.
        plumb_line: whether gravity was measured by one.
        clock: whether the frame rate was checked with one.
    """

    name: str
    clips: tuple[SessionClip, ...]
    plumb_line: bool = False
    clock: bool = False

    @property
    def clip_names(self) -> tuple[str, ...]:
        """A name for every clip: its folder's, with those above it where several are called alike."""
        parts = [clip.folder.resolve().parts for clip in self.clips]
        for kept in range(1, max(map(len, parts), default=0) + 1):
            names = tuple("/".join(part[-kept:]) for part in parts)
            if len(set(names)) == len(names):
                break
        return names


def load_session(folder: Path | str) -> Session:
    """Read the session in a folder; its scenes are not looked at.

    Args:
        folder: with session.yaml, or the path of that file.

    Raises:
        InputError: there is no such file, or anything in it is wrong.
    """
    path = Path(folder).expanduser()
    path = path if path.name == SESSION_FILE else path / SESSION_FILE
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _KeysOnce)
        found = _File.model_validate(values)
    except OSError as error:
        raise _wrong(path, f"{type(error).__name__}: {error.strerror or error}") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise _wrong(path, " ".join(str(error).split())[:200]) from error
    except ValidationError as error:
        first = error.errors()[0]
        at = place(first["loc"]) or "the file"
        if first["type"] == "extra_forbidden":
            keys = _Clip.model_fields if len(first["loc"]) > 1 else _File.model_fields
            raise _wrong(path, at, f"no other keys than {', '.join(keys)}") from error
        if first["type"] == "model_type":
            raise _wrong(path, f"{at}: {first['input']!r}"[:100]) from error
        said = first["msg"].removeprefix("Input should be ")
        raise _wrong(path, f"{at}: {first['input']!r}"[:100], said) from error
    clips = tuple(
        SessionClip(path.parent / clip.scene, clip.motion, clip.device, tuple(clip.changed))
        for clip in found.clips
    )
    for index, clip in enumerate(clips):
        if not (clip.folder / "scene.json").is_file():
            raise InputError(
                "A clip of the session is not there",
                where=f"{path}: clips[{index}].scene",
                expected="the folder of a native scene, relative to the session's file",
                got=f"no scene.json in {clip.folder}",
            )
    folders = [clip.folder.resolve() for clip in clips]
    for index, place_of in enumerate(folders):
        if place_of in folders[:index]:
            # Its evidence would count twice.
            raise InputError(
                "A clip is in the session twice",
                where=f"{path}: clips[{index}].scene",
                expected="every recording once",
                got=f"{clips[index].folder}, which is clips[{folders.index(place_of)}] as well",
            )
    return Session(found.name or path.parent.resolve().name, clips, found.plumb_line, found.clock)


def write_session(session: Session, folder: Path) -> Path:
    """Write ``session.yaml``; clips must lie within the folder.

    Returns:
        Path of the file.
    """
    values = {
        "name": session.name,
        "clips": [
            {
                "scene": str(clip.folder.relative_to(folder)),
                "motion": clip.motion,
                "device": clip.device,
                "changed": list(clip.changed),
            }
            for clip in session.clips
        ],
        "plumb_line": session.plumb_line,
        "clock": session.clock,
    }
    path = folder / SESSION_FILE
    return write_text(path, yaml.safe_dump(values, sort_keys=False))


class _Clip(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    scene: str = Field(min_length=1)
    motion: str = ""
    device: str = DEVICE
    changed: list[str] = []


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    name: str = ""
    clips: list[_Clip] = Field(min_length=1)
    plumb_line: bool = False
    clock: bool = False


_EXPECTED = "clips: a list of entries with scene: <folder of a native scene>; see docs/diagnosis/usage.md"


def _wrong(path: Path, got: str, expected: str = _EXPECTED) -> InputError:
    return InputError("No session can be read", where=str(path), expected=expected, got=got)


class _KeysOnce(yaml.SafeLoader):
    """Refuses a key that is given twice: the second clip of an entry without its dash replaced the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        twice = next((key for key in keys if keys.count(key) > 1), None)
        if twice is not None:
            raise yaml.constructor.ConstructorError(
                None, None, f"'{twice}' is given twice; every clip begins with a dash", node.start_mark
            )
        return super().construct_mapping(node, deep)
