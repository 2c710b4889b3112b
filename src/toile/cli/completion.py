"""``toile completion bash|zsh|fish``: commands, settings, choices and files at the press of the tab key.

Hydra's own completion (-sc) belongs to one application, and ``toile`` is one for each command. The scripts
printed here ask ``toile completion words ...``, which loads nothing that computes.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from toile.cli.commands import COMMANDS
from toile.cli.main import RESUMABLE

_FLAGS = ("--help", "--cfg", "--resolve", "--multirun", "--info", "--config-dir", "--package", "--hydra-help")
_AFTER_FLAG = {
    **dict.fromkeys(("--cfg", "-c"), ("job", "hydra", "all")),
    **dict.fromkeys(
        ("--info", "-i"), ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
    ),
}
_FILE_FLAGS = ("--config-dir", "-cd", "--config-path", "-cp")
_OPEN_ENDS = ("=", ".", "/")
"""A candidate that ends so is not finished: no space after it."""
_SPECIAL = frozenset(" \t\\'\"()[]{}<>|&;$`!*?#~")
"""Characters that bash takes for something else unless they are escaped."""

_BASH = r"""_toile_complete() {
    local found
    COMPREPLY=()
    while IFS= read -r found; do
        COMPREPLY+=("$found")
    done < <(toile completion line "${COMP_LINE:0:COMP_POINT}" "$COMP_WORDBREAKS" 2>/dev/null)
}
complete -o nospace -F _toile_complete toile
"""
_ZSH = r"""_toile_complete() {
    local found
    local -a finished unfinished
    while IFS= read -r found; do
        case $found in
            *[=./]) unfinished+=("$found") ;;
            *) finished+=("$found") ;;
        esac
    done < <(toile completion words "${(@Q)words[2,CURRENT]}" 2>/dev/null)
    compadd -S '' -a unfinished
    compadd -a finished
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _toile_complete toile
"""
_FISH = r"""function __toile_complete
    set -l before (commandline -opc)
    set -l current (commandline -ct | string unescape)
    test (count $current) -eq 0; and set current ''
    toile completion words $before[2..-1] $current 2>/dev/null
end
complete -c toile -f -a '(__toile_complete)'
"""
SCRIPTS = {"bash": _BASH, "zsh": _ZSH, "fish": _FISH}
INSTALL = {
    "bash": 'eval "$(toile completion bash)"  # in ~/.bashrc',
    "zsh": 'eval "$(toile completion zsh)"  # in ~/.zshrc',
    "fish": "toile completion fish | source  # in ~/.config/fish/config.fish",
}


def completion(arguments: Sequence[str]) -> int:
    """Print a script for a shell, or answer one; returns the exit status."""
    match list(arguments):
        case [shell] if shell in SCRIPTS:
            print(SCRIPTS[shell], end="")
        case ["words", *words]:
            for word in candidates(words):
                print(word)
        case ["line", line, breaks]:
            for word in _candidates_for_bash(line, breaks):
                print(word)
        case []:
            print("\n".join(INSTALL.values()))
        case _:
            said = " ".join(arguments)
            print(f"error: completion for {', '.join(SCRIPTS)}; got {said!r}", file=sys.stderr)
            return 2
    return 0


def candidates(words: Sequence[str]) -> list[str]:
    """What the last word may become.

    Args:
        words: of the command line after ``toile``, up to the cursor; the last one may be "".

    Returns:
        Whole words, sorted; those that end in "=", "." or "/" go on.
    """
    *before, word = words or [""]
    if not before:
        found: Iterable[str] = [
            *COMMANDS,
            "completion",
            *(["--help", "--version"] if word[:1] == "-" else []),
        ]
    elif before[0] == "completion":
        found = SCRIPTS if len(before) == 1 else ()
    elif before[0] not in COMMANDS:
        found = ()
    elif before[-1] in _AFTER_FLAG:
        found = _AFTER_FLAG[before[-1]]
    elif before[-1] in _FILE_FLAGS:
        found = _files(word)
    elif word.startswith("-"):
        found = _FLAGS
    elif "=" in word:
        found = _values(before[0], before[1:], word)
    else:
        found = _keys(before[0], before[1:], word)
    return sorted({name for name in found if name.startswith(word)})


def _values(command: str, before: Sequence[str], word: str) -> Iterator[str]:
    """``key=value`` for the key in ``word``: choices, scenes, true and false, the value it has, files."""
    key, _, value = word.partition("=")
    real = dict(COMMANDS[command].aliases).get(key)
    if real is not None:
        found = _values(command, before, f"{real}={value}")
        yield from (key + candidate.removeprefix(real) for candidate in found)
        return
    name = key.lstrip("+~").partition("@")[0]
    from toile.cli.configuration import CONF
    from toile.cli.groups import group_choices

    choices = group_choices([CONF]).get(name)
    if choices is not None:
        # A sweep, or a list of effects: what stands before stays.
        earlier = value[: max(value.rfind(","), value.rfind("[")) + 1]
        names = {*choices, *(_scenes(before) if name == "scene" else ())}
        yield from (f"{key}={earlier}{choice}" for choice in names)
        if name == "scene":
            yield from (f"{key}={path}" for path in _files(value, folders_only=True))
        return
    present = _at(_settings(command, before)[0], name.split("."))
    if isinstance(present, bool):
        yield from (f"{key}=true", f"{key}=false")
    elif isinstance(present, int | float):
        yield f"{key}={present}"
    else:
        yield from (f"{key}={path}" for path in _files(value))


def _keys(command: str, before: Sequence[str], word: str) -> Iterator[str]:
    """Settings and groups that begin like ``word``, and what stands without a key."""
    sign = word[: len(word) - len(word.lstrip("+~"))]
    name = word[len(sign) :]
    cfg, groups = _settings(command, before)
    yield from (f"{sign}{group}=" for group in groups)
    parent, dot, _ = name.rpartition(".")
    for key, value in _children(_at(cfg, parent.split(".")) if dot else cfg):
        if key != "hydra" and not key.startswith("_"):
            yield f"{sign}{parent}{dot}{key}{'.' if _children(value) else '='}"
    if command in RESUMABLE:
        yield "resume="
    yield from (f"{alias}=" for alias, _ in COMMANDS[command].aliases)
    yield from COMMANDS[command].words
    if COMMANDS[command].plain == "run":
        yield from _files(word)


def _settings(command: str, before: Sequence[str]) -> tuple[Any, dict[str, list[str]]]:
    """Settings and groups of a command after what stands before the cursor."""
    from hydra.errors import HydraException

    from toile.cli.configuration import name_scenes
    from toile.cli.path_arguments import quote_paths
    from toile.cli.shown import composed

    overrides = [a for a in before if "=" in a and not a.startswith("-") and not a.startswith("resume=")]
    try:
        return composed(command, name_scenes(quote_paths(overrides)))
    except HydraException:
        # Something is wrong, or not a single run; the usual settings are the best guess.
        return composed(command, [])


def _at(cfg: Any, path: Sequence[str]) -> Any:
    """The node or value at a path, without resolving references; None where there is none."""
    for name in path:
        cfg = dict(_children(cfg)).get(name)
    return cfg


def _children(node: Any) -> list[tuple[str, Any]]:
    """Names and values of a mapping; nothing for what is none, or missing, or a reference."""
    from omegaconf import DictConfig

    if not isinstance(node, DictConfig) or node._is_none() or node._is_missing() or node._is_interpolation():
        return []
    return [(str(name), value) for name, value in node.items_ex(resolve=False)]


def _scenes(before: Sequence[str]) -> list[str]:
    """Names of the scenes in the data folder."""
    from toile.scenes.locations import available_scenes

    folders = [a.partition("=")[2] for a in before if a.startswith("paths.data=")]
    return list(available_scenes(folders[-1] if folders else None))


def _files(start: str, *, folders_only: bool = False) -> Iterator[str]:
    """Paths that begin like ``start``; folders end in "/"."""
    parent, name = os.path.split(start)
    try:
        entries = sorted(Path(parent or ".").iterdir())
    except OSError:
        return
    for entry in entries:
        if entry.name.startswith(name) and (name.startswith(".") or not entry.name.startswith(".")):
            folder = entry.is_dir()
            if folder or not folders_only:
                yield os.path.join(parent, entry.name) + ("/" if folder else "")


def _candidates_for_bash(line: str, breaks: str) -> Iterator[str]:
    """Candidates as bash wants them: escaped, and without what it takes for the words before.

    Args:
        line: the command line up to the cursor.
        breaks: characters at which bash begins a word anew ("=" is one of them as a rule).
    """
    words, kept, quote = _split(line, breaks)
    for word in candidates(words[1:]):
        rest = word[kept:]
        shown = rest if quote else "".join(f"\\{c}" if c in _SPECIAL else c for c in rest)
        yield shown + ("" if word.endswith(_OPEN_ENDS) else quote + " ")


def _split(line: str, breaks: str) -> tuple[list[str], int, str]:
    """Words of a line as a shell reads them.

    Returns:
        The words; how many characters of the last one are not to be repeated; the quote that is open, or "".
    """
    words, word, begun, kept, quote = [], "", True, 0, ""
    characters = iter(line)
    for c in characters:
        if quote:
            quote, word = ("", word) if c == quote else (quote, word + c)
        elif c in "'\"":
            quote, kept, begun = c, len(word), True
        elif c.isspace():
            if begun and word:
                words.append(word)
            word, begun, kept = "", True, 0
        else:
            word += next(characters, "") if c == "\\" else c
            begun = True
            if c in breaks and c in "=:":
                kept = len(word)
    return [*words, word], kept, quote
