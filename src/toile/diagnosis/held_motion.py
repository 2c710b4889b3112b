"""The motion of a session as the base model refines it, with what holds the cloth held where it stays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.holder_slips import let_go
from toile.diagnosis.pipeline import Pipeline, PipelineStage
from toile.diagnosis.results import TrackedMotion
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import RefinedMotion, SeenClip, loosened, refined_motion
from toile.diagnosis.session_weights import SessionWeights
from toile.workers import ALONE, Workers

Stage = PipelineStage[*tuple[Any, ...], RefinedMotion]


@dataclass(frozen=True, eq=False)
class HeldMotion:
    """What is refined.

    Attributes:
        clips: those marked whose pinned vertices do not stay although nobody moved them.
        motion: refined, the pinned vertices of the other clips held in which nobody moved them.
        holders: the same with none of them held, by which they are judged; ``motion`` where nothing is held.
        made_from: fingerprints of what fits around the motion depend on.
    """

    clips: list[SeenClip]
    motion: RefinedMotion
    holders: RefinedMotion
    made_from: dict[str, str]


def _as_it_is(stage: Stage) -> Stage:
    return stage


def held_motion(
    pipeline: Pipeline,
    clips: Sequence[SeenClip],
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    made_from: Mapping[str, str],
    workers: Workers = ALONE,
    kept: Callable[[Stage], Stage] = _as_it_is,
) -> HeldMotion:
    """Refine the motion with corners held, look whether they stay, and refine it anew where they do not.

    Args:
        pipeline: runs the stages, or reads what they have found.
        clips: tracked.
        settings: see SessionSettings.
        stiffness: where fits begin.
        made_from: fingerprints of what the motion depends on.
        workers: share the windows of a clip.
        kept: gives a stage another name and file.
    """
    made, found = dict(made_from), list(clips)

    def stage(file: str, doing: str, share: float, compute: Callable[..., RefinedMotion]) -> Stage:
        name = f"{file.replace('_', ' ')} motion"
        return kept(PipelineStage(name, f"{file}.npz", doing, share, RefinedMotion, compute, made))

    def of_tracked(*tracked: TrackedMotion) -> RefinedMotion:
        return refined_motion(found, settings, stiffness, workers)

    def loose(motion: RefinedMotion) -> RefinedMotion:
        return loosened(found, motion, settings, stiffness, workers)

    def of_loose(motion: RefinedMotion) -> RefinedMotion:
        return refined_motion(found, settings, stiffness, workers, motion)

    refining = stage("refined", "motion, refined by the base model", 0.45, of_tracked)
    motion = pipeline.run(refining, *(clip.tracked for clip in found))
    if not settings.looks_for_slips or not any(clip.held_still for clip in found):
        return HeldMotion(found, motion, motion, made)
    holders = pipeline.run(stage("loosened", "what holds the cloth", 0.49, loose), motion)
    found = let_go(found, holders.positions, settings.slip, SessionWeights.load().slip_threshold)
    if any(clip.let_go for clip in found):
        made = {**made, "let go": fingerprint([clip.let_go for clip in found])}
        doing = "motion, refined with what holds the cloth let go"
        motion = pipeline.run(stage("let_go", doing, 0.49, of_loose), holders)
    return HeldMotion(found, motion, holders, made)
