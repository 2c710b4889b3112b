"""Causes from outside, judged with the forces within the cloth left free.

What a law of the cloth is wrong by is a force within the cloth: it leaves the balance of torques about the
line through the corners alone (force_modes). With a free smooth force that does so as well, and hardly any
that does not, the law and its errors do not matter, and only inertia, gravity and what acts from outside must
agree with the images. Drag, gusts, an uneven density and a wrong clock are found that way where a law that
does not fit, or a corner on a coarse grid, would pass for them; what acts within the cloth leaves no trace.

Unlike the balance of a motion that is taken as known (torque_balance), the motion is fitted beside, so that
what images do not see, the depth of a sheet that faces the camera, is uncertain here as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.effect_size import Displacement, Displacements
from toile.diagnosis.evidence import Evidence
from toile.diagnosis.fingerprint import fingerprint
from toile.diagnosis.hem import Hem
from toile.diagnosis.joint_fit import JointFit, JointFitting
from toile.diagnosis.pipeline import PipelineStage
from toile.diagnosis.session_settings import SessionSettings
from toile.diagnosis.session_stages import Own, RefinedMotion, SeenClip, SessionModel
from toile.effects.base import Effect
from toile.effects.catalogue import OUTSIDE, STAND_INS
from toile.effects.contact import Contact
from toile.limits import Unit
from toile.workers import ALONE, Workers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OutsideCause:
    """What speaks for a cause from outside.

    Attributes:
        evidence: against none of them.
        coefficients: in prior deviations, see SharedLayout (n,).
        covariance: of them (n, n).
        displacement: how far it moves the cloth.
        beside: evidence of every other cause, once this one acts.
    """

    evidence: EffectEvidence
    coefficients: Array
    covariance: Array
    displacement: Displacement
    beside: dict[str, EffectEvidence] = field(default_factory=dict)


@dataclass(frozen=True)
class OutsideCauses:
    """What speaks for causes from outside.

    Attributes:
        causes: by name; empty where every torque is held.
        hem: width of the strip along the borders that was found, negative where mass is missing [m].
        passes: of the fit without any of them.
        converged: whether its last pass gained little.
    """

    causes: dict[str, OutsideCause]
    hem: Annotated[float, Unit("m")] = 0.0
    passes: int = 0
    converged: bool = True

    def leading(self, asked: Callable[[str], float]) -> str | None:
        """The cause with most evidence beyond what is asked of it, stand-ins aside; None where none has it.

        Args:
            asked: of a cause by its name [nats].
        """
        beyond = {
            name: cause.evidence.nats() - asked(name)
            for name, cause in self.causes.items()
            if name not in STAND_INS
        }
        best = max(beyond, key=lambda name: beyond[name], default=None)
        return best if best is not None and beyond[best] >= 0.0 else None


def outside_causes(
    clips: Sequence[SeenClip],
    motion: RefinedMotion,
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    effects: Sequence[Effect],
    workers: Workers = ALONE,
    own: Own | None = None,
) -> OutsideCauses:
    """Evidence of every cause from outside, the forces within the cloth free.

    Args:
        clips: tracked.
        motion: where the image term is linearised and windows start.
        settings: see SessionSettings, ``freed`` among them.
        stiffness: where fits begin.
        effects: candidates and stand-ins; of the candidates those that act within the cloth are left out.
        workers: share the windows of a clip.
        own: see SessionModel.
    """
    outside = [effect for effect in effects if effect.NAME in (*OUTSIDE, *STAND_INS)]
    found = freed_fit(clips, motion, settings, stiffness, workers, own) if outside else None
    return OutsideCauses({}) if found is None else judged(*found, outside, workers=workers)


def freed_fit(
    clips: Sequence[SeenClip],
    motion: RefinedMotion,
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    workers: Workers = ALONE,
    own: Own | None = None,
) -> tuple[JointFitting, JointFit, float] | None:
    """The fit without any cause, the forces within the cloth free; None where holders take up every torque.

    Args:
        clips: see outside_causes.
        motion: see outside_causes.
        settings: see outside_causes.
        stiffness: where it begins.
        workers: share the windows of a clip.
        own: see SessionModel.

    Returns:
        The fitting, its fit, and the width of the cloth [m].
    """
    freed = settings.freed
    of_fits = replace(settings.fit, force=freed.force, outside=freed.outside, passes=freed.passes)
    held = min(freed.held, settings.held)
    settings = replace(settings, fit=of_fits, held=held)
    base: JointFit | None = None
    for rounds_left in range(freed.rounds, -1, -1):
        model = SessionModel(clips, motion, settings, stiffness, own)
        fitting = model.fitting.with_usual((Hem(),))
        if any(clip.shooting.n_external == 0 for clip in fitting.clips):
            return None
        begin = fitting.start_fit(workers) if base is None else fitting.started_like(base, workers)
        base = fitting.fitted(fitting.usual, begin, workers, spread=rounds_left == 0)
        if rounds_left:
            # The quadratic of the images is that around another motion, with corners elsewhere.
            motion = replace(model.refined(base), error=motion.error)
    assert base is not None
    return fitting, base, model.width


def judged(
    fitting: JointFitting,
    base: JointFit,
    width: float,
    outside: Sequence[Effect],
    workers: Workers = ALONE,
) -> OutsideCauses:
    """Evidence of causes around a fit without any, the first of whose usual effects is the hem.

    In the linearised model, that is: fits of single causes halt where a fold is about to snap, at different
    shares of what they could gain, and that would decide between them. An obstacle's push has a history of
    its own, see ContactPush.

    Args:
        fitting: whose windows have forces of their own.
        base: its fit without any cause.
        width: of the cloth [m].
        outside: candidates.
        workers: share the windows of a clip.
    """
    fitting, outside = _with_pushes(fitting, outside)
    candidates = [*outside, *fitting.usual]
    # Reduced once for all: the windows' own unknowns are most of the work.
    evidence = fitting.quadratic(candidates, base, fitting.systems(candidates, base, workers))
    by_name = {effect.NAME: effect for effect in outside}
    found = fitting.linearised(candidates, base, evidence)
    displacements = Displacements(fitting.clips, fitting.start, width).of_all(found, workers)
    return OutsideCauses(
        {
            name: OutsideCause(
                fit.evidence(base),
                fit.own,
                fit.own_covariance,
                displacements[name],
                _beside(fitting, base, by_name[name], candidates, evidence),
            )
            for name, fit in found.items()
        },
        float(base.effects[0][0].values[0]),
        len(base.history) - 1,
        base.converged,
    )


def _with_pushes(fitting: JointFitting, outside: Sequence[Effect]) -> tuple[JointFitting, Sequence[Effect]]:
    """The fitting and the causes with contact as what its obstacle may push."""
    longest = max((clip.around.n_frames - 1) / clip.around.fps for clip in fitting.clips)

    def pushing(effect: Effect) -> Effect:
        return effect.pushing(longest) if isinstance(effect, Contact) else effect

    own = [{name: pushing(effect) for name, effect in clip.own.items()} for clip in fitting.clips]
    return fitting.with_own(own), [pushing(effect) for effect in outside]


def _beside(
    fitting: JointFitting,
    base: JointFit,
    first: Effect,
    candidates: Sequence[Effect],
    evidence: Evidence,
) -> dict[str, EffectEvidence]:
    """Evidence of all other candidates where one of them acts, as strongly as is best beside each."""
    given = fitting.with_usual((*fitting.usual, first))
    with_first = given.with_effect_at_zero(base, first)
    return {
        name: fit.evidence(with_first)
        for name, fit in given.linearised(candidates, with_first, evidence).items()
    }


def outside_stage(
    clips: Sequence[SeenClip],
    settings: SessionSettings,
    stiffness: tuple[float, float, float],
    effects: Sequence[Effect],
    share: float,
    made_from: Mapping[str, str],
    workers: Workers,
    own: Own | None = None,
) -> PipelineStage[RefinedMotion, OutsideCauses]:
    """See outside_causes; made from the refined motion.

    Args:
        clips: tracked.
        settings: see SessionSettings.
        stiffness: where fits begin.
        effects: candidates.
        share: of all work that is done when it begins.
        made_from: fingerprints of what it depends on.
        workers: share the windows of a clip.
        own: see SessionModel.
    """

    def compute(motion: RefinedMotion) -> OutsideCauses:
        return outside_causes(clips, motion, settings, stiffness, effects, workers, own)

    return PipelineStage(
        "causes from outside",
        "fits/outside.npz",
        "causes from outside, forces within the cloth free",
        share,
        OutsideCauses,
        compute,
        {**made_from, "effects": fingerprint(tuple(effects))},
    )
