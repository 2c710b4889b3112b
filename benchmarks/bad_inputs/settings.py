"""Settings that are wrong."""

from __future__ import annotations

from bad_inputs.case import Case, Want
from bad_inputs.stock import DIAGNOSE, FIT, GENERATE, TRAIN

GROUP = "Settings"


def _fit(wrong: str, *settings: str, says: tuple[str, ...]) -> Case:
    return Case(GROUP, wrong, (*FIT, "hydra.run.dir=new", *settings), says=says)


CASES = [
    *(
        _fit(f"stiffness {value}", f"parameters.stretching={value}", says=("stretching", value.lstrip("-")))
        for value in ("-100", "nan", "inf", "strong", "null")
    ),
    _fit("shearing negative", "parameters.shearing=-1", says=("shearing",)),
    _fit("areal density negative", "cloth.areal_density=-0.15", says=("density",)),
    _fit("areal density 0", "cloth.areal_density=0", says=("density",)),
    _fit("no sub-step", "simulator.substeps=0", says=("substeps|longest",)),
    _fit("half a sub-step", "simulator.substeps=1.5", says=("substeps", "1.5")),
    _fit("longest sub-step 0", "simulator.longest_substep=0", says=("longest_substep",)),
    _fit("windows with a lag of 0", "optimization.stages.track.windows.lag=0", says=("lag",)),
    _fit("windows that do not move", "optimization.stages.track.windows.stride=0", says=("stride",)),
    _fit("a negative tolerance", "simulator.build.newton.tolerance=-1", says=("tolerance",)),
    _fit("no iteration", "optimization.stages.track.iterations=0", says=("iterations",)),
    _fit("no points", "optimization.stages.track.term.per_side=0", says=("per_side",)),
    _fit("no stage", "optimization.stages.track=null", "optimization.stages.calibrate=null", says=("stage",)),
    _fit("video: maybe", "report.video=maybe", says=("report.video", "maybe")),
    _fit("minus one picture", "report.pictures=-1", says=("pictures",)),
    _fit("a seed of -1", "seed=-1", says=("seed", "-1")),
    _fit("an accelerator that is not there", "trainer.accelerator=gpu", says=("gpu|accelerator",)),
    _fit("no frame", "scene.n_frames=0", says=("n_frames", "0")),
    _fit("more frames than there are", "scene.n_frames=99", says=("n_frames", "99")),
    _fit("one frame", "scene.n_frames=1", says=("frame",)),
    _fit("frame rate 0", "scene.fps=0", says=("fps|frame rate",)),
    _fit("gravity of two numbers", "scene.gravity=[0,9.81]", says=("gravity",)),
    _fit("pinned vertices: text", "scene.pinned_vertices=corners", says=("pinned_vertices", "corners")),
    _fit("pinned vertex out of range", "scene.pinned_vertices=[99]", says=("pinned", "99")),
    _fit("a crop margin of -5", "scene.crop_margin=-5", says=("crop_margin",)),
    _fit("a misspelt key", "paramters.stretching=5", says=("paramters", "parameters")),
    _fit("a misspelt key within a group", "optimization.stages.trak.iterations=2", says=("trak", "track")),
    _fit("an unknown choice", "optimization=trackng", says=("trackng", "tracking")),
    _fit("an unknown group", "optimisation=tracking", says=("optimisation", "optimization")),
    _fit("an unknown effect", "effect=air_darg", says=("air_darg", "air_drag")),
    _fit("an unknown simulator", "simulator=newton", says=("newton", "implicit")),
    Case(
        GROUP,
        "an ablation that means nothing here",
        ("fit", "scene=cloth", "hydra.run.dir=new", "optimization=adam", "ablation=no_calibration"),
        says=("ablation",),
    ),
    _fit("terms that would be ignored", "loss=paper", says=("loss",)),
    _fit("an objective that is not measured", "objective=beauty", says=("objective", "beauty")),
    _fit("an override without a value's end", "parameters={stretching:", says=("parameters|override",)),
    _fit("an override without a key", "=5", says=("=5",)),
    _fit("a word that is no override", "quickly", says=("quickly",)),
    _fit("effect that is fixed but not there", "fixed_effects=[gusts]", says=("gusts",)),
    _fit(
        "no weights of the surrogate", "simulator=surrogate", "simulator.build.weights=no.pt", says=("no.pt",)
    ),
    Case(GROUP, "workers=0", (*DIAGNOSE, "workers=0", "hydra.run.dir=new"), says=("workers", "0")),
    Case(
        GROUP,
        "a candidate taken out by null",
        (*DIAGNOSE, "candidates.gusts=null", "hydra.run.dir=new"),
        want=Want.SUCCESS,  # this is how one is taken out, see conf/diagnose.yaml
    ),
    Case(
        GROUP,
        "diagnosis by another optimisation",
        (*DIAGNOSE[:-1], "optimization=adam", "hydra.run.dir=new"),
        says=("optimization",),
    ),
    Case(
        GROUP, "diagnosis of one frame", (*DIAGNOSE, "scene.n_frames=1", "hydra.run.dir=new"), says=("frame",)
    ),
    Case(
        GROUP,
        "diagnosis of five frames",
        (*DIAGNOSE, "scene.n_frames=5", "hydra.run.dir=new"),
        says=("frame",),
    ),
    Case(GROUP, "training: no epoch", (*TRAIN, "training.epochs=0", "hydra.run.dir=new"), says=("epochs",)),
    Case(
        GROUP,
        "training: negative learning rate",
        (*TRAIN, "training.learning_rate.peak=-1", "hydra.run.dir=new"),
        says=("learning_rate|peak",),
    ),
    Case(
        GROUP,
        "training: no networks's widths",
        (*TRAIN, "training.widths=[]", "hydra.run.dir=new"),
        says=("widths",),
    ),
    Case(
        GROUP,
        "training: weights to start from are not there",
        (*TRAIN, "weights=nowhere.pt", "hydra.run.dir=new"),
        says=("nowhere.pt",),
    ),
    Case(
        GROUP,
        "training: weights to start from of another network",
        (*TRAIN, "weights=packaged", "hydra.run.dir=new"),
        says=("widths",),
    ),
    Case(
        GROUP,
        "training: more than all cloths calm",
        (*TRAIN, "training.pool.calm_share=2", "hydra.run.dir=new"),
        says=("calm_share",),
    ),
    Case(
        GROUP,
        "generate: one frame less than one",
        (*GENERATE, "settings.n_frames=0", "folder=made"),
        says=("n_frames",),
    ),
    Case(
        GROUP,
        "generate: stiffness negative",
        (*GENERATE, "settings.stretching=-1", "folder=made"),
        says=("stretching",),
    ),
    Case(
        GROUP,
        "generate: cloth size nan",
        (*GENERATE, "settings.cloth_size=[nan,0.4]", "folder=made"),
        says=("cloth_size",),
    ),
    Case(
        GROUP,
        "generate: a grid of one vertex",
        (*GENERATE, "settings.grid=[1,1]", "folder=made"),
        says=("grid",),
    ),
]
