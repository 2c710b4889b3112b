"""Reading motions from animated glTF files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from toile.capture.gltf_file import Floats, GltfFile, composed, read_gltf, world_transforms
from toile.capture.motion.skeleton_motion import SkeletonMotion
from toile.errors import InputError


def read_gltf_motion(path: Path | str, fps: float, animation: int = 0) -> SkeletonMotion:
    """Sample an animation of a file's nodes; at rest they are where the file poses them without it.

    Args:
        path: .glb or .gltf.
        fps: frames a second to sample with.
        animation: which one.

    Raises:
        InputError: no such animation, or one that moves no node.
    """
    gltf = read_gltf(path)
    animations = gltf.items("animations")
    if not 0 <= animation < len(animations):
        raise InputError(
            "glTF file has no such animation",
            where=str(path),
            expected=f"0 to {len(animations) - 1}" if animations else "an animated file",
            got=str(animation) if animations else "no animation",
        )
    tracks = _tracks(gltf, animations[animation])
    if not tracks:
        raise InputError(
            "Animation moves no node",
            where=str(path),
            expected="channels of rotation or translation",
            got=f"{len(animations[animation].get('channels', []))} channels",
        )
    start = min(float(times[0]) for times, *_ in tracks.values())
    end = max(float(times[-1]) for times, *_ in tracks.values())
    at = start + np.arange(int((end - start) * fps + 1e-6) + 1) / fps
    nodes = gltf.items("nodes")
    rest = gltf.node_transforms()
    local = np.tile(rest, (len(at), 1, 1, 1))
    for index, node in enumerate(nodes):
        moved = {kind: tracks[index, kind] for kind in _AT_REST if (index, kind) in tracks}
        if moved:
            values = {
                kind: _sampled(*moved[kind], at, kind)
                if kind in moved
                else np.tile(np.array(node.get(kind, usual), dtype=np.float64), (len(at), 1))
                for kind, usual in _AT_REST.items()
            }
            local[:, index] = composed(values["translation"], values["rotation"], values["scale"])
    parents = gltf.parents()
    order = _chosen(gltf, parents)
    still, posed = world_transforms(rest, parents), world_transforms(local, parents)
    turns = _rotation(posed[:, order]) @ _rotation(still[order]).swapaxes(-1, -2)
    return SkeletonMotion(
        tuple(str(nodes[node].get("name", f"node_{node}")) for node in order),
        tuple(order.index(parents[node]) if parents[node] in order else -1 for node in order),
        torch.from_numpy(still[order, :3, 3].copy()),
        torch.from_numpy(np.ascontiguousarray(turns)),
        torch.from_numpy(posed[:, order][..., :3, 3].copy()),
        fps,
        str(path),
    )


_AT_REST = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}

_Track = tuple[Floats, Floats, str]


def _tracks(gltf: GltfFile, animation: dict[str, Any]) -> dict[tuple[int, str], _Track]:
    """Times, values and interpolation by node and kind."""
    tracks: dict[tuple[int, str], _Track] = {}
    for channel in animation.get("channels", []):
        target = channel["target"]
        if target.get("path") not in _AT_REST or "node" not in target:
            continue
        sampler = animation["samplers"][channel["sampler"]]
        times = gltf.array(sampler["input"]).astype(np.float64)
        values = gltf.array(sampler["output"]).astype(np.float64)
        how = sampler.get("interpolation", "LINEAR")
        if how == "CUBICSPLINE":
            # In-tangent, value, out-tangent of each key: its value is kept, and joined linearly.
            values = values.reshape(len(times), 3, -1)[:, 1]
        tracks[int(target["node"]), str(target["path"])] = times, values, how
    return tracks


def _sampled(times: Floats, values: Floats, how: str, at: Floats, kind: str) -> Floats:
    low = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 1)
    high = np.minimum(low + 1, len(times) - 1)
    span = np.where(high > low, times[high] - times[low], 1.0)
    share = np.clip((at - times[low]) / span, 0.0, 1.0)[:, None]
    if how == "STEP":
        share = np.zeros_like(share)
    a, b = values[low], values[high]
    if kind != "rotation":
        return np.asarray(a + share * (b - a), dtype=np.float64)
    cosine = (a * b).sum(1, keepdims=True)
    b, cosine = np.where(cosine < 0, -b, b), np.abs(cosine)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    sine = np.maximum(np.sin(angle), 1e-12)
    slerp = (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / sine
    return np.where(angle < 1e-6, a + share * (b - a), slerp)


def _chosen(gltf: GltfFile, parents: list[int]) -> list[int]:
    """Nodes of the skeleton, parents first: the joints of the skins, or all nodes where there is none."""
    joints = {joint for skin in gltf.items("skins") for joint in skin["joints"]}
    chosen = joints or set(range(len(parents)))
    order = [node for node in sorted(chosen) if parents[node] not in chosen]
    for node in order:
        order += [child for child in sorted(chosen) if parents[child] == node]
    return order


def _rotation(transforms: Floats) -> Floats:
    u, _, v = np.linalg.svd(transforms[..., :3, :3])
    return np.asarray(u @ v, dtype=np.float64)
