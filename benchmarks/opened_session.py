"""A session as benchmarks open it: its clips as a diagnosis sees them, tracked where they are not yet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from hydra import compose, initialize_config_dir

from toile.cli.configuration import CONF
from toile.cli.diagnose import session_problem
from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.held_motion import HeldMotion, Stage, held_motion
from toile.diagnosis.pipeline import Pipeline
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.results import KINDS
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import RefinedMotion, SeenClip, seen_clips
from toile.diagnosis.stage_store import StageStore
from toile.diagnosis.stage_times import StageTimes
from toile.diagnosis.stored_values import ValueStore
from toile.effects.base import Effect
from toile.workers import ALONE


@dataclass(frozen=True)
class OpenedSession:
    """Clips of a session.

    Attributes:
        problems: of the clips.
        motions: that were asked for, of every clip.
        together: settings of all clips.
        stiffness: material where fits begin.
        effects: candidates.
        pipeline: keeps what takes long.
    """

    problems: Sequence[DiagnosisProblem]
    motions: Sequence[str]
    together: SessionSettings
    stiffness: tuple[float, float, float]
    effects: Sequence[Effect]
    pipeline: Pipeline

    @cached_property
    def clips(self) -> list[SeenClip]:
        """As a diagnosis sees them, tracked when somebody asks."""
        devices = [0] * len(self.problems)
        return seen_clips(self.problems, devices, self.pipeline, _quietly, self.motions)

    @property
    def longest(self) -> float:
        """Duration of the longest clip [s]."""
        return max((p.scene.n_frames - 1) / p.scene.fps for p in self.problems)

    def held(self, settings: SessionSettings | None = None, name: str = "") -> HeldMotion:
        """The motion that the base model refines of these clips, once for all that ask for it.

        Args:
            settings: None for ``together``.
            name: under which it is kept, beside the number of clips.
        """
        settings = self.together if settings is None else settings

        def kept(stage: Stage) -> Stage:
            what = f"{stage.file.removesuffix('.npz')}_{len(self.clips)}{name}"
            return replace(stage, file=f"{what}.npz", name=what)

        made_from = {"together": fingerprint(settings)}
        return held_motion(self.pipeline, self.clips, settings, self.stiffness, made_from, ALONE, kept)

    def refined(self, settings: SessionSettings | None = None, name: str = "") -> RefinedMotion:
        """The same, what holds the cloth aside; see ``held``."""
        return self.held(settings, name).motion


def opened(folder: Path, out: Path, *, first: bool = False) -> OpenedSession:
    """A session.

    Args:
        folder: with session.yaml.
        out: where what is found is kept.
        first: whether its first clip is all there is.
    """
    with initialize_config_dir(str(CONF), version_base=None):
        cfg = compose("diagnose", [f"session='{folder.resolve()}'", "diagnosis=quick"])
    asked = session_problem(cfg)
    n = 1 if first else len(asked.clips)
    # Without what files they were made from: what is kept depends on what is in them alone.
    problems = [DiagnosisProblem(p.reconstruction, p.recipe, p.effects, p.settings) for p in asked.clips[:n]]
    effects = asked.clips[0].effects
    values = ValueStore((*KINDS, RefinedMotion), effects)
    pipeline = Pipeline(StageStore(out, values, StageTimes.going_on(out / "times.json")), _quietly)
    motions = [clip.motion for clip in asked.session.clips[:n]]
    stiffness = asked.clips[0].settings.stiffness
    return OpenedSession(problems, motions, asked.together, stiffness, effects, pipeline)


def _quietly(what: str, share: float) -> None:
    """No progress is shown."""
