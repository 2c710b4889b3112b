"""The way from one's own video to a scene."""

from __future__ import annotations

from pathlib import Path

from bad_inputs.breaking import DEEP, cut, image, put, remove, values
from bad_inputs.case import Case
from bad_inputs.stock import SHEET, VIDEO

GROUP = "One's own video"
MASKS = ("masks", "video=clip.mp4", "scene=mine", "method=dark_background")
GRABCUT = ("masks", "video=clip.mp4", "scene=mine")
CAMERA = ("camera.fx=200", "camera.fy=200", "camera.cx=80", "camera.cy=60")
TEMPLATE = ("template", f"scene={SHEET}", "grid=[8,8]")
POINTS = (*TEMPLATE, "surface=points", "surface.file=scan.ply")


def _variable_rate(folder: Path) -> None:
    """A clip whose frames come at 20 and at 5 per second."""
    import subprocess

    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-i", folder / "clip.mp4"]
    change = ["-vf", "setpts='if(lt(N,3),N,3+4*(N-3))/20/TB'", "-fps_mode", "vfr", folder / "variable.mp4"]
    subprocess.run([*command, *change], check=True)


def _millimetres(folder: Path) -> None:
    head, _, rows = (folder / "scan.ply").read_text().partition("end_header\n")
    scaled = (" ".join(str(1000 * float(x)) for x in row.split()) for row in rows.splitlines())
    (folder / "scan.ply").write_text(f"{head}end_header\n" + "\n".join(scaled) + "\n")


CASES = [
    Case(
        GROUP,
        "masks: no video",
        ("masks", "video=no.mp4", "scene=mine", "method=dark_background"),
        says=("no.mp4",),
    ),
    Case(GROUP, "masks: video not named", ("masks", "scene=mine"), says=("video",)),
    Case(
        GROUP,
        "masks: the video is a text",
        ("masks", "video=camera.json", "scene=mine", "method=dark_background"),
        says=("camera.json",),
    ),
    Case(GROUP, "masks: the video is cut off", MASKS, cut("clip.mp4", 0.3), says=("clip.mp4",)),
    Case(
        GROUP,
        "masks: a variable frame rate",
        ("masks", "video=variable.mp4", "scene=mine", "method=dark_background"),
        _variable_rate,
        says=("frame rate|variable|time",),
    ),
    Case(GROUP, "masks: no box", GRABCUT, says=("box",)),
    Case(GROUP, "masks: a box outside the frame", (*GRABCUT, "method.box=[100,100,200,200]"), says=("box",)),
    Case(GROUP, "masks: a box without area", (*GRABCUT, "method.box=[10,10,10,30]"), says=("box",)),
    Case(GROUP, "masks: a box of three numbers", (*GRABCUT, "method.box=[10,10,20]"), says=("box",)),
    Case(GROUP, "masks: a box of words", (*GRABCUT, "method.box=[a,b,c,d]"), says=("box",)),
    Case(GROUP, "masks: start after the end", (*MASKS, "start=99"), says=("start", "99")),
    Case(GROUP, "masks: every=0", (*MASKS, "every=0"), says=("every",)),
    Case(GROUP, "masks: fps=-5", (*MASKS, "fps=-5"), says=("fps",)),
    Case(
        GROUP,
        "masks: nothing but background",
        (*MASKS, "method.threshold=255"),
        says=("mask|cloth|threshold",),
    ),
    Case(
        GROUP,
        "masks: over an earlier result",
        ("masks", "video=clip.mp4", f"scene={VIDEO}", "method=dark_background"),
        says=("overwrite",),
        keeps=(f"{VIDEO}/masks/*",),
    ),
    Case(GROUP, "template: no camera", (*POINTS,), says=("camera|intrinsics",)),
    Case(GROUP, "template: the camera file is missing", (*POINTS, "camera.file=no.json"), says=("no.json",)),
    Case(
        GROUP,
        "template: the camera file is nested 100,000 deep",
        (*POINTS, "camera.file=deep.json"),
        put("deep.json", DEEP),
        says=("deep.json",),
    ),
    Case(
        GROUP,
        "template: the camera file is a list",
        (*POINTS, "camera.file=list.json"),
        put("list.json", "[1]"),
        says=("list.json",),
    ),
    Case(
        GROUP,
        "template: the camera of larger images",
        (*POINTS, "camera.file=camera.json"),
        values("camera.json", image_size=[480, 640]),
        says=("image_size|size",),
    ),
    Case(GROUP, "template: focal length 0", (*POINTS, *CAMERA, "camera.fx=0"), says=("focal|fx",)),
    Case(
        GROUP,
        "template: video.json nested 100,000 deep",
        (*POINTS, *CAMERA),
        put(f"{SHEET}/video.json", DEEP),
        says=("video.json",),
    ),
    Case(
        GROUP,
        "template: video.json without frame rate",
        (*POINTS, *CAMERA),
        put(f"{SHEET}/video.json", "{}"),
        says=("video.json", "fps"),
    ),
    Case(
        GROUP,
        "template: the scan is missing",
        (*TEMPLATE, *CAMERA, "surface=points", "surface.file=no.ply"),
        says=("no.ply",),
    ),
    Case(
        GROUP,
        "template: the scan is a text",
        (*POINTS, *CAMERA),
        put("scan.ply", "no points"),
        says=("scan.ply",),
    ),
    Case(
        GROUP,
        "template: a scan without points",
        (*POINTS, *CAMERA),
        put(
            "scan.ply",
            "ply\nformat ascii 1.0\nelement vertex 0\n"
            "property float x\nproperty float y\nproperty float z\nend_header\n",
        ),
        says=("scan.ply|point",),
    ),
    Case(
        GROUP,
        "template: a scan in millimetres",
        (*POINTS, *CAMERA),
        _millimetres,
        says=("scan.ply|metres|points|cover",),
    ),
    Case(
        GROUP,
        "template: points where a mesh should be",
        (*TEMPLATE, *CAMERA, "surface=mesh", "surface.file=scan.ply"),
        says=("scan.ply|mesh|faces",),
    ),
    Case(GROUP, "template: no mask", (*POINTS, *CAMERA), remove(f"{SHEET}/masks"), says=("mask",)),
    Case(
        GROUP,
        "template: mask 0 empty",
        (*POINTS, *CAMERA),
        image(f"{SHEET}/masks/mask_000.png", lambda x: 0 * x),
        says=("mask", "empty"),
    ),
    Case(
        GROUP,
        "template: a flat sheet of unknown size",
        (*TEMPLATE, *CAMERA, "surface=sheet"),
        says=("cloth_size",),
    ),
    Case(GROUP, "template: a grid of one vertex", (*POINTS, *CAMERA, "grid=[1,8]"), says=("grid",)),
    Case(
        GROUP,
        "template: no such folder",
        ("template", "scene=nowhere", *CAMERA, "surface=sheet", "cloth_size=[0.5,0.4]"),
        says=("nowhere",),
    ),
    Case(GROUP, "template: corners are words", (*POINTS, *CAMERA, "corners=[a,b,c,d]"), says=("corners",)),
    Case(
        GROUP,
        "template: gaps between the frames",
        (*POINTS, *CAMERA),
        remove(f"{SHEET}/rgbs/rgb_001.png"),
        says=("rgb_001",),
    ),
]
