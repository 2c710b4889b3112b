"""What is remarkable about a scene is said wherever it is worked on."""

from __future__ import annotations

import logging
from dataclasses import replace

from toile.scenes.findings import Severity, is_warning, require
from toile.scenes.fitness import check_plausible, check_possible
from toile.scenes.scene import Scene

log = logging.getLogger(__name__)


def scene_warnings(scene: Scene, *, force: bool) -> list[str]:
    """Say what is remarkable about a scene, on the console and in the log; refuse one that cannot be fitted.

    Args:
        scene: as loaded.
        force: go on all the same, where that is possible at all.

    Returns:
        The warnings, for the page.

    Raises:
        InputError: the first thing that makes a fit pointless.
    """
    require(check_possible(scene))
    implausible = check_plausible(scene)
    if implausible and not force:
        first = implausible[0]
        expected = f"{first.expected}; force=true goes on all the same"
        raise replace(first, expected=expected).to_error()
    warnings = [note for note in scene.notes if is_warning(note)] + [
        str(replace(f, severity=Severity.WARNING)) for f in implausible
    ]
    for warning in warnings:
        log.warning("%s", warning)
    return warnings
