"""Axes that neither magnify noise nor reach to what cannot be."""

from __future__ import annotations

import numpy as np
import pytest

from toile.reports.page.charts import Panel, small_multiples


@pytest.mark.parametrize(
    ("values", "mode"),
    [
        ([0.0, 0.0, 0.0], "nonnegative"),  # zeros alone would be shown from -1 to 1
        ([180.0, 365.0, 290.0], "tozero"),
        ([350.0, 365.0, 360.0], None),
        ([-1.0, 2.0, 5.0], None),
    ],
)
def test_what_cannot_be_negative_starts_at_zero(values: list[float], mode: str | None) -> None:
    panel = Panel("Force", "weights", np.array(values))
    figure = small_multiples([panel], np.arange(3.0), "frame")
    figure = figure[0] if isinstance(figure, tuple) else figure
    assert figure.layout.yaxis.rangemode == mode
