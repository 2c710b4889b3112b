"""Paths that are unusual and right: they must work."""

from __future__ import annotations

from bad_inputs.breaking import Breaker, copy, move, put
from bad_inputs.case import Case, Want
from bad_inputs.stock import GENERATE, RUN, SCENE, SHORT

GROUP = "Unusual but right"
BOM = b"\xef\xbb\xbf"


def _bom(name: str) -> Breaker:
    return lambda folder: put(name, BOM + (folder / name).read_bytes())(folder)


NAMES = {
    "spaces": "my cloth",
    "commas": "red,blue",
    "an equals sign": "seed=0",
    "umlauts and an ideogram": "Stoffhülle 布",
    "brackets": "cloth (2) [new]",
    "a quotation mark": "mother's cloth",
    "a percent sign": "50% cotton",
}


def _named(kind: str, name: str) -> list[Case]:
    return [
        Case(
            GROUP,
            f"a scene's folder with {kind}: doctor",
            ("doctor", f"scene={name}"),
            move(SCENE, f"data/made/{name}"),
            want=Want.SUCCESS,
        ),
        Case(
            GROUP,
            f"a run's folder with {kind}: evaluate",
            ("evaluate", f"run={name}"),
            copy(RUN, name),
            want=Want.SUCCESS,
            leaves=(f"{name.replace('[', '[[]')}/metrics.json",),
        ),
        Case(
            GROUP,
            f"a run's folder with {kind}: report",
            ("report", name),
            copy(RUN, name),
            want=Want.SUCCESS,
            leaves=(f"{name.replace('[', '[[]')}/index.html",),
        ),
    ]


CASES = [
    *(case for kind, name in NAMES.items() for case in _named(kind, name)),
    Case(
        GROUP,
        "fit, scene and folder with spaces",
        ("fit", "scene=my cloth", *SHORT[2:], "hydra.run.dir=my run"),
        move(SCENE, "data/made/my cloth"),
        want=Want.SUCCESS,
        leaves=("my run/index.html",),
    ),
    Case(
        GROUP,
        "resume of a folder with spaces",
        ("fit", "resume=half a run"),
        move("half", "half a run"),
        want=Want.SUCCESS,
        leaves=("half a run/index.html",),
    ),
    Case(
        GROUP,
        "scene.json with a byte-order mark",
        ("doctor", "scene=cloth"),
        _bom(f"{SCENE}/scene.json"),
        want=Want.SUCCESS,
    ),
    Case(
        GROUP,
        "metrics.json with a byte-order mark",
        ("evaluate", f"run={RUN}"),
        _bom(f"{RUN}/metrics.json"),
        want=Want.SUCCESS,
    ),
    Case(
        GROUP,
        "tables: nothing in the current folder",
        ("tables", RUN),
        want=Want.SUCCESS,
        leaves=(f"{RUN}/tables/ablations.csv",),
    ),
    Case(
        GROUP,
        "five frames",
        (*SHORT[:-2], "scene.n_frames=5", SHORT[-1], "hydra.run.dir=new"),
        want=Want.SUCCESS,
        leaves=("new/index.html",),
    ),
    Case(
        GROUP,
        "generate into a folder with spaces",
        (*GENERATE, "folder=a new scene"),
        want=Want.SUCCESS,
        leaves=("a new scene/scene.json",),
    ),
]
