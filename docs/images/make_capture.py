"""The README's picture of a captured person: what the camera saw, what was found, and the same from the side.

toile capture run run=<clip> result=<result> && .venv/bin/python docs/images/make_capture.py <clip> <result>
"""

import math
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from toile.capture.data.clips import Truth
from toile.capture.data.filming import Looks, drawn, looking_from
from toile.rendering import WarpRenderer
from toile.scenes.multi_view import load_multi_view

clip, result = (Path(text) for text in sys.argv[1:3])
view = load_multi_view(clip).views[0]
motion = Truth.load(result / "motion.npz")
frames = [round(share * (motion.n_frames - 1)) for share in (0.3, 0.5, 0.7, 0.9)]
side = 200
camera = view.camera.scaled(side / view.camera.width)
looks = Looks.random(np.random.default_rng(3), side)
rows = [
    [
        np.asarray(iio.imread(view.frame_paths[f]))[
            np.ix_(*(np.arange(side) * view.camera.width // side,) * 2)
        ]
        for f in frames
    ]
]
for turn in (0.0, math.pi / 2):
    rows.append(drawn(motion, looking_from(camera, turn), looks, WarpRenderer(2), frames))
picture = np.concatenate([np.concatenate(row, 1) for row in rows], 0)
iio.imwrite(Path(__file__).with_name("capture.png"), picture, optimize=True)
