"""What a loader accepts, other commands can use, and a fit cannot do anything sensible with.

``check_possible``: no fit exists. ``check_plausible``: a fit would run and its result would mean nothing; who
knows better says ``force=true``. The thresholds are far beyond anything that is filmed.
"""

from __future__ import annotations

import math

from toile.scenes.findings import Finding, Severity
from toile.scenes.scene import Scene
from toile.scenes.validation import silhouette_overlap

FEWEST_FRAMES = 2
SLOWEST, FASTEST = 1.0, 10_000.0  # frames per second: from time lapse to high-speed cameras
STRONGEST_GRAVITY = 30.0  # m/s², three times the earth's; 9810 are mm/s²
LEAST_INSIDE = 0.5  # share of the vertices that must project into mask 0; a sound scene has above 0.9
FULL_MASK = 0.995  # share of an image from which on a mask tells no outline
SHORTEST_EDGE = 1e-4  # of the rest length; below, two vertices are one


def check_fit(scene: Scene) -> list[Finding]:
    """Everything that stops a fit."""
    return [*check_possible(scene), *check_plausible(scene)]


def check_possible(scene: Scene) -> list[Finding]:
    """More than one frame, a free vertex, and no two neighbours at the same place."""
    where = _where(scene)
    findings = []
    if scene.n_frames < FEWEST_FRAMES:
        findings.append(
            _error(
                "Too few frames for a fit",
                f"{where}: n_frames",
                f"at least {FEWEST_FRAMES} frames",
                f"{scene.n_frames}",
            )
        )
    H, W = scene.grid
    if len(scene.pinned_vertices) >= H * W:
        findings.append(
            _error(
                "All vertices are pinned, so nothing moves",
                f"{where}: pinned_vertices",
                "at least one vertex that is not pinned",
                f"{len(scene.pinned_vertices)} of {H * W}",
            )
        )
    x = scene.template.double()
    shortest = [
        (float(edges.min()) / (side / (n - 1)), int(edges.argmin()), axis)
        for axis, (edges, side, n) in enumerate(
            zip(
                ((x[1:] - x[:-1]).norm(dim=-1), (x[:, 1:] - x[:, :-1]).norm(dim=-1)),
                scene.cloth_size,
                (H, W),
                strict=True,
            )
        )
    ]
    ratio, index, axis = min(shortest)
    if ratio < SHORTEST_EDGE:
        first = index if axis == 0 else index // (W - 1) * W + index % (W - 1)
        second = first + (W if axis == 0 else 1)
        findings.append(
            _error(
                "Template vertices coincide",
                f"{where}: template",
                "neighbours at a distance from each other, since a spring of no length has no direction",
                f"vertices {first} and {second} at the same place",
            )
        )
    return findings


def check_plausible(scene: Scene) -> list[Finding]:
    """Frame rate, gravity, projection and masks within what can be filmed."""
    where = _where(scene)
    findings = []
    if not SLOWEST <= scene.fps <= FASTEST:
        findings.append(
            _error(
                "Nobody films a moving cloth at this frame rate",
                f"{where}: fps",
                f"{SLOWEST:g} to {FASTEST:g} frames per second",
                f"{scene.fps:g}",
            )
        )
    strength = float(scene.gravity.norm())
    if not math.isfinite(strength) or strength > STRONGEST_GRAVITY:
        findings.append(
            _error(
                "Gravity is far too strong",
                f"{where}: gravity",
                f"at most {STRONGEST_GRAVITY:g} m/s² (9.81 on earth; 9810 would be mm/s²)",
                f"{strength:g} m/s²",
            )
        )
    full = [k for k, mask in enumerate(scene.masks) if float((mask > 0.5).double().mean()) > FULL_MASK]
    whole_image = tuple(scene.masks.shape[1:]) == tuple(scene.original_size)
    if whole_image and len(full) == scene.n_frames:
        findings.append(
            _error(
                "Masks cover the whole image",
                f"{where}: masks",
                "0 outside the cloth, 255 inside",
                f"{len(full)} of {scene.n_frames} masks that are white all over",
            )
        )
    _, inside = silhouette_overlap(scene.template, scene.camera, scene.masks[0])
    if inside < LEAST_INSIDE:
        findings.append(
            _error(
                "The template does not lie where the cloth is seen",
                f"{where}: K and template",
                f"at least {100 * LEAST_INSIDE:g} % of the vertices inside mask 0; a wrong focal length or "
                "wrong units put them elsewhere",
                f"{100 * inside:.0f} %",
            )
        )
    return findings


def _where(scene: Scene) -> str:
    return scene.name if scene.source is None else str(scene.source)


def _error(what: str, where: str, expected: str, got: str) -> Finding:
    return Finding(Severity.ERROR, what, where, expected, got)
