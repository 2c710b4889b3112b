"""All cases, group after group."""

from __future__ import annotations

from bad_inputs import commands, own_video, paths, runs, scene_files, sessions, settings
from bad_inputs.case import Case

CASES: tuple[Case, ...] = (
    *scene_files.CASES,
    *settings.CASES,
    *runs.CASES,
    *own_video.CASES,
    *commands.CASES,
    *sessions.CASES,
    *paths.CASES,
)
