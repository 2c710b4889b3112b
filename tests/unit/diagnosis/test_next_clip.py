"""What another clip is expected to tell, and how it would move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toile.diagnosis.effect_evidence import EffectEvidence
from toile.diagnosis.joint_fit import JointClip, JointFitting, joint_clip
from toile.diagnosis.model_errors import ModelErrors
from toile.diagnosis.next_clip import Known, expected_gain, expected_gains
from toile.diagnosis.planned_clip import PERFORMANCES, planned_clip
from toile.diagnosis.session_weights import USUAL_SHARE, MotionEvidence, SessionWeights
from toile.diagnosis.shooting import Shooting, ShootingSettings
from toile.diagnosis.tracked import Tracked
from toile.effects.base import Surroundings
from toile.effects.catalogue import CATALOGUE
from toile.generation.clip_plan import MOTIONS
from toile.physics.cloth import grid_cloth, grid_material
from toile.physics.implicit.integrators import BDF2
from toile.physics.implicit.newton import NewtonSettings
from toile.physics.implicit.simulator import ImplicitSimulator
from toile.physics.rollout import rollout
from toile.physics.state import State

GRID, FRAMES, FPS, SUBSTEPS = (5, 5), 12, 25.0, 4
MOVED = 0.01  # m
MATERIAL = np.array([400.0, 2e-3, 1e-4])
GRAVITY = np.array([0.0, 9.81, 0.0])
HORIZONTAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
EVEN = {"air_drag": 20.0, "gusts": 20.0}
"""Evidence so far [nats]; beside so much none is out of the question."""
EXACT = SessionWeights(threshold=0.0, temperature=1.0, law_spread=0.0, stand_in=0.0)
"""Weights for a law that is right."""


def known(place: int, mean: float = 3.0) -> Known:
    at = np.array([place], np.intp)
    return Known(np.array([mean]), np.array([[0.1]]), at, np.zeros(0, np.intp), 3.0, 0.0)


def evidence(nats: dict[str, float], outside: dict[str, float] | None = None) -> MotionEvidence:
    errors = ModelErrors(1e4, 1e4, USUAL_SHARE)
    of = {name: EffectEvidence(value, (), (), 1.0) for name, value in nats.items()}
    freed = {name: EffectEvidence(value, (), (), 1.0) for name, value in (outside or {}).items()}
    return MotionEvidence(errors, of, outside=freed)


def gain(
    information: np.ndarray,
    nats: dict[str, float] = EVEN,
    weights: SessionWeights = EXACT,
    n_clips: int = 1,
) -> float:
    effects = {name: known(k) for k, name in enumerate(EVEN)}
    return expected_gain(effects, information, evidence(nats), weights, n_clips, 64, np.random.default_rng(0))


class TestExpectedGain:
    def test_a_clip_that_says_nothing_gains_nothing(self) -> None:
        assert gain(np.zeros((2, 2))) == pytest.approx(0.0, abs=1e-9)

    def test_a_clip_that_says_all_gains_the_whole_entropy(self) -> None:
        assert gain(1e3 * np.eye(2)) == pytest.approx(np.log(2), abs=1e-3)

    def test_more_information_gains_more(self) -> None:
        gains = [gain(scale * np.eye(2)) for scale in (0.01, 0.1, 1.0)]
        assert 0 < gains[0] < gains[1] < gains[2] < np.log(2)

    def test_effects_with_one_and_the_same_trace_are_not_told_apart(self) -> None:
        assert gain(np.ones((2, 2)) * 1e3) < 0.02

    def test_a_clear_answer_has_little_to_gain(self) -> None:
        assert gain(np.eye(2), {"air_drag": 20.0, "gusts": 13.0}) < 0.02

    def test_a_law_that_is_wrong_tells_less(self) -> None:
        gains = [gain(np.eye(2), weights=replace(EXACT, temperature=t)) for t in (1.0, 4.0, 16.0)]
        assert gains[0] > gains[1] + 0.1 > gains[2] + 0.2
        unsure = gain(np.eye(2), weights=replace(EXACT, temperature=4.0, law_spread=0.7))
        assert unsure < gains[1]

    def test_what_clips_are_wrong_by_alike_more_of_them_do_not_mend(self) -> None:
        wrong = replace(EXACT, temperature=4.0)
        one, nine = (gain(8 * np.eye(2), weights=wrong, n_clips=n) for n in (1, 9))
        assert 0.0 < nine < 0.6 * one

    def test_no_clip_tells_whether_what_moves_the_cloth_by_little_is_a_cause(self) -> None:
        """One was asked for, and the answer stayed where a rule about sizes had put it."""
        weights = replace(EXACT, surest=1e9)
        small, large = (
            replace(evidence({"air_drag": 20.0}), sizes={"air_drag": size * weights.smallest})
            for size in (1.0, 4.0)
        )
        assert small.odds(weights)["air_drag"] == pytest.approx(small.odds(weights)["none"], abs=1e-3)
        of = {"air_drag": known(0)}
        gains = [
            expected_gain(of, 1e3 * np.eye(1), one, weights, 1, 64, np.random.default_rng(0))
            for one in (small, replace(evidence({"air_drag": 0.0}), sizes=large.sizes))
        ]
        assert gains[0] == pytest.approx(0.0, abs=1e-2)
        # Whether a large one acts a clip does tell.
        assert gains[1] == pytest.approx(np.log(2), abs=1e-2)

    def test_a_stand_in_may_be_the_truth(self) -> None:
        nats = {**EVEN, "steady_forces": 20.0}
        effects = {name: known(k) for k, name in enumerate(nats)}
        rng = np.random.default_rng(0)
        found = expected_gain(effects, 1e3 * np.eye(3), evidence(nats), EXACT, 1, 64, rng)
        assert found == pytest.approx(np.log(3), abs=1e-3)

    def test_causes_from_outside_are_told_apart_with_the_forces_within_the_cloth_free(self) -> None:
        freed = evidence({}, EVEN)
        effects = {name: known(k) for k, name in enumerate(EVEN)}
        weights = replace(EXACT, outside_threshold=0.0, outside_temperature=1.0)
        rng = np.random.default_rng(0)
        found = expected_gain(effects, 1e3 * np.eye(2), freed, weights, 1, 64, rng)
        assert found == pytest.approx(np.log(2), abs=1e-3)

    def test_gusts_of_a_clip_in_which_nothing_blows_are_not_there(self) -> None:
        new = np.array([1], np.intp)
        gusts = Known(np.array([2.0]), np.array([[0.1]]), np.array([0], np.intp), new, 3.0, 2.0)
        so_far, information = evidence({"gusts": 0.0}), np.diag([0.0, 50.0])
        windy, still = (
            expected_gain(
                {"gusts": gusts}, information, so_far, EXACT, 1, 64, np.random.default_rng(0), calm=calm
            )
            for calm in (False, True)
        )
        assert windy > 0.3
        assert still == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def hanging() -> JointClip:
    """A cloth that hangs from two corners, known to 2 mm."""
    return hung((0.3, 0.3))


def hung(sides: tuple[float, float]) -> JointClip:
    """The same with such sides [m]."""
    cloth = grid_cloth(GRID, sides, 0.15, (0, GRID[1] * (GRID[0] - 1)))
    around = Surroundings(cloth, sides, torch.from_numpy(GRAVITY), FPS, FRAMES)
    i, j = torch.meshgrid(torch.arange(GRID[0]), torch.arange(GRID[1]), indexing="ij")
    u, v = (of * side / 0.3 for of, side in zip((i, j), sides, strict=True))
    start = torch.stack((0.07 * u, 0.075 * v, 1 + 0.02 * j), -1).reshape(1, -1, 3).double()
    h = 1 / FPS / SUBSTEPS
    simulator = ImplicitSimulator(cloth, h, BDF2(), NewtonSettings(1e-6))
    weight = cloth.masses[:, None] * torch.from_numpy(GRAVITY)
    k = torch.from_numpy(MATERIAL)[:, None]
    state = State.start(start, torch.zeros_like(start), h, simulator.n_past)
    boundary = start[:, None, cloth.pinned].expand(1, FRAMES, -1, -1)
    forces = weight.expand(1, FRAMES - 1, -1, -1)
    with torch.no_grad():
        motion = rollout(simulator, state, grid_material(k[0], k[1], k[2]), forces, boundary, SUBSTEPS)
    x = motion.positions[0].numpy()
    seen = [np.eye(3 * x.shape[1], dtype=np.float32) / 0.002**2] * FRAMES
    tracked = Tracked(x, seen, np.zeros_like(x), x)
    settings = ShootingSettings(modes=2, likelihood_weight=1.0, window=6)
    pinned = x[:, cloth.pinned.numpy()]
    model = ImplicitSimulator(cloth, h, BDF2(), NewtonSettings(1e-6))
    shooting = Shooting(model, SUBSTEPS, GRAVITY, HORIZONTAL, GRID, pinned, tracked, settings)
    return joint_clip(shooting, around, FRAMES)


class TestPlannedClips:
    def test_every_motion_of_the_sheet_can_be_planned(self) -> None:
        assert set(PERFORMANCES) == set(MOTIONS)

    @pytest.mark.parametrize("motion", PERFORMANCES)
    def test_corners_do_what_is_asked_and_the_cloth_starts_at_rest(
        self, hanging: JointClip, motion: str
    ) -> None:
        done = PERFORMANCES[motion]
        clip, wind = planned_clip(hanging, motion, MATERIAL, 20, MOVED)
        x, boundary = clip.shooting.tracked.positions, clip.shooting.boundary
        assert x.shape == (20, 25, 3)
        pinned = clip.shooting.simulator.assembly.pinned
        assert np.allclose(x[:, pinned], boundary, atol=1e-9)
        moved = np.linalg.norm(boundary - boundary[0], axis=-1).max()
        assert moved <= done.amplitude + 1e-12
        assert (moved > 0.3 * done.amplitude) == (done.amplitude > 0)
        assert np.linalg.norm(wind) == pytest.approx(done.wind)
        assert clip.around.still_air == (motion in ("release", "fan_off"))
        free = MOVED if done.amplitude > 0 else hanging.shooting.settings.boundary
        assert clip.shooting.settings.boundary == free
        assert np.linalg.norm(x[1] - x[0], axis=-1).max() < 0.004
        assert sum(w.last - w.first for w in clip.windows) == 19
        assert all(w.converged for w in clip.windows)

    def test_what_is_turned_hangs_from_other_corners_in_the_same_hands(self, hanging: JointClip) -> None:
        clip, _ = planned_clip(hanging, "turned", MATERIAL, 5, MOVED)
        old, new = (set(c.shooting.simulator.assembly.pinned.tolist()) for c in (hanging, clip))
        assert new != old
        assert new < {0, 4, 20, 24}
        hands = hanging.shooting.tracked.positions[0][sorted(old)]
        held = clip.shooting.tracked.positions[0][sorted(new)]
        assert np.allclose(np.sort(hands, 0), np.sort(held, 0))

    def test_hands_on_a_longer_edge_are_as_slack_as_before(self) -> None:
        """Of a cloth that is not square the other edge hung between hands for this one."""
        sheet = hung((0.24, 0.3))
        clip, _ = planned_clip(sheet, "turned", MATERIAL, 5, MOVED)

        def slack(of: JointClip, side: float) -> float:
            first, second = of.shooting.boundary[0]
            return float(np.linalg.norm(second - first)) / side

        assert slack(clip, 0.3) == pytest.approx(slack(sheet, 0.24))


def test_still_air_parts_tilted_gravity_from_a_wind(hanging: JointClip) -> None:
    fitting = JointFitting([hanging], MATERIAL, np.zeros(3))
    base = fitting.fitted((), fitting.start_fit())
    effects = [CATALOGUE["gravity_tilt"](), CATALOGUE["air_drag"]()]
    systems = fitting.systems(effects, base)
    fits = {e.NAME: fitting.fitted((e,), base) for e in effects}
    so_far = evidence({"gravity_tilt": 0.0, "air_drag": -0.7})
    motions = ("hang", "fan_off")
    gains = expected_gains(
        fitting, base, fits, effects, systems, so_far, EXACT, motions, 32, 0, boundary=MOVED
    )
    assert set(gains) == {"hang", "fan_off"}
    assert all(0 < gain < np.log(3) for gain in gains.values())
    tilt = fitting.layout(effects).places[0]

    def known_of_tilt(motion: str) -> float:
        clip, wind = planned_clip(hanging, motion, MATERIAL, FRAMES, MOVED)
        more = JointFitting([hanging, clip], MATERIAL, np.zeros(3))
        alone = JointFitting([clip], MATERIAL, np.zeros(3))
        expected = alone.expected(np.concatenate((np.zeros(3), wind)))
        fisher = more.fisher(effects, [*systems, *alone.systems(effects, expected)])
        return float(np.linalg.eigvalsh(fisher[np.ix_(tilt, tilt)]).min())

    assert known_of_tilt("fan_off") > 10 * known_of_tilt("hang")
