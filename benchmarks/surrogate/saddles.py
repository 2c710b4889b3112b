"""Steps that end where the Hessian is not positive definite, and so have approximate derivatives only."""

from __future__ import annotations

import logging

_NEWTON = logging.getLogger("toile.physics.implicit.newton")


class Saddles(logging.Handler):
    """Counts the solver's warnings of them instead of printing them; a context manager."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1

    def __enter__(self) -> Saddles:
        _NEWTON.addHandler(self)
        _NEWTON.propagate = False
        return self

    def __exit__(self, *_: object) -> None:
        _NEWTON.removeHandler(self)
        _NEWTON.propagate = True
