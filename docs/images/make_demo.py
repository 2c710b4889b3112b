"""The README's picture: two frames of the overlay of a demo run.

make demo && .venv/bin/python docs/images/make_demo.py outputs/fit/demo/<time>
"""

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np

run = Path(sys.argv[1])
frames = list(iio.imiter(run / "overlay.mp4"))
picture = np.concatenate([frames[len(frames) // 3], frames[-1]])
iio.imwrite(Path(__file__).with_name("demo.jpg"), picture, quality=85)
