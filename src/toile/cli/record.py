"""``toile record``: the sheet of a session to film, and after a diagnosis the recording that it asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig
from rich.table import Table
from rich.text import Text

from toile.cli.terminal import console
from toile.diagnosis.record import DIAGNOSIS_FILE
from toile.errors import InputError
from toile.generation.clip_plan import DEFAULT_CLIPS, ClipPlan
from toile.json_file import read_json_object


class Instruction(NamedTuple):
    """How to film a motion.

    Attributes:
        do: what to do.
        amplitude: of the hand or the cloth.
        tells: what the clip is for.
    """

    do: str
    amplitude: str
    tells: str


INSTRUCTIONS: Mapping[str, Instruction] = {
    "hang": Instruction(
        "hold both corners still; switch the fan on before you start",
        "corners: none; cloth: a tenth of its width",
        "wind and gusts against a cloth that nobody moves",
    ),
    "release": Instruction(
        "hold both corners still, fan and window shut; push the cloth aside, start the camera, let go",
        "lower edge a fifth of the width aside",
        "drag and damping, from how it comes to rest; gravity that is tilted",
    ),
    "shake": Instruction(
        "shake both corners together, one to two times a second",
        "1 to 3 cm there and back",
        "stiffness, bending and mass, from waves that run down",
    ),
    "sway": Instruction(
        "move both corners slowly to and fro, every two to four seconds",
        "3 to 10 cm there and back",
        "drag at larger speeds, contact, slipping corners",
    ),
    "turned": Instruction(
        "turn the cloth by 90°, hold the next pair of corners, then as shake",
        "1 to 3 cm there and back",
        "what depends on warp and weft, or on a place of the cloth",
    ),
    "fan_off": Instruction(
        "as shake, with fan, window and heating off",
        "1 to 3 cm there and back",
        "wind apart from gravity that is tilted",
    ),
}

COSTS: Sequence[tuple[str, str]] = (
    ("two clips instead of three", "cause ranked first 0.61 instead of 0.64; 90 % set of 5.9 instead of 4.4"),
    ("one clip instead of three", "cause ranked first 0.50 instead of 0.64; 90 % set of 5.6 instead of 4.4"),
    ("25 frames a second instead of 50", "cause ranked first 0.59 instead of 0.62, from one clip"),
)
"""What less costs: share of simulated sessions whose cause the learned decision ranks first among effects
(docs/results/learned_decision.csv)."""

ALWAYS = (
    "the same cloth, held at the same two corners (but for turned); camera on a tripod, never moved",
    "the whole cloth in view, sharp, evenly lit; exposure short enough that nothing is blurred",
    "frame 0 at rest: start the camera before you move anything",
    "a plumb line in view settles where gravity points, a clock the frame rate: say so in session.yaml",
)


def run(cfg: DictConfig) -> None:
    """Print the sheet, or the recording that a diagnosis asks for.

    Raises:
        InputError: a motion that is none, no clips, or no diagnosis that can be read.
    """
    if cfg.run is not None:
        _print_next(Path(str(cfg.run)))
        return
    if not len(cfg.clips):
        raise InputError("A session needs a clip", where="clips", expected="one or more", got="none")
    plans = [ClipPlan(str(motion), int(cfg.n_frames), float(cfg.fps)) for motion in cfg.clips]
    out = console()
    out.print(_sheet(plans))
    for line in ALWAYS:
        out.print(Text(f"- {line}"))
    out.print(Text("\nWhat less costs (simulated sessions, from the motion alone):"))
    for less, cost in COSTS:
        out.print(Text(f"- {less}: {cost}"))
    out.print(Text(f"\nsession.yaml, beside the folders of the clips:\n{_skeleton(plans)}"))
    missing = len(DEFAULT_CLIPS) - len(plans)
    if missing > 0:
        out.print(Text(f"{missing} clips fewer than usual: expect a set of candidates, not one name."))


def next_recording(path: Path) -> dict[str, Any] | str:
    """What the diagnosis in a run folder asks for; "" for nothing.

    Args:
        path: of the folder, or of its diagnosis.json.

    Raises:
        InputError: there is no diagnosis, or none that can be read.
    """
    file = path if path.is_file() else path / DIAGNOSIS_FILE
    try:
        values = read_json_object(file)
        asked = values.get("next_recording", values["verdict"].get("next_recording"))
        session = values.get("session")
        if isinstance(session, Mapping) and session.get("next_clip"):
            gains = {str(m): float(gain) for m, gain in session["expected_information"].items()}
            asked = {"motion": str(session["next_clip"]), "expected information [nats]": gains}
        if asked is not None and not isinstance(asked, str | dict):
            raise ValueError("next_recording is neither a text nor an object")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            "No diagnosis can be read",
            where=str(file),
            expected="the run folder of toile diagnose",
            got=f"{type(error).__name__}: {error}",
        ) from error
    return asked or ""


def _print_next(path: Path) -> None:
    asked = next_recording(path)
    out = console()
    if not asked:
        out.print(Text("The diagnosis asks for no other recording."))
        return
    if isinstance(asked, str):
        out.print(Text(f"Next recording: {asked}"))
        return
    motion = str(asked.get("motion", ""))
    out.print(Text(f"Next recording: {motion or 'see below'}"))
    if motion in INSTRUCTIONS:
        instruction = INSTRUCTIONS[motion]
        out.print(Text(f"- {instruction.do}\n- {instruction.amplitude}\n- tells {instruction.tells}"))
    for key, value in asked.items():
        if key != "motion":
            out.print(Text(f"- {key}: {_said(value)}"))


def _sheet(plans: Sequence[ClipPlan]) -> Table:
    table = Table(title=Text("Session sheet"), title_justify="left")
    for heading in ("clip", "do", "amplitude", "length", "tells"):
        table.add_column(heading)
    for plan in plans:
        instruction = INSTRUCTIONS[plan.motion]
        length = f"{plan.n_frames} frames at {plan.fps:g} a second: {plan.n_frames / plan.fps:.1f} s"
        cells = (plan.motion, instruction.do, instruction.amplitude, length, instruction.tells)
        table.add_row(*(Text(cell, overflow="fold") for cell in cells))
    return table


def _skeleton(plans: Sequence[ClipPlan]) -> str:
    lines = ["clips:"]
    for k, plan in enumerate(plans):
        lines += [f"  - scene: clip_{k}", f"    motion: {plan.motion}"]
        if plan.motion in ("turned", "fan_off"):
            lines.append(f"    changed: [{'grip' if plan.motion == 'turned' else 'fan'}]")
    return "\n".join((*lines, "plumb_line: false", "clock: false"))


def _said(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list):
        return ", ".join(map(_said, value))
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_said(v)}" for k, v in value.items())
    return str(value)
