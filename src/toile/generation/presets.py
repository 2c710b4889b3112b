"""Settings that have been checked for how well a fit's own grid with 4 steps per frame can follow them.

Simulated on the fit's grid with the true parameters, the vertices deviate from the truth by (``deviation`` of
``discretization``, in % of the width):

| preset | steps per frame | mean | mean of the last third | moved, frame mean at its peak |
|---|---|---|---|---|
| STANDARD | 1 | 0.57 | 1.04 | 25 |
| | 2 | 0.45 | 0.73 | |
| | 4 | 0.41 | 0.59 | |
| | 8 | 0.40 | 0.55 | |
| SWUNG | 4 | 0.29 | 0.34 | 40 |
| SHAKEN | 4 | 1.16 | 2.52 | 28 |
| SHAKEN at 1.5 Hz and (0.01, 0, 0.02) m | 4 | 0.59 | 1.06 | 24 |

What is left with 8 steps is the grid's share. It grows fast where folds are sharper than the grid can bend:
a similar sheet of 0.5 m with a pinned distance of 0.8 deviated by 2 %. The truth had 8 steps per frame, that
of SHAKEN in the last row but one 4.
"""

from __future__ import annotations

from dataclasses import replace

from toile.generation.motion import Shake, Swing
from toile.generation.settings import GeneratorSettings

STANDARD = GeneratorSettings(name="standard")
"""Corners at rest; the wind turns at frame 0, so the cloth swings out of the image plane and back."""

SWUNG = replace(STANDARD, name="swung", pinned_motion=Swing())
"""The same with both corners moved to and fro."""

SHAKEN = replace(STANDARD, name="shaken", pinned_motion=Shake())
"""The same with both corners shaken, beyond what the grid follows in the last third."""
