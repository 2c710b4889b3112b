"""Everything that can be said about a scene at once, where a loader stops at the first error."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from toile.scenes.easymocap import is_easymocap, survey_easymocap
from toile.scenes.findings import Finding, Severity, attempt, has_errors
from toile.scenes.fitness import check_fit
from toile.scenes.native import is_multi_view, survey_multi_view, survey_native
from toile.scenes.phi_sft import survey_phi_sft
from toile.scenes.picture_checks import PictureChecks
from toile.scenes.recording import (
    ImageCheck,
    Recording,
    assemble,
    check_image_contents,
    check_image_files,
)
from toile.scenes.registry import SceneLocation, find_scene
from toile.scenes.scene import Scene
from toile.scenes.texture_coordinates import from_file
from toile.scenes.validation import check_scene

_ORDER = (Severity.ERROR, Severity.WARNING, Severity.INFO)


def diagnose(name: str, data_dir: Path | str | None = None) -> list[Finding]:
    """Diagnose a scene by name or folder, as load_scene finds it; errors first, never raises InputError."""
    findings: list[Finding] = []
    location = attempt(findings, lambda: find_scene(name, data_dir))
    return findings if location is None else diagnose_location(location)


def diagnose_location(location: SceneLocation) -> list[Finding]:
    """Diagnose a scene whose layout and folder are known."""
    if location.native:
        return diagnose_folder(location.folder)
    return diagnose_phi_sft(location.name, location.folder)


def diagnose_folder(folder: Path | str) -> list[Finding]:
    """Diagnose a folder in the native layout, or a recording by several cameras; errors first."""
    folder = Path(folder)
    if is_multi_view(folder):
        return _in_order(survey_multi_view(folder)[1])
    if is_easymocap(folder) and not (folder / "scene.json").exists():
        # The frame rate is an argument of the loader there; nothing that is checked depends on it.
        return _in_order(survey_easymocap(folder, fps=1.0)[1])
    return _diagnose(lambda check: survey_native(folder, check_images=check))


def diagnose_phi_sft(name: str, root: Path | str) -> list[Finding]:
    """Diagnose a scene of the φ-SfT layout, errors first."""
    return _diagnose(lambda check: survey_phi_sft(name, root, check_images=check))


def _diagnose(survey: Callable[[ImageCheck], tuple[Recording | None, list[Finding]]]) -> list[Finding]:
    recording, findings = survey(check_image_files)
    findings = list(findings)
    loaded = None if recording is None else attempt(findings, partial(_scene, recording))
    if loaded is None:
        # Loading stops at the first image that is wrong; where it succeeds it has decoded every one already.
        recording, findings = survey(check_image_contents)
        findings = list(findings)
        loaded = None if recording is None else attempt(findings, partial(_scene, recording))
    if recording is not None:
        findings += [Finding(Severity.INFO, "Reading", recording.name, "-", note) for note in recording.notes]
    if recording is not None and loaded is not None:
        scene, checks = loaded
        loading = scene.notes[len(recording.notes) :]
        findings += [Finding(Severity.INFO, "Loading", recording.name, "-", note) for note in loading]
        checked = check_scene(scene)
        findings += checked if has_errors(checked) else [*checked, *check_fit(scene)]
        findings += checks.findings(str(recording.source))
    return _in_order(findings)


def _scene(recording: Recording) -> tuple[Scene, PictureChecks]:
    checks = PictureChecks(len(recording.frame_paths))
    scene = assemble(
        recording, crop_margin=0, minimum_component=0.1, texture_coordinates=from_file, checks=checks
    )
    return scene, checks


def _in_order(findings: list[Finding]) -> list[Finding]:
    return sorted(dict.fromkeys(findings), key=lambda finding: _ORDER.index(finding.severity))
