"""Standard output and error that take any text."""

from __future__ import annotations

import io
import sys

# What may raise: the second is Python's choice in the locale C.
_RAISING = ("strict", "surrogateescape")


def accept_any_text() -> None:
    """Let standard output and error replace what their encoding lacks (é in a path, ² in a unit).

    Where LANG or PYTHONIOENCODING says ASCII, a question mark is better than a traceback at the end of a fit.
    """
    for stream in (sys.stdout, sys.stderr):
        # A test or a notebook may have put something else there.
        if isinstance(stream, io.TextIOWrapper) and stream.errors in _RAISING:
            stream.reconfigure(errors="replace")
