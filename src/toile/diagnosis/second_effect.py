"""Whether a second effect moves the cloth beside the one that is most probable.

Hypotheses with one effect each are rivals, and two effects that act at once share what speaks for them. So
the model with the first effect becomes the base model of all others, judged by the same weights. The second
one is believed where each of the two is missing once the other acts: what merely took a share of the other's
trace is not. Nor is one with which a clip that nobody fitted is predicted worse than by the first alone: what
is left to a second effect are above all the errors of the law.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from toile.diagnosis.decision import NONE, UNKNOWN
from toile.diagnosis.effect_size import Displacements
from toile.diagnosis.joint_fit import JointFit, JointFitting
from toile.diagnosis.outside_causes import OutsideCauses
from toile.diagnosis.pipeline import Pipeline
from toile.diagnosis.record import Shrink
from toile.diagnosis.session_evidence import promising
from toile.diagnosis.session_stages import HypothesisStages, RefinedMotion
from toile.diagnosis.session_weights import MotionEvidence, SessionWeights, chances
from toile.diagnosis.verdict import VerdictSettings, is_clear
from toile.effects.base import Effect
from toile.effects.catalogue import PUSHING, WEIGHING

Array = NDArray[np.float64]
Foretold = Callable[[JointFitting, JointFit, JointFit, Effect], Shrink | None]
"""Of fits whose base model has the first effect, that model, the fit of the second effect, and that effect:
by how much the error on a clip left out shrinks."""


@dataclass(frozen=True)
class SecondEffect:
    """What acts beside the most probable effect, or beside one that is level with it.

    Attributes:
        first: that effect.
        chances: of all others beside it, NONE among them, most probable first.
        name: of the one that is believed, "" for none.
        found: what their common fit says of each where one is believed, (n,) and (n, n) in prior deviations.
        values: of that fit, see JointFit; of no length where none is believed.
        shrink: of the error on the clip left out, by the one that leads beside ``first``, over ``first``
            alone; None where it was not asked.
    """

    first: str
    chances: dict[str, float]
    name: str
    found: dict[str, tuple[Array, Array]]
    values: Array = field(default_factory=lambda: np.empty(0))
    shrink: Shrink | None = None

    def unless(self, names: Collection[str]) -> SecondEffect:
        """The same; none is believed where it is one of these, which predict worse than nothing."""
        if self.name not in names:
            return self
        return SecondEffect(self.first, self.chances, "", {}, shrink=self.shrink)


@dataclass(frozen=True)
class _Beside:
    """What is said of effects once another one acts.

    Attributes:
        chances: of them, and of none, most probable first.
        fits: of both effects by the name of the second one.
        fitting: whose base model has the first one.
        with_first: that model.
    """

    chances: dict[str, float]
    fits: dict[str, JointFit]
    fitting: JointFitting
    with_first: JointFit


@dataclass(frozen=True)
class EffectsBeside:
    """Judges effects beside another one.

    Attributes:
        pipeline: runs the fits, or reads what they have found.
        stages: of hypotheses with one effect.
        motion: they are fitted to.
        base: the base model.
        fits: hypotheses that have been simulated, by the name of the effect.
        effects: candidates that move the cloth.
        outside: see outside_causes.
        learned: probabilities of the learned decision, None where there is none.
        weights: see SessionWeights.
        foretold: says whether a second effect is borne out; None: no clip was left out.
    """

    pipeline: Pipeline
    stages: HypothesisStages
    motion: RefinedMotion
    base: JointFit
    fits: Mapping[str, JointFit]
    effects: Sequence[Effect]
    outside: OutsideCauses
    learned: Mapping[str, float] | None
    weights: SessionWeights
    foretold: Foretold | None = None

    def second(self, probable: Mapping[str, float], settings: VerdictSettings, share: float) -> SecondEffect:
        """What acts beside the most probable of the effects.

        Where the next one is level with it, and nothing acts beside the first, it is asked beside that one
        as well: two effects that share what speaks for them may both have less than their rival.

        Args:
            probable: probabilities of hypotheses with one effect.
            settings: from which probability on an effect is believed.
            share: of all work that is done when it begins.
        """
        names = sorted((e.NAME for e in self.effects), key=lambda name: -probable.get(name, 0.0))
        first, *rivals = names
        found = self._beside_first(first, settings, share)
        near = settings.ahead * probable.get(rivals[0], 0.0) >= probable.get(first, 0.0) if rivals else False
        if found.name or not near:
            return found
        of_rival = self._beside_first(rivals[0], settings, share)
        return of_rival if of_rival.name else found

    def _beside_first(self, first: str, settings: VerdictSettings, share: float) -> SecondEffect:
        """What acts beside an effect."""
        beside = self.beside(first, share)
        probable, name = beside.chances, _believed(beside.chances, settings)
        # What the base model has is missing without it: else it would not be there.
        both = first in self.base.names
        if name and not both and _believed(self.beside(name, share, only=first).chances, settings) != first:
            name = ""
        if not name:
            return SecondEffect(first, probable, "", {})
        fit, shrink = beside.fits[name], None
        if self.foretold is not None:
            effect = next(one for one in self.effects if name == one.NAME)
            shrink = self.foretold(beside.fitting, beside.with_first, fit, effect)
        if shrink is not None and shrink.high < 0:
            return SecondEffect(first, probable, "", {}, shrink=shrink)
        return SecondEffect(first, probable, name, self._of_each(fit), fit.values, shrink)

    def _of_each(self, fit: JointFit) -> dict[str, tuple[Array, Array]]:
        """Coefficients of every effect in the first clip, and their covariance."""
        by_name = {effect.NAME: effect for effect in (*self.stages.model.fitting.usual, *self.effects)}
        layout = self.stages.model.fitting.layout([by_name[name] for name in fit.names])
        places = zip(fit.names, layout.coefficients(0), strict=True)
        return {name: (fit.coefficients[p], fit.covariance[np.ix_(p, p)]) for name, p in places}

    def beside(self, first: str, share: float, only: str | None = None) -> _Beside:
        """What is said of effects once one of them acts.

        Args:
            first: the one that acts.
            share: of all work that is done when it begins.
            only: the one that is asked about; None for all others.
        """
        by_name = {effect.NAME: effect for effect in self.effects}
        with_first = self._with(by_name[first], share)
        others = [e for e in self.effects if e.NAME not in with_first.names and only in (None, e.NAME)]
        model, workers = self.stages.model, self.stages.workers
        usual = model.fitting.usual_in(self.base)
        acting = usual if first in self.base.names else (*usual, by_name[first])
        fitting = model.fitting.with_usual(acting)
        considered = [*others, *acting]
        systems = fitting.systems(considered, with_first, workers)
        evidence = fitting.quadratic(considered, with_first, systems)
        fits = fitting.linearised(considered, with_first, evidence)
        errors = model.errors(with_first)
        causes = self.outside.causes
        freed = causes[first].beside if first in causes else {n: c.evidence for n, c in causes.items()}
        freed = {name: one for name, one in freed.items() if name in fits}
        # Of the others a fit under the law says nothing more.
        of_law = [e for e in others if e.NAME not in freed or e.NAME in (*WEIGHING, *PUSHING)]
        linear = {effect.NAME: fits[effect.NAME] for effect in of_law}
        for effect in promising(with_first, linear, of_law, errors, 1):
            stage = self.stages.fit_beside(fitting, effect, first, share)
            fits[effect.NAME] = self.pipeline.run(stage, self.motion, with_first)
        found = {name: cause.displacement for name, cause in causes.items() if name not in PUSHING}
        moved_by = Displacements(fitting.clips, fitting.start, model.width)
        found |= moved_by.of_all({n: fit for n, fit in fits.items() if n not in found}, workers)
        sizes = {name: found[name].last for name in fits}
        within = {name: fit.evidence(with_first) for name, fit in fits.items()}
        evidence_beside = MotionEvidence(errors, within, self.learned, {}, sizes, freed)
        odds = chances(evidence_beside, self.weights)
        ranked = dict(sorted(odds.items(), key=lambda item: -item[1]))
        return _Beside(ranked, fits, fitting, with_first)

    def _with(self, effect: Effect, share: float) -> JointFit:
        """The model with one effect, simulated."""
        if effect.NAME in self.base.names:
            return self.base
        if effect.NAME in self.fits:
            return self.fits[effect.NAME]
        return self.pipeline.run(self.stages.fit(effect, share), self.motion, self.base)


def _believed(found: Mapping[str, float], settings: VerdictSettings) -> str:
    first = max(found, key=lambda name: found[name])
    return first if first not in (NONE, UNKNOWN) and is_clear(found, settings) else ""
