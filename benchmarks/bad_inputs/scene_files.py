"""Scenes whose files are wrong."""

from __future__ import annotations

from typing import Any

import numpy as np

from bad_inputs.breaking import (
    DEEP,
    Breaker,
    at_once,
    copy,
    cut,
    edit,
    image,
    link,
    move,
    put,
    remove,
    text,
    values,
    vertices,
    without,
)
from bad_inputs.case import Case, Want
from bad_inputs.stock import FIT, SCENE

GROUP = "Files of a scene"
JSON, OBJ = f"{SCENE}/scene.json", f"{SCENE}/template.obj"
RUN = (*FIT, "hydra.run.dir=new")
H = W = 8


def _fit(wrong: str, prepare: Breaker, *says: str, want: Want = Want.COMPLAINT) -> Case:
    return Case(GROUP, wrong, RUN, prepare, says, want)


def _doctor(wrong: str, prepare: Breaker, *says: str) -> Case:
    return Case(GROUP, f"{wrong} (doctor)", ("doctor", "scene=cloth"), prepare, says)


def _both(wrong: str, prepare: Breaker, *says: str) -> list[Case]:
    return [_fit(wrong, prepare, *says), _doctor(wrong, prepare, *says)]


def _shuffled(x: np.ndarray) -> np.ndarray:
    return x[np.random.default_rng(1).permutation(len(x))]


def _transposed(x: np.ndarray) -> np.ndarray:
    return x.reshape(H, W, 3).transpose(1, 0, 2).reshape(-1, 3)


def _focal(factor: float) -> Breaker:
    def change(scene: dict[str, Any]) -> None:
        scene["K"][0][0] *= factor
        scene["K"][1][1] *= factor

    return edit(JSON, change)


def _transpose_k(scene: dict[str, Any]) -> None:
    scene["K"] = [list(row) for row in zip(*scene["K"], strict=True)]


def _seam(obj: str) -> str:
    """One face uses another texture coordinate for a vertex that it shares."""
    lines = obj.splitlines()
    n = sum(line.startswith("vt ") for line in lines)
    face = next(k for k, line in enumerate(lines) if line.startswith("f "))
    words = lines[face].split()
    # The third corner is inside the grid: other faces have it, too.
    words[3] = words[3].split("/")[0] + f"/{n}"
    lines[face] = " ".join(words)
    return "\n".join(lines) + "\n"


CASES = [
    Case(GROUP, "no such scene", ("fit", "scene=nowhere", "hydra.run.dir=new"), says=("nowhere",)),
    Case(GROUP, "no scene at all", ("fit", "hydra.run.dir=new"), says=("scene=",)),
    _fit("scene.json missing", remove(JSON), "scene.json"),
    _fit("scene.json is cut off", cut(JSON), "scene.json", "JSON"),
    _fit("scene.json is a list", put(JSON, "[1, 2]"), "scene.json", "list"),
    _fit("scene.json is empty", put(JSON, ""), "scene.json", "JSON"),
    *_both("scene.json is nested 100,000 deep", put(JSON, DEEP), "scene.json", "nested|deep|recursion"),
    _fit("scene.json is no UTF-8", put(JSON, b"\xff\xfe{\x00}"), "scene.json", "utf-8|decode|JSON"),
    _fit("frame rate missing", without(JSON, "fps"), "fps"),
    _fit("frame rate 0", values(JSON, fps=0), "fps|frame rate", "0"),
    _fit("frame rate negative", values(JSON, fps=-25), "fps|frame rate", "-25"),
    _fit("frame rate 1e9", values(JSON, fps=1e9), "fps|frame rate"),
    _fit("frame rate nan", values(JSON, fps=float("nan")), "fps|frame rate", "nan"),
    _fit("frame rate a text", values(JSON, fps="fast"), "fps", "fast"),
    _fit("frame rate a number of 400 digits", values(JSON, fps=10**400), "fps"),
    *_both("one frame", values(JSON, n_frames=1), "frame"),
    _fit("more frames than files", values(JSON, n_frames=13), "rgb_012.png"),
    _fit("a billion frames", values(JSON, n_frames=10**9), "rgb_012.png"),
    _fit("height and width exchanged", values(JSON, image_size=[96, 97]), "image", "96"),
    _fit("K transposed", edit(JSON, _transpose_k), "K", "transposed"),
    *_both("focal length ten times too large", _focal(10), "project|mask|focal|K"),
    *_both("focal length ten times too small", _focal(0.1), "project|mask|focal|K"),
    *_both("gravity 9810 (millimetres)", values(JSON, gravity=[0, 9810, 0]), "gravity"),
    *_both("gravity zero", values(JSON, gravity=[0, 0, 0]), "gravity"),
    *_both("gravity upwards", values(JSON, gravity=[0, -9.81, 0]), "gravity"),
    _fit("gravity nan", values(JSON, gravity=[0, float("nan"), 0]), "gravity"),
    _fit("units: millimetres", values(JSON, units="millimetres"), "units|metres"),
    *_both("template in millimetres", vertices(OBJ, lambda x: 1000 * x), "millimetres|metres"),
    _fit("cloth size ten times too large", values(JSON, cloth_size_m=[4, 4]), "cloth size|cloth_size|units"),
    _fit("cloth size negative", values(JSON, cloth_size_m=[-0.4, 0.4]), "cloth_size"),
    _fit("grid of another shape", values(JSON, grid=[7, 8]), "grid"),
    _fit("vertices permuted", vertices(OBJ, _shuffled), "order|permuted"),
    *_both("axes of the template swapped", vertices(OBJ, _transposed), "transposed|order|held"),
    _fit("two vertices coincide", vertices(OBJ, lambda x: np.vstack((x[:1], x[:1], x[2:]))), "vert|edge"),
    _fit("all vertices coincide", vertices(OBJ, lambda x: 0 * x + x[:1]), "vert|edge|template|size"),
    _fit("template behind the camera", vertices(OBJ, lambda x: x * [1, 1, -1]), "behind"),
    _fit(
        "template without texture coordinates", text(OBJ, lambda t: t.replace("\nvt ", "\n# ")), "texture|vt"
    ),
    _fit("template with a texture seam", text(OBJ, _seam), "seam"),
    _fit("template with nan", vertices(OBJ, lambda x: np.vstack((x[:-1], [[np.nan] * 3]))), "nan|finite"),
    _fit("template is no OBJ", put(OBJ, b"\x00\x01\x02"), "template.obj"),
    _fit("pinned vertex out of range", values(JSON, pinned_vertices=[0, 64]), "pinned", "64"),
    *_both("all vertices held", values(JSON, pinned_vertices=list(range(64))), "pinned"),
    *_both("no vertex held", values(JSON, pinned_vertices=[]), "pinned"),
    _fit("texture missing", remove(f"{SCENE}/texture.png"), "texture.png"),
    _fit("frame missing", remove(f"{SCENE}/rgbs/rgb_003.png"), "rgb_003.png"),
    _fit("frame cut off", cut(f"{SCENE}/rgbs/rgb_003.png"), "rgb_003.png"),
    _fit(
        "frame of another size", image(f"{SCENE}/rgbs/rgb_003.png", lambda x: x[:50]), "rgb_003.png", "size"
    ),
    _fit("mask empty", image(f"{SCENE}/masks/mask_003.png", lambda x: 0 * x), "mask_003.png", "empty"),
    *_both("all masks white", image(f"{SCENE}/masks/*.png", lambda x: 0 * x + 255), "mask"),
    *_both("masks inverted", image(f"{SCENE}/masks/*.png", lambda x: 255 - x), "mask"),
    _fit("masks of another clip", image(f"{SCENE}/masks/*.png", lambda x: np.roll(x, 40, 1)), "mask"),
    _fit("ground truth of another grid", put(f"{SCENE}/ground_truth/vertices.npy", b"no"), "vertices.npy"),
    _fit(
        "files: the texture by an absolute path",
        at_once(
            move(f"{SCENE}/texture.png", "outside/texture.png"),
            lambda folder: values(JSON, files={"texture": str(folder / "outside" / "texture.png")})(folder),
        ),
        "outside",
        want=Want.REFUSAL,
    ),
    _fit(
        "files: frames by ..",
        at_once(copy(f"{SCENE}/rgbs", "data/rgbs"), values(JSON, files={"rgb": "../../rgbs/rgb_%03d.png"})),
        "outside",
        want=Want.REFUSAL,
    ),
    _fit(
        "the texture is a link that leads outside",
        at_once(
            copy(f"{SCENE}/texture.png", "outside/texture.png"),
            link(f"{SCENE}/texture.png", "outside/texture.png"),
        ),
        "outside",
        want=Want.REFUSAL,
    ),
    _fit("files: a pattern without number", values(JSON, files={"rgb": "rgbs/rgb.png"}), "files", "%03d"),
    _fit("files: a pattern that would fill the memory", values(JSON, files={"rgb": "%999999999d"}), "files"),
]
