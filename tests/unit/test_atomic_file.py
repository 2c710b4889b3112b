"""Failures of a disk behind other exceptions."""

from __future__ import annotations

import errno

from toile.atomic_file import disk_failure


def test_the_failure_behind_an_exception_is_found() -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    above = ValueError("cannot encode")
    above.__cause__ = full
    assert disk_failure(above) is full
    assert disk_failure(ValueError("wrong")) is None


def test_a_chain_that_bites_its_tail_has_an_end() -> None:
    """As where an exception is raised again while another one, raised from it, is handled."""
    first, second = ValueError("first"), KeyError("second")
    first.__context__, second.__context__ = second, first
    assert disk_failure(first) is None
