"""Every hypothesis of clips of a session around one motion, fitted as a diagnosis fits it."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from opened_session import OpenedSession

from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.effect_sensitivities import FORCES
from toile.diagnosis.effect_size import Displacements
from toile.diagnosis.joint_fit import JointFit
from toile.diagnosis.outside_causes import OutsideCauses, outside_causes
from toile.diagnosis.session_diagnosis import learned_chances, stand_in_sizes
from toile.diagnosis.session_evidence import promising
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import (
    RefinedMotion,
    SeenClip,
    SessionModel,
    with_error_found,
    with_uneven_errors,
)
from toile.diagnosis.session_weights import MotionEvidence, SessionWeights, chances
from toile.effects.base import Effect
from toile.effects.catalogue import PUSHING, STAND_INS
from toile.effects.contact import Contact


@dataclass(frozen=True)
class Hypotheses:
    """What clips say about every effect that moves the cloth, and about stand-ins.

    Attributes:
        model: with what the cloth may touch.
        plain: the base model without its usual effects.
        base: the base model.
        moving: effects and stand-ins.
        chosen: those of them that were fitted.
        linear: evidence of every effect in the model linearised around the base.
        fits: of every effect; linearised where it was not chosen.
        seconds: of the processor, for the fit of every effect [s].
        sizes: by how much every effect moves the cloth under the law, in its width.
        outside: what is said of causes from outside with the forces within the cloth free.
        evidence: all of it, as the weights take it.
    """

    model: SessionModel
    plain: JointFit
    base: JointFit
    moving: Sequence[Effect]
    chosen: Sequence[Effect]
    linear: Mapping[str, EffectEvidence]
    fits: Mapping[str, JointFit]
    seconds: Mapping[str, float]
    sizes: Mapping[str, float]
    outside: OutsideCauses
    evidence: MotionEvidence

    def chances(self) -> dict[str, float]:
        """Probabilities by the weights of the package."""
        return chances(self.evidence, SessionWeights.load().of_clips(len(self.model.fitting.clips)))


def hypotheses(
    session: OpenedSession,
    motion: RefinedMotion,
    settings: SessionSettings,
    also: Collection[str] = (),
    *,
    free: bool = True,
    seen: Sequence[SeenClip] | None = None,
) -> Hypotheses:
    """Every hypothesis around one motion.

    Args:
        session: its clips.
        motion: of them, refined or true; where it has no error, that is found.
        settings: of the model.
        also: effects that are fitted whatever they promise.
        free: whether causes from outside are judged beside free forces, too.
        seen: its clips, with what is known of their holders; None: these stay where nobody moved them.
    """
    clips, stiffness = session.clips if seen is None else seen, session.stiffness
    if motion.error is None:
        motion = with_error_found(clips, motion, settings, stiffness)
    even, motion = motion, with_uneven_errors(clips, motion, settings, stiffness)
    model = SessionModel(clips, motion, settings, stiffness)
    fitting = model.fitting
    plain = fitting.fitted((), fitting.start_fit())
    base = fitting.fitted(fitting.usual, plain)
    errors = model.errors(base)
    learned = learned_chances(clips, motion)
    moving = [effect for effect in session.effects if isinstance(effect, FORCES)]
    if model.looks_for_obstacles(session.effects):
        model = model.with_obstacles(model.obstacles(base))
    if any(model.own):
        fitting, moving = model.fitting, [*moving, Contact()]
    moving += [STAND_INS[name]().for_clip(session.longest) for name in settings.stand_ins]
    fits = fitting.linearised(moving, base, fitting.quadratic(moving, base, fitting.systems(moving, base)))
    fits |= {effect.NAME: base for effect in moving if effect.NAME in base.names}
    chosen = promising(base, fits, moving, errors, settings.fitted, plain, base.names, learned)
    chosen += [e for e in moving if fitting.has_lost_its_stiffness(e, base) and e not in chosen]
    chosen += [e for e in moving if e.NAME in also and e not in chosen and e.NAME not in base.names]
    outside = OutsideCauses({})
    if free:
        outside = outside_causes(clips, even, settings, stiffness, moving, own=model.own)
    against = {effect.NAME: plain if effect.NAME in base.names else base for effect in moving}
    linear = {name: fits[name].evidence(one) for name, one in against.items()}
    evidence: dict[str, EffectEvidence] = {}
    sizes: dict[str, float] = {}
    seconds: dict[str, float] = {}
    moved_by = Displacements(fitting.clips, fitting.start, model.width)
    for effect in moving:
        name, began = effect.NAME, time.process_time()
        if effect in chosen:
            fits[name] = fitting.fitted_hypothesis(effect, base)
        evidence[name] = fits[name].evidence(against[name])
        sizes[name] = moved_by.of(fits[name]).last
        seconds[name] = time.process_time() - began
    causes = outside.causes
    said = {name: size for name, size in sizes.items() if name not in base.names}
    under_law = (*PUSHING, *STAND_INS)
    said |= {name: cause.displacement.last for name, cause in causes.items() if name not in under_law}
    said |= stand_in_sizes(said, outside)
    found = MotionEvidence(
        errors,
        evidence,
        learned or None,
        {name: sizes[name] for name in base.names if name in sizes},
        said,
        {name: cause.evidence for name, cause in causes.items()},
    )
    return Hypotheses(model, plain, base, moving, chosen, linear, fits, seconds, sizes, outside, found)
