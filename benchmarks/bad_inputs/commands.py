"""Commands that are wrong as a whole, and blind sets."""

from __future__ import annotations

from bad_inputs.breaking import DEEP, at_once, cut, put, remove, values
from bad_inputs.case import Case, Want
from bad_inputs.stock import BLIND, BLIND_KEY, BLIND_SET, GENERATE, RUN, SCENE

GROUP, SETS, CALIBRATIONS = "Commands", "Blind sets", "Calibrations"
PREDICTIONS = "outputs/blind_predictions/tiny"
RUN_SET = ("blind", "run", *BLIND)

CASES = [
    Case(GROUP, "no such command", ("fits", "scene=cloth"), says=("fits", "fit")),
    Case(GROUP, "a command as a path", ("./fit",), says=("./fit",)),
    Case(GROUP, "an unknown flag", ("fit", "--fast", "scene=cloth"), says=("--fast",)),
    Case(GROUP, "doctor without scene", ("doctor",), says=("scene=",)),
    Case(GROUP, "doctor of nothing", ("doctor", "scene=nowhere"), says=("nowhere",)),
    Case(GROUP, "doctor of a file", ("doctor", "scene=clip.mp4"), says=("clip.mp4",)),
    Case(GROUP, "evaluate without run", ("evaluate",), says=("run=",)),
    Case(GROUP, "report without run", ("report",), says=("run",)),
    Case(
        GROUP,
        "generate over an existing scene",
        (*GENERATE, f"folder={SCENE}"),
        says=("overwrite|exists",),
        keeps=(f"{SCENE}/scene.json",),
    ),
    Case(GROUP, "generate: no such preset", ("generate", "preset=dmo"), says=("dmo", "demo")),
    Case(GROUP, "generate: no such template", ("generate", "template=R77"), says=("R77",)),
    Case(GROUP, "subject without a file", ("subject",), says=("file",)),
    Case(
        GROUP,
        "subject of a glTF file that is none",
        ("subject", "body=gltf", "body.file=clip.mp4", "file=me.npz"),
        says=("glTF", "clip.mp4"),
    ),
    Case(
        GROUP, "garment longer than the legs", ("garment", "garment.length=2", "file=a.npz"), says=("length",)
    ),
    Case(
        GROUP,
        "garment from a mesh that is none",
        ("garment", "garment=mesh", "garment.file=clip.mp4", "file=a.npz"),
        says=("clip.mp4",),
    ),
    Case(
        GROUP,
        "garment for a person that is none",
        ("garment", "subject=nobody", "file=a.npz"),
        says=("nobody", "default"),
    ),
    Case(GROUP, "capture: no such action", ("capture", "dance"), says=("dance", "data")),
    Case(
        GROUP,
        "capture: no such motion",
        ("capture", "data", "settings.motions=[moonwalk]", "folder=people"),
        says=("moonwalk", "walk"),
    ),
    Case(
        GROUP,
        "capture: motion file that is none",
        ("capture", "data", "motion=file", "motion.path=clip.bvh", "folder=people"),
        says=("clip.bvh", "missing"),
    ),
    Case(
        GROUP,
        "capture: motion file of another kind",
        ("capture", "data", "motion=file", "motion.path=clip.mp4", "folder=people"),
        says=("clip.mp4", ".bvh"),
    ),
    Case(
        GROUP,
        "capture: dry run of a page",
        ("capture", "page", "run=nowhere", "dry_run=true"),
        says=("dry_run",),
    ),
    Case(GROUP, "capture: page of no data set", ("capture", "page", "run=nowhere"), says=("nowhere",)),
    Case(
        GROUP,
        "capture: diagnosis of no clip",
        ("capture", "diagnose", "run=nowhere"),
        says=("nowhere", "truth.npz"),
    ),
    Case(
        GROUP,
        "capture: diagnosis that simulates no step",
        ("capture", "diagnose", "run=nowhere", "diagnosis.substeps=0"),
        says=("substeps",),
    ),
    Case(
        GROUP,
        "capture: run with weights that are none",
        ("capture", "run", "run=nowhere", "weights=clip.mp4"),
        says=("weights", "clip.mp4"),
    ),
    Case(
        GROUP,
        "capture: tables with ablations on a domain that is not there",
        ("capture", "tables", "tables.domains.own=[nowhere]", "tables.ablations_on=[moon]"),
        says=("moon", "own"),
    ),
    Case(
        GROUP,
        "capture: one piece without a number of nodes",
        ("capture", "pose", "networks.one_piece=true"),
        says=("nodes",),
    ),
    Case(
        GROUP,
        "capture: run of a filter without a middle",
        ("capture", "run", "run=nowhere", "finish.smoothing.frames=4"),
        says=("odd",),
    ),
    Case(
        GROUP,
        "a data folder that is none",
        ("doctor", "scene=cloth"),
        environment={"TOILE_DATA": "clip.mp4"},
        says=("cloth",),
    ),
    Case(
        GROUP,
        "a terminal that knows ASCII only: a table",
        ("evaluate", f"run={RUN}"),
        environment={"PYTHONIOENCODING": "ascii"},
        process=True,
        want=Want.SUCCESS,
        leaves=(f"{RUN}/metrics.json",),
    ),
    Case(
        GROUP,
        "a terminal that knows ASCII only: a message",
        ("evaluate", "run='Stoffhülle'"),
        environment={"PYTHONIOENCODING": "ascii"},
        process=True,
        says=("not a run folder",),
    ),
    Case(
        GROUP,
        "LC_ALL=C",
        ("evaluate", f"run={RUN}"),
        environment={"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        process=True,
        want=Want.SUCCESS,
        leaves=(f"{RUN}/metrics.json",),
    ),
    # -- calibrations
    Case(CALIBRATIONS, "neither runs nor a table", ("calibrate", "source=x"), says=("runs", "table")),
    Case(
        CALIBRATIONS,
        "a table that is not there",
        ("calibrate", "table=nothing.csv", "source=x"),
        says=("nothing.csv",),
    ),
    Case(
        CALIBRATIONS,
        "a table of something else",
        ("calibrate", "table=other.csv", "source=x"),
        put("other.csv", "a,b\n1,2\n"),
        says=("other.csv",),
    ),
    Case(
        CALIBRATIONS,
        "a video as a table",
        ("calibrate", "table=clip.mp4", "source=x"),
        says=("clip.mp4",),
    ),
    Case(CALIBRATIONS, "runs without labels", ("calibrate", RUN, "source=x"), says=("labels",)),
    Case(
        CALIBRATIONS,
        "the run of a fit",
        ("calibrate", RUN, "labels=labels.json", "source=x"),
        put("labels.json", '{"fit": "none"}'),
        says=(RUN,),
    ),
    Case(
        CALIBRATIONS,
        "labels that are broken",
        ("calibrate", RUN, "labels=labels.json", "source=x"),
        put("labels.json", "{"),
        says=("labels.json",),
    ),
    # -- blind sets
    Case(SETS, "an unknown action", ("blind", "peek", *BLIND), says=("peek", "grade")),
    Case(SETS, "no action", ("blind", *BLIND), says=("action",)),
    Case(
        SETS,
        "no such composition",
        ("blind", "make", *BLIND, "composition=huge", "name=other"),
        says=("huge",),
    ),
    Case(
        SETS,
        "the key within the set",
        ("blind", "make", *BLIND, f"key={BLIND_SET}/my.blindkey"),
        says=("key",),
        want=Want.REFUSAL,
    ),
    Case(
        SETS,
        "the key is lost",
        ("blind", "make", *BLIND),
        remove(BLIND_KEY),
        says=("key",),
        want=Want.REFUSAL,
        keeps=(f"{BLIND_SET}/set.json",),
    ),
    Case(
        SETS, "the key is torn", ("blind", "grade", *BLIND), cut(BLIND_KEY), says=("key",), want=Want.REFUSAL
    ),
    Case(SETS, "run without a set", (*RUN_SET, "name=nothing"), says=("nothing",)),
    Case(SETS, "grade before run", ("blind", "grade", *BLIND), says=("prediction",)),
    Case(SETS, "set.json broken", RUN_SET, put(f"{BLIND_SET}/set.json", "{"), says=(BLIND_SET,)),
    Case(
        SETS, "set.json nested 100,000 deep", RUN_SET, put(f"{BLIND_SET}/set.json", DEEP), says=(BLIND_SET,)
    ),
    Case(SETS, "set.json empty", RUN_SET, put(f"{BLIND_SET}/set.json", "{}"), says=(BLIND_SET,)),
    Case(
        SETS,
        "set.json names files elsewhere",
        RUN_SET,
        values(f"{BLIND_SET}/set.json", scenes=["../../../data/made/cloth"]),
        says=(BLIND_SET,),
        want=Want.REFUSAL,
    ),
    Case(
        SETS,
        "a label lies open in the set",
        RUN_SET,
        put(f"{BLIND_SET}/scenes/label.json", "{}"),
        says=("label",),
        want=Want.REFUSAL,
    ),
    Case(
        SETS,
        "other settings for an existing set",
        ("blind", "make", *BLIND, "out_of_family.n_frames=7"),
        says=("set",),
        want=Want.REFUSAL,
        keeps=(f"{BLIND_SET}/set.json",),
    ),
    Case(
        SETS,
        "predictions.json broken",
        ("blind", "grade", *BLIND),
        at_once(put(f"{PREDICTIONS}/predictions.json", DEEP), put(f"{PREDICTIONS}/predictions.sha256", "no")),
        says=("predictions",),
    ),
    Case(SETS, "no such diagnosis", (*RUN_SET, "diagnose=toile.nothing"), says=("toile.nothing|diagnose",)),
    Case(SETS, "part 5 of 2", ("blind", "make", *BLIND, "part=5", "parts=2"), says=("part",)),
]
