"""The report of a diagnosis from what its stages have found."""

from __future__ import annotations

from importlib.metadata import version

from toile.diagnosis.aliases import alias_of
from toile.diagnosis.answer import Weighed
from toile.diagnosis.arrays import VERTICES_FILE
from toile.diagnosis.decision import Calibration
from toile.diagnosis.findings import amounts, estimates, naive_answer
from toile.diagnosis.gap_maps import stage_shares
from toile.diagnosis.problem import DiagnosisProblem
from toile.diagnosis.record import CalibrationUse, EffectReport, GapReport, Protocol, Where
from toile.diagnosis.results import StageResults
from toile.diagnosis.verdict import until, verdict_of
from toile.effects.catalogue import STAGES


def gap_report(
    problem: DiagnosisProblem,
    found: StageResults,
    judged: Weighed,
    calibration: Calibration,
    use: CalibrationUse,
) -> GapReport:
    """The answer.

    Args:
        problem: the clip.
        found: by the stages.
        judged: what speaks for every hypothesis.
        calibration: see Calibration.
        use: whether it belongs to the settings.
    """
    settings, maps, n_frames = problem.settings, found.maps, problem.scene.n_frames
    shrinks, known = found.held_out.shrinks, found.seen.known
    numerics = min(1.0, found.step_error.distance / max(maps.mean, 1e-9))
    verdict = verdict_of(
        judged.chances,
        judged.evidence,
        calibration,
        shrinks,
        explained=judged.left <= settings.usual_cost,
        settings=settings.verdict,
    )
    by_name = {effect.NAME: effect for effect in problem.effects}
    converged = problem.converged_mechanics(found.tracked, found.base, found.converged)
    names = converged.shooting.simulator.cloth.energies.parameters.names
    times = converged.around.frame_times()[: found.used]

    def material_with(effect: str) -> dict[str, float]:
        refit = found.race.effects.get(effect)
        base = converged.fit.base if refit is None else refit.base
        return dict(zip(names, base.material.tolist(), strict=True))

    return GapReport(
        until(verdict, known) if known < n_frames else verdict,
        Where(stage_shares(judged.evidence, calibration, numerics), maps.frames, VERTICES_FILE, maps.regimes),
        tuple(
            EffectReport(
                name,
                STAGES[name].value,
                judged.chances[name],
                estimates(judged.findings[name], by_name[name], settings.widened),
                shrinks.get(name),
                amounts(
                    judged.findings[name],
                    by_name[name],
                    converged.around,
                    material_with(name),
                    times,
                    settings.widened,
                ),
            )
            for name in judged.ranked
        ),
        alias_of(converged, found.race.discrepancy, calibration, settings.weights),
        Protocol(
            settings.seed,
            tuple(range(found.used)),
            tuple(range(found.used, n_frames)),
            f"toile {version('toile')}",
            naive_answer(converged, judged.findings),
        ),
        use,
    )
