"""How good an answer is.

good
    One clear message (at most ``LONGEST`` lines, it names what is wrong) and an exit status that is not 0;
    or, where nothing is wrong, success.
warned
    Done, with a warning on the console that names what is wrong and that, if the result may suffer, also
    stands in the log and on the page of commands that have them.
bad
    Anything else: a traceback, silence, pages of text, a message that does not say what is wrong, lost data,
    no end.
"""

from __future__ import annotations

import html
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bad_inputs.case import Case, Want

Kind = Literal["good", "warned", "bad"]

LONGEST = 24
"""Lines of a message that is still one: a terminal's screen. A table of findings (doctor) may have more."""
LONGEST_TABLE = 60

# Where a warning must stand besides the console.
_LOGS = {"fit", "diagnose", "train"}
_PAGES = {"fit", "diagnose", "report"}
_TRACEBACK = re.compile(
    r"^\s*Traceback \(most recent call last\)|^Exception ignored in|^Fatal Python error", re.M
)
_LIBRARY = re.compile(r"^\S+\.py:\d+: \w*Warning: .*\n?.*", re.M)
_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]")


@dataclass(frozen=True)
class Answer:
    """What a command did.

    Attributes:
        status: of its exit; negative: the signal that ended it; None: it did not end in time.
        out: standard output.
        err: standard error.
        seconds: duration.
        began: time of the clock when it did.
    """

    status: int | None
    out: str
    err: str
    seconds: float
    began: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """How good an answer is, and why it is not better."""

    kind: Kind
    why: str = ""


def judge(case: Case, answer: Answer, folder: Path) -> Verdict:  # noqa: PLR0911
    """Judge the answer to the command itself; see the module's text.

    Args:
        case: what was wrong.
        answer: what toile did.
        folder: where it ran; logs and pages in it are read.
    """
    if answer.status is None:
        return Verdict("bad", f"no end within {case.at_most:g} s")
    text = f"{answer.err}\n{answer.out}"
    if _TRACEBACK.search(text):
        return Verdict("bad", "traceback")
    if answer.status < 0:
        return Verdict("bad", f"ended by signal {-answer.status}")
    if answer.status != 0:
        return _refusal(case, answer)
    if case.want is Want.SUCCESS:
        absent = [pattern for pattern in case.leaves if not any(folder.glob(pattern))]
        return Verdict("bad", f"left no {', '.join(absent)}") if absent else Verdict("good")
    if case.want is Want.REFUSAL:
        return Verdict("bad", "exit status 0")
    return _warning(case, text, answer.began, folder)


def message(answer: Answer) -> str:
    """What a user reads of a failure: standard error, or the output where the command answers there."""
    err = plain(answer.err).strip()
    return err or plain(answer.out).strip()


def plain(text: str) -> str:
    """Text without colours and without what a progress bar has overwritten."""
    lines = (line.rpartition("\r")[2] for line in _ESCAPES.sub("", text).replace("\r\n", "\n").splitlines())
    return "\n".join(line.rstrip() for line in lines)


def _refusal(case: Case, answer: Answer) -> Verdict:
    if case.want is Want.SUCCESS:
        return Verdict("bad", "refused, although nothing is wrong")
    # A table of findings stands on standard output.
    table = case.arguments[0] == "doctor" and bool(answer.out.strip())
    said = plain(answer.out) if table else message(answer)
    n_lines = len([line for line in said.splitlines() if line.strip()])
    if n_lines == 0:
        return Verdict("bad", "not a word")
    if n_lines > (LONGEST_TABLE if table else LONGEST):
        return Verdict("bad", f"{n_lines} lines")
    missing = _unsaid(case.says, said)
    return Verdict("bad", f"the message does not say {missing}") if missing else Verdict("good")


def _warning(case: Case, text: str, began: float, folder: Path) -> Verdict:
    command = case.arguments[0]
    # What NumPy remarks on with a line of our code is no warning to a user.
    places = {"console": _LIBRARY.sub("", plain(text))}
    if command in _LOGS and not case.harmless:
        places["log"] = _written(folder, ("*.log",), began)
    if command in _PAGES and not case.harmless:
        places["page"] = html.unescape(_written(folder, ("index.html", "report.html"), began))
    says = (*case.says, "warning") if command != "doctor" else case.says
    wanted = {place: says if place == "console" else case.says for place in places}
    silent = [place for place, said in places.items() if _unsaid(wanted[place], said)]
    if not case.says or "console" in silent:
        return Verdict("bad", "silent: exit status 0 and no warning")
    if silent:
        return Verdict("bad", f"the warning is not in the {' nor in the '.join(silent)}")
    return Verdict("warned")


def _written(folder: Path, names: tuple[str, ...], began: float) -> str:
    """Texts of the files of such names that are not older."""
    found = [p for name in names for p in folder.rglob(name) if p.stat().st_mtime >= began]
    return "\n".join(p.read_text(errors="replace") for p in found)


def _unsaid(says: tuple[str, ...], text: str) -> str:
    said = " ".join(text.lower().split())
    missing = [words for words in says if not any(w.lower() in said for w in words.split("|"))]
    return ", ".join(f"“{words}”" for words in missing)
