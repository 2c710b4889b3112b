"""Sessions of several clips, and the sheet that says what to film."""

from __future__ import annotations

from bad_inputs.breaking import put
from bad_inputs.case import Case
from bad_inputs.stock import BLIND, DIAGNOSE, RUN, SCENE

SESSIONS, RECORDS = "Sessions", "Session sheets"
SESSION = f"{SCENE}/session.yaml"
ONE_CLIP = "clips:\n  - scene: ."


_OF_A_SCENE = ("scene=", "diagnosis.shooting.window=")
ALONE = tuple(argument for argument in DIAGNOSE if not argument.startswith(_OF_A_SCENE))


def case(wrong: str, text: str, *says: str) -> Case:
    """A diagnosis of a session whose file says so."""
    return Case(SESSIONS, wrong, (*ALONE, f"session={SCENE}"), put(SESSION, text), says=says)


CASES = [
    Case(SESSIONS, "no such folder", (*ALONE, "session=nowhere"), says=("nowhere",)),
    Case(SESSIONS, "a scene without session.yaml", (*ALONE, f"session={SCENE}"), says=("session.yaml",)),
    case("no clips", "clips: []\n", "clips"),
    case("not YAML", "clips: [\n", "session.yaml"),
    case("a list instead of entries", "- scene: .\n", "session.yaml"),
    case("an unknown entry", f"{ONE_CLIP}\nwinds: 2\n", "winds"),
    case("a clip that is not there", "clips:\n  - scene: clip_7\n", "clip_7"),
    case("plumb_line: maybe", f"{ONE_CLIP}\nplumb_line: maybe\n", "plumb_line"),
    Case(
        SESSIONS,
        "session.yaml is no text",
        (*ALONE, f"session={SCENE}"),
        put(SESSION, b"\xff\xfe\x00clips"),
        says=("session.yaml",),
    ),
    Case(
        SESSIONS,
        "a session and a scene",
        (*DIAGNOSE, f"session={SCENE}"),
        put(SESSION, f"{ONE_CLIP}\n"),
        says=("session", "scene"),
    ),
    Case(
        SESSIONS,
        "windows of a single clip",
        (*ALONE, f"session={SCENE}", "diagnosis.shooting.window=16"),
        put(SESSION, f"{ONE_CLIP}\n"),
        says=("diagnosis.shooting.window", "session_model.window"),
    ),
    Case(SESSIONS, "an unknown blind set", ("blind", "make", *BLIND, "set=huge"), says=("huge",)),
    # -- the sheet
    Case(RECORDS, "no clips", ("record", "clips=[]"), says=("clips",)),
    Case(RECORDS, "an unknown motion", ("record", "clips=[juggle]"), says=("juggle",)),
    Case(RECORDS, "no frames", ("record", "n_frames=0"), says=("frames",)),
    Case(RECORDS, "a negative frame rate", ("record", "fps=-25"), says=("fps|frame rate",)),
    Case(RECORDS, "a run that is not there", ("record", "run=nowhere"), says=("nowhere",)),
    Case(RECORDS, "a run that is no diagnosis", ("record", f"run={RUN}"), says=("diagnosis",)),
    Case(
        RECORDS,
        "a diagnosis that is torn",
        ("record", "run=torn"),
        put("torn/diagnosis.json", '{"verdict": '),
        says=("torn",),
    ),
    Case(
        RECORDS,
        "a diagnosis without a verdict",
        ("record", "run=torn"),
        put("torn/diagnosis.json", "{}"),
        says=("verdict",),
    ),
]
