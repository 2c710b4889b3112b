"""The commands: one module each, with a function ``run(cfg)`` and a file of the same name in conf/."""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """A command of the command line.

    Attributes:
        module: module with ``run(cfg: DictConfig)``, imported only when the command is used.
        summary: one line for the overview.
        example: a call to learn from.
        plain: setting that arguments without "=" are for, "" where there are none.
        words: what such an argument may be, if it is no path.
        aliases: pairs of another name of a setting or group, and its name.
    """

    module: str
    summary: str
    example: str
    plain: str = ""
    words: tuple[str, ...] = ()
    aliases: tuple[tuple[str, str], ...] = ()


COMMANDS = {
    "fit": Command("toile.cli.fit", "reconstruct the cloth of one video", "scene=R1"),
    "evaluate": Command("toile.cli.evaluate", "measure a run against the ground truth", "run=<run folder>"),
    "report": Command(
        "toile.cli.report",
        "write the page of a run, or of several side by side",
        "<run folder> ...",
        plain="run",
    ),
    "tables": Command(
        "toile.cli.tables",
        "ablations as tables: CSV, Markdown, LaTeX",
        "<sweep folder> ...",
        plain="run",
    ),
    "export": Command(
        "toile.cli.export", "write a run for other programs", "run=<run folder> format=usd|glb|obj|ply"
    ),
    "generate": Command("toile.cli.generate", "make a synthetic scene with ground truth", ""),
    "train": Command("toile.cli.train", "train the neural surrogate of a step", "training=cpu"),
    "masks": Command(
        "toile.cli.masks",
        "cut the cloth out of your own video: frames and masks",
        "video=<file> scene=<new folder> method.box=[x0,y0,x1,y1]",
    ),
    "template": Command(
        "toile.cli.template",
        "make the template of your own video from a mesh, points or a flat sheet",
        "scene=<folder> surface=points surface.file=<file> camera.file=<file>",
    ),
    "diagnose": Command(
        "toile.cli.diagnose",
        "say why the simulation differs from the video: which effect is missing, and how far it helps",
        "scene=R1 diagnosis=quick",
    ),
    "calibrate": Command(
        "toile.cli.calibrate",
        "make probabilities of the diagnosis from scenes whose effect is known",
        "<run folder> ... labels=<file> source=<what they are>",
        plain="runs",
    ),
    "blind": Command(
        "toile.cli.blind",
        "check the diagnosis on scenes whose labels it cannot read",
        "make | run | extend | grade | train set=sessions_tiny",
        plain="action",
        words=("make", "run", "extend", "grade", "train"),
        aliases=(("set", "blind"),),
    ),
    "record": Command(
        "toile.cli.record",
        "print what to film for a session, or which recording a diagnosis asks for next",
        "diagnosis=<run folder>",
        plain="run",
        aliases=(("diagnosis", "run"),),
    ),
    "capture": Command(
        "toile.cli.capture",
        "people in moving garments: data, and body and garment from one camera",
        "data preset=demo folder=<new folder>",
        plain="action",
        words=("data", "page", "export", "pose", "warm", "physics", "adapt", "run", "tables", "diagnose"),
        aliases=(("preset", "capture"), ("ablation", "capture_ablation")),
    ),
    "subject": Command(
        "toile.cli.subject",
        "make a person to dress, from the body model anny or a skinned glTF file",
        "body=gltf body.file=<file.glb> file=<new file.npz>",
    ),
    "garment": Command(
        "toile.cli.garment",
        "fit a skirt, a dress or a mesh of your own to a person",
        "garment=dress garment.length=0.7 fabric=silk file=<new file.npz>",
        aliases=(("fabric", "fabric@garment.material"),),
    ),
    "doctor": Command("toile.cli.doctor", "look for what is wrong with a scene", "scene=R1"),
}


def overview() -> str:
    """What ``toile --help`` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    examples = [f"  toile {name} {command.example}".rstrip() for name, command in COMMANDS.items()]
    return "\n".join(
        (
            "toile reconstructs real cloth from one ordinary video.",
            "",
            "usage: toile <command> [key=value ...]",
            "       toile <command> -m key=a,b        one run per value",
            "       toile <command> --help            choices and settings",
            "       toile <command> --cfg job         show the configuration, run nothing",
            "",
            "commands:",
            *lines,
            "",
            "examples:",
            *examples,
            "",
            "completion by the tab key, for bash, zsh and fish:",
            '  eval "$(toile completion bash)"',
        )
    )
