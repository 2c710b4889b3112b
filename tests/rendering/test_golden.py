"""The rendered picture has not changed unnoticed; ``golden/regenerate.py`` draws it anew."""

import runpy
from pathlib import Path

import numpy as np
from PIL import Image


def test_golden_image():
    script = runpy.run_path(str(Path(__file__).parent / "golden" / "regenerate.py"))
    with Image.open(script["FILE"]) as image:
        golden = np.asarray(image).astype(int)
    # One grey level covers rounding on other processors.
    assert np.abs(script["draw"]().numpy().astype(int) - golden).max() <= 1
