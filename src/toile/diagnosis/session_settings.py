"""Settings of a diagnosis of several clips."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from toile.diagnosis.attachment_slip import RefinedSlipSettings, SlipSettings
from toile.diagnosis.joint_fit import JointFitSettings
from toile.diagnosis.occlusion import OcclusionSettings
from toile.diagnosis.softened import ModelError
from toile.diagnosis.touched_obstacles import TouchedSettings
from toile.limits import Count, CountOrZero, Fraction, NonNegative, Positive, Seed, Unit
from toile.physics.grid_laws import GridLaw, taut_fitted
from toile.physics.grid_lines import Crowding

Usual = Annotated[tuple[Literal["internal_damping"], ...], Field(max_length=1)]
"""Effects that a base model may have."""

StandIns = tuple[Literal["steady_forces", "rest_length_drift", "pressure"], ...]
"""Names of effects.catalogue.STAND_INS."""


@dataclass(frozen=True)
class RefiningSettings:
    """How the tracked motion is refined before hypotheses are compared.

    Tracking has forces of 10 m/s² at every vertex, so what images hardly see, the depth of a sheet that faces
    the camera, wanders by percents of the width. The base model whose windows may jump a little further than
    when hypotheses are compared does not, and the image term is linearised anew around what it finds. Every
    linearisation takes a part of the error away, so many short rounds do more than few long ones. Most of it
    is smooth and goes on a coarse grid, where a round takes a third of the time.

    Attributes:
        side: vertices along each side of the model in the first rounds, that of SessionSettings at most.
        rounds: of fits with it, at most, each with the image term linearised anew; 0: none.
        firm: passes at most of one more round with it, whose jumps are those of the comparison: folds that
            looser ones leave where tracking had them are undone by it.
        finer: rounds with the whole model after them, at most; without any round the motion stays as tracked.
        steady: rounds end where the motion changes by less than so many of the model's errors.
        loose: rounds after them in which nothing holds the pinned vertices, to see whether one slips; 0: that
            is judged by the motion in which they are held.
        passes: of each, at most, the firm one aside.
        jumps: factor on the deviations of the jumps in them.
        modes: cosine modes along each side of a window's start in all of them: that of SessionSettings at
            least, and else no more than two thirds of the vertices along a side of the model. Half of what a
            motion is off by has more than three half waves along a side, and what no mode reaches stays where
            tracking had it.
    """

    side: Annotated[int, Field(ge=4), Unit("vertices")] = 14
    rounds: CountOrZero = 7
    firm: CountOrZero = 12
    finer: CountOrZero = 2
    steady: NonNegative = 1.0
    loose: CountOrZero = 2
    passes: Count = 2
    jumps: Positive = 2.5
    modes: Count = 8

    @property
    def any(self) -> bool:
        """Whether there is any round."""
        return bool(self.rounds or self.firm or self.finer)


@dataclass(frozen=True)
class FreedSettings:
    """How causes from outside are judged, the forces within the cloth free, see outside_causes.

    Attributes:
        force: deviation of a mode of the free force that leaves the balance of torques alone [m/s²]: more
            than any law is wrong by (0.4 to 0.8 on cloth of other engines), so that what is left is the
            balance.
        outside: of one that disturbs it [m/s²].
        held: deviation of the boundary positions [m] in clips in which nobody moved them: what corners on a
            coarse grid are wrong by is a force within the cloth here.
        rounds: fits after which the image term is linearised anew around what they find.
        passes: of a fit, at most.
    """

    force: Annotated[Positive, Unit("m/s²")] = 1.6
    outside: Annotated[Positive, Unit("m/s²")] = 0.002
    held: Annotated[Positive, Unit("m")] = 0.0003
    rounds: CountOrZero = 2
    passes: Count = 6


@dataclass(frozen=True)
class SessionSettings:
    """How the clips of one cloth are diagnosed together.

    Attributes:
        law: of the model's cloth, see physics.grid_laws.
        side: vertices along each side of the model, the scene's own at most.
        crowding: by how much lines of its grid come closer towards the borders, see GridLines; 0 for evenly
            spaced ones.
        longest_substep: of the model [s].
        newton_iterations: of a sub-step at most. A stiff cloth that pulls and hardly pushes has many kinks to
            pass where a window begins out of balance.
        window: length of the windows [s]. Short ones are nearly linear in what is unknown, so a fit arrives
            where with long ones it halts half-way.
        jump_position: of each mode of what lies between the end of a window and the start of the next [m].
        jump_velocity: of its velocities [m/s].
        modes: cosine modes along each side of a window's start.
        boundary_knot: time between knots of the boundary positions [s].
        boundary: deviation of the boundary positions at a knot [m]: images hardly see their depth.
        held: the same in clips in which nobody moved them (``motion: hang`` or ``release``) and none slips:
            from where the template has them along the line of sight, and across it from where they are in the
            median frame. As wide as ``boundary`` or wider: from where the motion has them. Corners that
            wander lead the cloth astray in depth; held to 0.3 mm they show what the law is wrong by there;
            see docs/diagnosis/validation.md.
        likelihood_weight: of the images' information: errors of neighbouring points and frames are alike.
        refining: see RefiningSettings.
        model_error: see ModelError; its share is where the search for it begins.
        error_rounds: fits of the base model in which that share is found; 0 leaves it as it is.
        uneven_rounds: further fits in which it is found where the base model is wrong by more and where by
            less; 0: alike everywhere, as where weights were learnt.
        slip: what pinned vertices do without slipping, in the motion that the base model has refined, and
            how slips look.
        occlusion: how the print of the cloth is looked for, to see what passes before it.
        touched: how obstacles that nobody knows of are looked for; None: they are not, and ``contact`` is a
            candidate only where it was given with its obstacle.
        stand_ins: hypotheses for what the catalogue lacks; what speaks for them speaks for ``unknown``.
        usual: effects that the base model has: what no cloth and no solver is without. One of them is a cause
            where it is stronger than is usual.
        fit: see JointFitSettings.
        freed: see FreedSettings.
        named: probability from which on an effect is the answer; more where VerdictSettings ask for more.
        fitted: hypotheses that are fitted, those with most evidence in the model linearised around the
            base; what the learned decision holds most probable, and a few more, come beside (see
            session_evidence.promising), and the others keep that evidence.
        refined: hypotheses whose prediction of the clip that is left out is measured.
        left_out_passes: over the other clips at most, for that.
        ahead: frames at 25 frames a second over which a prediction runs.
        placebos: force fields without meaning that are predicted beside them.
        alike: cosine between the traces of two effects from which on they are one answer.
        draws: of what a clip yet to be recorded may say, for every hypothesis.
        seed: of placebos and draws.
    """

    law: GridLaw = taut_fitted
    side: Annotated[int, Field(ge=4), Unit("vertices")] = 20
    crowding: Crowding = 0.5
    longest_substep: Annotated[Positive, Unit("s")] = 0.01
    newton_iterations: Count = 200
    window: Annotated[Positive, Unit("s")] = 0.04
    jump_position: Annotated[Positive, Unit("m")] = 0.0001
    jump_velocity: Annotated[Positive, Unit("m/s")] = 0.002
    modes: Count = 4
    boundary_knot: Annotated[Positive, Unit("s")] = 0.08
    boundary: Annotated[Positive, Unit("m")] = 0.01
    held: Annotated[Positive, Unit("m")] = 0.002
    likelihood_weight: Positive = 0.025
    refining: RefiningSettings = field(default_factory=RefiningSettings)
    model_error: ModelError = field(default_factory=ModelError)
    error_rounds: CountOrZero = 3
    uneven_rounds: CountOrZero = 0
    slip: SlipSettings = field(default_factory=RefinedSlipSettings)
    occlusion: OcclusionSettings = field(default_factory=OcclusionSettings)
    touched: TouchedSettings | None = field(default_factory=TouchedSettings)
    stand_ins: StandIns = ("steady_forces", "rest_length_drift", "pressure")
    usual: Usual = ("internal_damping",)
    fit: JointFitSettings = field(default_factory=JointFitSettings)
    freed: FreedSettings = field(default_factory=FreedSettings)
    named: Fraction = 0.9
    fitted: Count = 3
    refined: Count = 2
    left_out_passes: Count = 4
    ahead: Annotated[Positive, Unit("frames")] = 12.0
    placebos: Count = 3
    alike: Annotated[float, Field(gt=0, le=1)] = 0.95
    draws: Count = 64
    seed: Seed = 0

    @property
    def looks_for_slips(self) -> bool:
        """Whether pinned vertices are held, and another motion says whether they stay."""
        return self.refining.any and self.refining.loose > 0 and self.held < self.boundary

    def windows_at(self, fps: float) -> tuple[int, float]:
        """Frames of a window, one at least, and the factor on the deviations of its jump.

        Jumps are the steps of a random walk: their variance grows with the time between two of them.

        Args:
            fps: frames per second.
        """
        frames = max(1, round(self.window * fps))
        return frames, math.sqrt(frames / fps / self.window)
