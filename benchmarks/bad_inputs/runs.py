"""Run folders: torn, taken, full, of other settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bad_inputs.breaking import DEEP, arrays, at_once, copy, cut, put, remove
from bad_inputs.case import Case, Want
from bad_inputs.stock import DIAGNOSE, HALF, LONG, RUN, SHORT, TRAIN, TRAINING

RESUME, DISKS = "Run folders", "Disks and other processes"
CHECKPOINT = f"{HALF}/checkpoints/last.ckpt"
BESIDE = (*LONG, "optimization.cycles=60", "hydra.run.dir=new")
READY = "new/checkpoints/last.ckpt"


def _other_checkpoint(folder: Path) -> None:
    import torch

    torch.save({"weights": torch.zeros(3)}, folder / CHECKPOINT)


def _nan(found: dict[str, Any]) -> None:
    found["positions"][2, 0, 0, 0] = float("nan")


def _rename(found: dict[str, Any]) -> None:
    found["vertices"] = found.pop("positions")


def _full(size: int, what: str) -> Case:
    return Case(
        DISKS,
        f"a disk that is full after {size} KiB: {what}",
        (*SHORT, "hydra.run.dir=disk/run"),
        says=("no space|file too large",),
        want=Want.REFUSAL,
        disk=1024 * size,
    )


CASES = [
    Case(
        RESUME,
        "resume with another seed; then a plain resume",
        ("fit", f"resume={HALF}", "seed=5"),
        says=("seed", "5"),
        want=Want.REFUSAL,
        keeps=(CHECKPOINT, f"{HALF}/config.yaml"),
        then=(("fit", f"resume={HALF}"),),
    ),
    Case(
        RESUME,
        "resume with a misspelt key; then a plain resume",
        ("fit", f"resume={HALF}", "sede=5"),
        says=("sede",),
        want=Want.REFUSAL,
        keeps=(CHECKPOINT,),
        then=(("fit", f"resume={HALF}"),),
    ),
    Case(
        RESUME,
        "resume without its scene; then with it",
        ("fit", f"resume={HALF}", "scene.data_dir=elsewhere"),
        says=("cloth|elsewhere|scene",),
        want=Want.REFUSAL,
        keeps=(CHECKPOINT,),
        then=(("fit", f"resume={HALF}"),),
    ),
    Case(RESUME, "resume of nothing", ("fit", "resume=nowhere"), says=("nowhere",)),
    Case(RESUME, "resume without a folder", ("fit", "resume="), says=("resume|folder",)),
    Case(RESUME, "resume of a training as a fit", ("fit", f"resume={TRAINING}"), says=("fit",)),
    Case(
        RESUME,
        "resume without checkpoint",
        ("fit", f"resume={HALF}"),
        remove(CHECKPOINT),
        says=("last.ckpt",),
        keeps=(f"{HALF}/trajectory.npz",),
    ),
    *(
        Case(
            RESUME,
            f"checkpoint {name}",
            ("fit", f"resume={HALF}"),
            prepare,
            says=("last.ckpt",),
            want=Want.REFUSAL,
            keeps=(CHECKPOINT, f"{HALF}/trajectory.npz"),
        )
        for name, prepare in {
            "torn": cut(CHECKPOINT),
            "empty": put(CHECKPOINT, ""),
            "a text": put(CHECKPOINT, "no checkpoint"),
            "of something else": _other_checkpoint,
            "of a training": copy(f"{TRAINING}/checkpoints/last.ckpt", CHECKPOINT),
        }.items()
    ),
    Case(
        RESUME,
        "checkpoint of a training torn",
        ("train", f"resume={TRAINING}", "max_minutes=0.01"),
        cut(f"{TRAINING}/checkpoints/last.ckpt"),
        says=("last.ckpt",),
        want=Want.REFUSAL,
        keeps=(f"{TRAINING}/checkpoints/last.ckpt",),
    ),
    Case(
        RESUME,
        "another fit into a finished run",
        (*SHORT, "parameters.bending=3", f"hydra.run.dir={RUN}"),
        says=("bending", "3"),
        want=Want.REFUSAL,
        keeps=(f"{RUN}/trajectory.npz", f"{RUN}/metrics.json", f"{RUN}/config.yaml"),
        then=((*SHORT, f"hydra.run.dir={RUN}"),),
    ),
    Case(
        RESUME,
        "config.yaml of an interrupted fit broken",
        ("fit", f"resume={HALF}"),
        put(f"{HALF}/config.yaml", "{a: [b"),
        says=("config.yaml",),
        keeps=(CHECKPOINT,),
    ),
    Case(
        RESUME,
        "overrides.yaml of an interrupted fit broken",
        ("fit", f"resume={HALF}"),
        put(f"{HALF}/overrides.yaml", "{a: [b"),
        says=("overrides.yaml",),
        keeps=(CHECKPOINT,),
    ),
    Case(RESUME, "evaluate: no such run", ("evaluate", "run=nowhere"), says=("nowhere",)),
    Case(
        RESUME,
        "evaluate: trajectory torn",
        ("evaluate", f"run={RUN}"),
        cut(f"{RUN}/trajectory.npz"),
        says=("trajectory.npz",),
        keeps=(f"{RUN}/metrics.json",),
    ),
    Case(
        RESUME,
        "evaluate: trajectory of another version",
        ("evaluate", f"run={RUN}"),
        arrays(f"{RUN}/trajectory.npz", _rename),
        says=("trajectory.npz", "positions"),
        keeps=(f"{RUN}/metrics.json",),
    ),
    Case(
        RESUME,
        "evaluate: trajectory with nan",
        ("evaluate", f"run={RUN}"),
        arrays(f"{RUN}/trajectory.npz", _nan),
        says=("trajectory|positions", "nan|finite"),
        keeps=(f"{RUN}/metrics.json",),
    ),
    Case(
        RESUME,
        "evaluate: metrics.json nested 100,000 deep",
        ("evaluate", f"run={RUN}"),
        put(f"{RUN}/metrics.json", DEEP),
        says=("metrics.json",),
        keeps=(f"{RUN}/metrics.json",),
    ),
    Case(
        RESUME,
        "evaluate: the run's configuration broken",
        ("evaluate", f"run={RUN}"),
        put(f"{RUN}/config.yaml", "{a: [b"),
        says=("config.yaml",),
        keeps=(f"{RUN}/metrics.json",),
    ),
    Case(
        RESUME,
        "evaluate: the run's configuration would call something",
        ("evaluate", f"run={RUN}"),
        put(f"{RUN}/config.yaml", "scene:\n  _target_: os.system\n  command: touch called\n"),
        says=("os.system",),
        want=Want.REFUSAL,
    ),
    Case(
        RESUME,
        "evaluate: scene of another grid",
        ("evaluate", f"run={RUN}", "scene=other"),
        at_once(copy("data/made/cloth", "data/made/other"), put("data/made/other/scene.json", "{}")),
        says=("scene.json",),
        keeps=(f"{RUN}/metrics.json",),
    ),
    Case(
        RESUME,
        "report: the run's scene is gone",
        ("report", RUN),
        remove("data/made/cloth"),
        says=("cloth",),
        keeps=(f"{RUN}/index.html",),
    ),
    Case(
        RESUME,
        "report: history torn",
        ("report", RUN),
        put(f"{RUN}/history.csv", b"\x00\xff\xfe"),
        says=("history.csv",),
        keeps=(f"{RUN}/index.html",),
    ),
    Case(
        RESUME,
        "report: metrics.json is a list",
        ("report", RUN),
        put(f"{RUN}/metrics.json", "[]"),
        says=("metrics.json",),
        keeps=(f"{RUN}/index.html",),
    ),
    Case(RESUME, "report: a folder without runs", ("report", "data"), says=("run",)),
    Case(RESUME, "report: a page where a folder is", ("report", RUN, "output=data"), says=("data",)),
    Case(RESUME, "tables: no runs", ("tables", "data"), says=("run",)),
    Case(RESUME, "tables: an unknown metric", ("tables", RUN, "metrics=[beauty]"), says=("beauty",)),
    Case(
        RESUME,
        "tables: metrics.json broken",
        ("tables", RUN),
        put(f"{RUN}/metrics.json", "{"),
        says=("metrics.json",),
    ),
    Case(RESUME, "export: an unknown format", ("export", f"run={RUN}", "format=fbx"), says=("fbx", "glb")),
    Case(RESUME, "export: no such run", ("export", "run=nowhere"), says=("nowhere",)),
    Case(
        RESUME,
        "export: trajectory torn",
        ("export", f"run={RUN}"),
        cut(f"{RUN}/trajectory.npz"),
        says=("trajectory.npz",),
    ),
    # -- disks and other processes
    _full(8, "the configuration"),
    _full(48, "the first checkpoint"),
    _full(120, "TensorBoard's events"),
    _full(160, "the last checkpoint"),
    _full(250, "a figure"),
    _full(700, "the video or a figure"),
    _full(1000, "the page"),
    Case(
        DISKS,
        "a full disk under a training",
        (*TRAIN, "hydra.run.dir=disk/run"),
        says=("no space|file too large",),
        want=Want.REFUSAL,
        disk=100 * 1024,
    ),
    Case(
        DISKS,
        "a full disk under a diagnosis",
        (*DIAGNOSE, "hydra.run.dir=disk/run"),
        says=("no space|file too large",),
        want=Want.REFUSAL,
        disk=48 * 1024,
    ),
    Case(
        DISKS,
        "a full disk under an export",
        ("export", f"run={RUN}", "format=[glb,usd,obj,ply]", "folder=disk/out"),
        says=("no space|file too large",),
        want=Want.REFUSAL,
        disk=20 * 1024,
    ),
    Case(
        DISKS,
        "a full disk under a generated scene",
        ("generate", "preset=demo", "settings.n_frames=3", "folder=disk/made"),
        says=("no space|file too large",),
        want=Want.REFUSAL,
        disk=200 * 1024,
    ),
    Case(
        DISKS,
        "a full disk under masks",
        ("masks", "video=clip.mp4", "scene=disk/mine", "method=dark_background"),
        says=("no space|file too large",),
        want=Want.REFUSAL,
        disk=8 * 1024,
    ),
    Case(
        DISKS,
        "a disk that is read-only: fit",
        (*SHORT, "hydra.run.dir=disk/run"),
        says=("read-only",),
        want=Want.REFUSAL,
        read_only=True,
    ),
    Case(
        DISKS,
        "a disk that is read-only: evaluate",
        ("evaluate", "run=disk/run"),
        copy(RUN, "disk/run"),
        says=("read-only",),
        want=Want.REFUSAL,
        read_only=True,
        keeps=("disk/run/metrics.json",),
    ),
    Case(
        DISKS,
        "a disk that is read-only: report elsewhere",
        ("report", "disk/run", "output=page.html"),
        copy(RUN, "disk/run"),
        want=Want.SUCCESS,
        leaves=("page.html",),
        read_only=True,
    ),
    Case(
        DISKS,
        "a file where the run folder should be",
        (*SHORT, "hydra.run.dir=clip.mp4"),
        says=("clip.mp4",),
        keeps=("clip.mp4",),
    ),
    Case(
        DISKS,
        "a cache for kernels that is read-only",
        ("report", RUN, "output=page.html"),
        says=("kernels", "read-only"),
        environment={"WARP_CACHE_PATH": "disk/cache"},
        harmless=True,
        process=True,
        read_only=True,
    ),
    Case(
        DISKS,
        "a cache for kernels that is full",
        ("report", RUN, "output=page.html"),
        says=("kernels", "no space"),
        environment={"WARP_CACHE_PATH": "disk/cache"},
        harmless=True,
        process=True,
        disk=16 * 1024,
    ),
    Case(
        DISKS,
        "a second fit in the same folder",
        BESIDE,
        says=("process",),
        want=Want.REFUSAL,
        beside=BESIDE,
        ready=READY,
    ),
    Case(
        DISKS,
        "a second fit, by resume",
        ("fit", "resume=new"),
        says=("process",),
        want=Want.REFUSAL,
        beside=BESIDE,
        ready=READY,
    ),
    Case(
        DISKS,
        "a second fit with another seed; then the same again",
        (*BESIDE, "seed=3"),
        says=("process|seed",),
        want=Want.REFUSAL,
        beside=BESIDE,
        ready=READY,
        then=(BESIDE,),
    ),
    Case(
        DISKS,
        "a second diagnosis in the same folder",
        (*DIAGNOSE, "hydra.run.dir=new"),
        says=("process",),
        want=Want.REFUSAL,
        beside=BESIDE,
        ready=READY,
    ),
    Case(
        DISKS,
        "a lock of a process that is gone",
        (*SHORT, "hydra.run.dir=new"),
        at_once(put("new/.lock", ""), put("new/.process", "process 1 on nowhere")),
        want=Want.SUCCESS,
        leaves=("new/index.html",),
    ),
]
