"""Labelled clips of the fast simulator, a batch at a time: eight scenes, each with its null twin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toile.effects.base import Scope
from toile.generation.fast.effects import EFFECTS, NONE, OUTSIDE, Around, interval_ratio
from toile.generation.fast.kernels import LANES
from toile.generation.fast.scenes import (
    GRAVITY,
    MOTIONS,
    Clip,
    Cloth,
    Timing,
    draw_clip,
    draw_cloth,
    draw_timing,
    flat_start,
    make_sheet,
    settling_sheet,
)
from toile.generation.fast.sheet import Sheet, run

Array = NDArray[np.float64]

GENERATION = 2
"""Counts up when the same seed gives other clips: 2 since corners may move apart."""
SMALLEST, LARGEST = 0.7, 9.0
"""Sizes that are asked for [% of the width]."""
KEPT = 0.5, 14.0
"""Sizes of effects that are kept [% of the width]."""
_ROUNDED = 2.0**-15  # m; far below any noise, and two bytes are enough to keep it
_SETTLING = 1200  # steps between two results of settling, of which the last is taken
_STATIC = {
    "anisotropic_stiffness",
    "strain_stiffening",
    "rest_curvature",
    "nonuniform_density",
    "nonuniform_stiffness",
    "gravity_tilt",
}
"""Effects that a hanging sheet shows, too."""
FALLEN = 1.2
"""A sheet that has moved farther from its start than this [widths] was not held, or blew up."""


@dataclass(frozen=True)
class LabelledClip:
    """One clip whose cause is known.

    Attributes:
        label: see effects.LABELS; effect: its name, which for "outside" says more.
        size: mean displacement against the null twin in the last third [% of the width]; 0 for nulls.
        scene: clips of one scene share cloth and motion; one group in a split.
        motion: see scenes.MOTIONS.
        positions: (F, H, W, 3) [m], without noise.
        pinned: flattened indices.
        fps: declared frames per second.
        gravity: declared (3,) [m/s²].
        cloth_size: along axis 1 and 0 [m].
    """

    label: str
    effect: str
    size: float
    scene: int
    motion: str
    positions: Array
    pinned: tuple[int, ...]
    fps: float
    gravity: Array
    cloth_size: tuple[float, float]


@dataclass(frozen=True)
class _Scene:
    """Effect, cloth and clip of one lane; seed is that of the effect's shape."""

    number: int
    effect: str
    seed: tuple[int, ...]
    cloth: Cloth
    clip: Clip
    target: float


def draw_batch(seed: int, batch: int) -> list[LabelledClip]:
    """Clips of eight scenes: effects at one or two sizes each, and null twins of a part of them.

    Args:
        seed: of the set.
        batch: number within it; the same two numbers give the same clips.
    """
    rng = np.random.default_rng([seed, batch])
    timing, grid = draw_timing(rng), _draw_grid(rng)
    scenes = []
    for lane in range(LANES):
        clip = draw_clip(rng, str(rng.choice(MOTIONS)))
        number = batch * LANES + lane
        scenes.append(_scene(rng, number, (seed, number, 2), draw_cloth(rng, grid), clip))
    clips, _ = _simulate(scenes, timing, [None] * LANES, worn=rng.random() < 0.35)
    # A null beside its twins would be seen as often as all effects together.
    return [c for i, c in enumerate(clips) if c.label != NONE or i % 3 == 0]


def draw_sessions(seed: int, batch: int) -> list[list[LabelledClip]]:
    """Eight sessions of a cloth that is released, shaken and swung; every third is a null.

    What belongs to cloth or device is the same in all clips; what belongs to a clip is drawn for each.
    """
    rng = np.random.default_rng([seed, batch, 1])
    timing, grid = draw_timing(rng), _draw_grid(rng)
    cloths = [draw_cloth(rng, grid) for _ in range(LANES)]
    names = [_draw_effect(rng) for _ in range(LANES)]
    targets = np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST), LANES))
    strengths: list[float | None] = [None] * LANES
    worn = bool(rng.random() < 0.35)
    sessions: list[list[LabelledClip]] = [[] for _ in range(LANES)]
    for k, motion in enumerate(("release", "shake", "sway")):
        scenes = []
        for lane in range(LANES):
            number = batch * LANES + lane
            own = names[lane] in EFFECTS and EFFECTS[names[lane]].scope is Scope.CLIP
            shape = (seed, number, 2, k if own else 0)
            clip = draw_clip(rng, motion)
            scenes.append(_Scene(number, names[lane], shape, cloths[lane], clip, float(targets[lane])))
        clips, strengths = _simulate(scenes, timing, strengths, worn=worn)
        for lane in range(LANES):
            null = (batch * LANES + lane) % 3 == 0
            found = [c for c in clips if c.scene == batch * LANES + lane and (c.label == NONE) == null]
            sessions[lane] += found[-1:]
    return [s for s in sessions if len(s) == 3]


def _draw_grid(rng: np.random.Generator) -> tuple[int, int]:
    side = 16 if rng.random() < 0.4 else int(rng.integers(14, 19))
    return side, side


def _draw_effect(rng: np.random.Generator) -> str:
    inside = [name for name, e in EFFECTS.items() if e.label != OUTSIDE]
    outside = [name for name, e in EFFECTS.items() if e.label == OUTSIDE]
    return str(rng.choice(outside if rng.random() < 0.1 else inside))


def _scene(rng: np.random.Generator, number: int, seed: tuple[int, ...], cloth: Cloth, clip: Clip) -> _Scene:
    target = float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))
    return _Scene(number, _draw_effect(rng), seed, cloth, clip, target)


def _simulate(
    scenes: list[_Scene], timing: Timing, strengths: list[float | None], *, worn: bool
) -> tuple[list[LabelledClip], list[float | None]]:
    """Twins, effects at a first strength, and where it is not given, at the one that reaches the target.

    Args:
        scenes: of all lanes.
        timing: of the batch.
        strengths: of the effects, None where they are sought.
        worn: whether cloth and gravity have been as they are since before frame 0, or change there.

    Returns:
        Null twins and clips with an effect, and the last strengths.
    """
    flat = np.stack([flat_start(s.cloth, s.clip) for s in scenes])
    settled = run([settling_sheet(s.cloth, s.clip) for s in scenes], flat, _SETTLING)[:, -1]
    twins = run([make_sheet(s.cloth, s.clip, timing) for s in scenes], settled, timing.substeps)
    clips = [
        _labelled(s, twins[i], timing, NONE, 0.0) for i, s in enumerate(scenes) if _sound(twins[i], s.cloth)
    ]
    found = [0.5 if EFFECTS[s.effect].limit <= 1 else 1.0 for s in scenes]
    found = [f if given is None else given for f, given in zip(found, strengths, strict=True)]
    for attempt in range(2 if any(s is None for s in strengths) else 1):
        sheets = [
            _affected(s, timing, f, twins[i]) for i, (s, f) in enumerate(zip(scenes, found, strict=True))
        ]
        start = settled
        if worn:
            before = [_settling(s, f, twins[i]) for i, (s, f) in enumerate(zip(scenes, found, strict=True))]
            start = run(before, flat, _SETTLING)[:, -1]
        motions = run(sheets, start, timing.substeps)
        for i, scene in enumerate(scenes):
            size = _size(motions[i], twins[i], scene.cloth)
            sound = _sound(motions[i], scene.cloth) and _sound(twins[i], scene.cloth)
            if sound and KEPT[0] <= size <= KEPT[1]:
                clips.append(_labelled(scene, motions[i], timing, scene.effect, size))
            if attempt == 0 and strengths[i] is None:
                ratio = np.clip(scene.target / max(size, 1e-3), 0.05, 12.0) if np.isfinite(size) else 0.2
                found[i] = float(min(found[i] * ratio, EFFECTS[scene.effect].limit))
    return clips, list(found)


def _affected(scene: _Scene, timing: Timing, strength: float, twin: Array) -> Sheet:
    ratio = interval_ratio(scene.effect, scene.seed, strength)
    sheet = make_sheet(scene.cloth, scene.clip, timing, ratio)
    width = 0.5 * sum(scene.cloth.size)
    around = Around(twin, width, (timing.n_frames - 1) / timing.fps)
    EFFECTS[scene.effect].change(sheet, np.random.default_rng(scene.seed), strength, around)
    return sheet


def _settling(scene: _Scene, strength: float, twin: Array) -> Sheet:
    """The sheet before frame 0, with those effects that are there while it hangs."""
    sheet = settling_sheet(scene.cloth, scene.clip)
    if scene.effect in _STATIC:
        around = Around(twin, 0.5 * sum(scene.cloth.size), 1.0)
        EFFECTS[scene.effect].change(sheet, np.random.default_rng(scene.seed), strength, around)
    return sheet


def _size(motion: Array, twin: Array, cloth: Cloth) -> float:
    begin = len(motion) * 2 // 3
    distance = np.linalg.norm(motion[begin:] - twin[begin:], axis=-1).mean()
    return float(100 * distance / (0.5 * sum(cloth.size)))


def _sound(motion: Array, cloth: Cloth) -> bool:
    far = np.linalg.norm(motion - motion[0], axis=-1).max()
    return bool(np.isfinite(far) and far < FALLEN * 0.5 * sum(cloth.size))


def _labelled(scene: _Scene, motion: Array, timing: Timing, effect: str, size: float) -> LabelledClip:
    label = NONE if effect == NONE else EFFECTS[effect].label
    H, W = scene.cloth.grid
    return LabelledClip(
        label=label,
        effect=effect,
        size=size,
        scene=scene.number,
        motion=scene.clip.motion,
        positions=np.round(motion.reshape(timing.n_frames, H, W, 3) / _ROUNDED) * _ROUNDED,
        pinned=(0, W - 1),
        fps=timing.fps,
        gravity=np.array([0.0, GRAVITY, 0.0]),
        cloth_size=scene.cloth.size,
    )
