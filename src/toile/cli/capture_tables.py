"""``toile capture tables``: trained networks and what they are compared with, measured on held-out clips."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path

from omegaconf import DictConfig

from toile.atomic_file import write_text
from toile.capture.data.clips import TRUTH_FILE
from toile.capture.data.making import clips_of
from toile.capture.metrics.reconstruction import MeasuredClip, Measures, combined
from toile.capture.rows import ROWS, Case
from toile.capture.test_time.finish import FinishSettings
from toile.capture.training.weights import load_networks, weights_digest
from toile.cli.configuration import instantiate
from toile.cli.terminal import print_path
from toile.errors import InputError
from toile.json_file import read_json_object
from toile.physics.simulator import SimulationError
from toile.progress import Shown
from toile.rendering.warp.renderer import WarpRenderer
from toile.reports.capture_tables import Line, write_capture_tables

log = logging.getLogger(__name__)

_WHEN = ("before_resolution", "after_resolution")


def write_tables(cfg: DictConfig) -> None:
    """Measure what is trained, row by row and seed by seed, and write the tables.

    What was measured before is kept in ``<trained>/tables`` and taken from there as long as weights, clip and
    settings are the same; with ``tables.known`` that is all that there is. A row that misses something is
    named and left out.

    Raises:
        InputError: no such row, no held-out clips, or no weights at all.
    """
    names = list(ROWS) if cfg.tables.rows is None else [str(name) for name in cfg.tables.rows]
    unknown = [name for name in names if name not in ROWS]
    if unknown:
        raise InputError("No such row", where="tables.rows", expected=", ".join(ROWS), got=", ".join(unknown))
    domains = {str(k): [Path(str(p)) for p in v] for k, v in cfg.tables.domains.items() if v is not None}
    if not domains:
        raise InputError(
            "No clips to measure on",
            where="tables.domains",
            expected="tables.domains.own=[<data set or clip>, ...]",
            got="none",
        )
    wanted = [] if cfg.tables.ablations_on is None else [str(name) for name in cfg.tables.ablations_on]
    if strange := [name for name in wanted if name not in domains]:
        raise InputError(
            "No such domain",
            where="tables.ablations_on",
            expected=", ".join(domains),
            got=", ".join(strange),
        )
    trained = Path(str(cfg.tables.trained))
    settings: FinishSettings = instantiate(cfg.finish)
    lines = list(_lines(cfg, names, domains, trained, settings))
    if not lines:
        raise InputError(
            "Nothing is trained",
            where=str(trained),
            expected="seed0/pose/weights.pt and its like, as make capture-tables makes them",
            got="none of them",
        )
    titles = {name: row.title for name, row in ROWS.items()}
    for path in write_capture_tables(lines, Path(str(cfg.tables.output)), titles, str(cfg.tables.note)):
        print_path(path)


def _lines(
    cfg: DictConfig,
    names: list[str],
    domains: Mapping[str, list[Path]],
    trained: Path,
    settings: FinishSettings,
) -> Iterator[Line]:
    """Two lines for each row, domain and seed."""
    with Shown(log) as progress:
        chosen = cfg.tables.ablations_on
        missing = "not measured" if cfg.tables.known else "no weights or no motion"
        work = [
            (d, s, n)
            for s in cfg.tables.seeds
            for n in names
            for d in domains
            if chosen is None or not ROWS[n].ablation or d in chosen
        ]
        for done, (domain, seed, name) in enumerate(work):
            progress("rows", done, len(work), f"{name}, {domain}, seed {seed}")
            clips = [clip for folder in domains[domain] for clip in clips_of(folder)]
            found = [_measured(cfg, name, domain, int(seed), clip, trained, settings) for clip in clips]
            known = [m for m in found if m is not None]
            if len(known) < len(clips):
                log.warning("%s, %s, seed %d: left out, %s", name, domain, int(seed), missing)
                continue
            for when in _WHEN:
                together = combined([m[when] for m in known])
                yield Line(name, domain, int(seed), when == _WHEN[0], together)
        progress("rows", len(work), len(work))


def _measured(
    cfg: DictConfig,
    name: str,
    domain: str,
    seed: int,
    clip: Path,
    trained: Path,
    settings: FinishSettings,
) -> Mapping[str, Measures] | None:
    """Measures of a clip before and after the resolution, or None without weights."""
    row = ROWS[name]
    view = int(cfg.view)
    place = f"{clip.name}-camera{view}"
    weights = trained / f"seed{seed}" / row.weights.format(domain=domain, clip=place)
    if not weights.is_file():
        return None
    key = {
        "weights": weights_digest(weights),
        "clip": sha256((clip / TRUTH_FILE).read_bytes()).hexdigest()[:16],
        "settings": json.loads(json.dumps(asdict(settings))),
        "every": int(cfg.every),
        "view": view,
    }
    file = trained / "tables" / f"{name}-{domain}-{clip.name}-seed{seed}.json"
    if file.is_file():
        kept = read_json_object(file)
        if kept.get("key") == key:
            return {when: Measures.from_dict(kept[when]) for when in _WHEN}
    if cfg.tables.known:
        return None
    networks = load_networks(weights)
    measured = MeasuredClip.load(clip, WarpRenderer(2), view, int(cfg.every))
    networks.check_belongs(measured.subject, measured.garment, where=str(clip))
    try:
        outcome = row.method(Case(networks, measured, settings))
    except SimulationError as error:
        log.warning("%s, %s, seed %d: %s", name, clip.name, seed, error)
        return None
    found = {
        when: measured.measure(what)
        for when, what in zip(_WHEN, (outcome.before, outcome.after), strict=True)
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    content = {"key": key, **{when: m.to_dict() for when, m in found.items()}}
    write_text(file, json.dumps(content, indent=1) + "\n")
    return found
