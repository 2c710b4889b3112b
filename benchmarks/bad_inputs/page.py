"""docs/robustness.md from the results."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from bad_inputs.running import Result
from bad_inputs.verdict import LONGEST

# Where the code lies on the machine that this was made on.
_INSTALLED = re.compile(r"/\S*/(?=site-packages/|src/toile/|conf/|benchmarks/)")
KINDS = ("good", "warned", "bad")


def summary(results: Sequence[Result]) -> str:
    """One line."""
    count = Counter(r.kind for r in results)
    fine = 100 * (count["good"] + count["warned"]) / len(results)
    parts = ", ".join(f"{count[kind]} {kind}" for kind in KINDS)
    return f"{len(results)} cases: {parts}; {fine:.1f} % good or warned."


def page(results: Sequence[Result], machine: str, version: str) -> str:
    """The document in Markdown."""
    groups = list(dict.fromkeys(r.group for r in results))
    bad = [r for r in results if r.kind == "bad"]
    parts = [
        "# What happens to bad input",
        "Made by `make robustness`. Every row is a command in a process and a folder of its own that begin "
        "with sound input in which one thing was made wrong. *good*: refused in one clear message (at most "
        f"{LONGEST} lines, which name what is wrong), an exit status that is not 0, and no file lost; or, "
        "where the input is unusual but right, done. *warned*: done, with a warning on the console that, "
        "if the result may suffer, also stands in the log and on the page of commands that have them. "
        "*bad*: anything else, such as a traceback, silence, or lost data. Most commands run in a fork of a "
        "process that has imported toile already; where the start matters (encodings, caches), it is a new "
        "process.",
        f"**{summary(results)}** toile {version}, {machine}.",
        _table(
            ("group", "cases", *KINDS),
            [
                (g, str(len(of)), *(str(sum(r.kind == kind for r in of)) for kind in KINDS))
                for g in groups
                for of in [[r for r in results if r.group == g]]
            ],
        ),
    ]
    if bad:
        parts += ["## Bad", _table(("what is wrong", "why"), [(r.wrong, r.why) for r in bad])]
    for group in groups:
        rows = [
            (
                r.wrong,
                f"`{_cell(r.command)}`",
                "–" if r.status is None else str(r.status),
                "<br>".join(_cell(line) for line in r.said),
                f"**bad**: {_cell(r.why)}" if r.kind == "bad" else r.kind,
            )
            for r in results
            if r.group == group
        ]
        parts += [f"## {group}", _table(("what is wrong", "command", "exit", "message", "verdict"), rows)]
    return "\n\n".join(parts) + "\n"


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(text: str) -> str:
    text = _INSTALLED.sub("", text)
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("`", "'")
