"""Lightning without its messages."""

from __future__ import annotations

import pytest

from toile.learning.quiet import quiet_lightning


@pytest.fixture(autouse=True)
def _quiet() -> None:
    quiet_lightning()
