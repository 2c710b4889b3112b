"""What all pages share: the skeleton with style and scripts, sections, tables, numbers, embedded figures."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from PIL import Image
from plotly.offline import get_plotlyjs

from toile.reports import palette

SCRIPTS = ("figures.js", "viewer.js", "table.js", "start.js")
PICTURE_QUALITY = 62
"""Of WebP: textures stay sharp, and a second of video with three views fits into 5 MB."""
NARROW_NO_BREAK_SPACE = "\u202f"

_SKELETON = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline'; \
style-src 'unsafe-inline'; img-src data: blob:">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
<script>{plotly}</script>
</head>
<body>
<noscript><p>This page draws its figures with JavaScript, which is switched off here.</p></noscript>
<main>
{body}
</main>
<script>{scripts}</script>
</body>
</html>
"""


def document(title: str, body: Sequence[str]) -> str:
    """A whole page that needs no network, and that the browser keeps from using one.

    Args:
        title: plain text.
        body: parts of the page as HTML; empty ones are left out.
    """
    return _SKELETON.format(
        title=escape(title),
        style=_style(),
        plotly=get_plotlyjs(),
        body="\n".join(part for part in body if part),
        scripts="\n".join(_package_text(name) for name in SCRIPTS),
    )


def section(title: str, *parts: str, note: str = "") -> str:
    """A section with its heading (plain text) and a note (HTML), or nothing where all parts are empty."""
    content = "".join(parts)
    if not content:
        return ""
    below = f'<p class="note">{note}</p>' if note else ""
    return f"<section><h2>{escape(title)}</h2>{below}{content}</section>"


def table(head: str, rows: Sequence[str], *, sortable: bool = False) -> str:
    """A table from HTML rows; a sortable one sorts by a click on a heading, see table.js."""
    kind = ' class="sortable"' if sortable else ""
    body = "".join(rows)
    return f'<div class="scroll"><table{kind}><thead>{head}</thead><tbody>{body}</tbody></table></div>'


def warning_box(lines: Sequence[str]) -> str:
    """Plain sentences in a box that cannot be overlooked, one a line; nothing without any."""
    if not lines:
        return ""
    return f'<div class="warning" role="alert">{"".join(f"<p>{escape(line)}</p>" for line in lines)}</div>'


def data(name: str, content: Any) -> str:
    """Plain data for the scripts, as an inert element with that id."""
    # "<" could end the element early; JSON allows it as an escape in any string.
    text = json.dumps(content, ensure_ascii=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="{escape(name)}">{text}</script>'


def figure(chart: go.Figure | None, name: str, attributes: Mapping[str, str] | None = None) -> str:
    """A plotly figure, drawn by figures.js when the page is shown.

    Args:
        chart: with a height of its own, and perhaps a layout for narrow screens (``charts.with_narrow``);
            None gives nothing.
        name: unique in the page.
        attributes: data attributes of its element, for viewer.js.
    """
    if chart is None:
        return ""
    extra = "".join(f' data-{key}="{escape(value)}"' for key, value in (attributes or {}).items())
    heights = {"height": chart.layout.height, "narrow-height": _narrow_height(chart)}
    style = ";".join(f"--{name}:{height}px" for name, height in heights.items() if height is not None)
    height = f' style="{style}"' if style else ""
    text = chart.to_json().replace("<", "\\u003c")
    return (
        f'<script type="application/json" id="{name}-figure">{text}</script>'
        f'<div class="plot" id="{name}" data-figure="{name}-figure"{extra}{height}></div>'
    )


def _narrow_height(chart: go.Figure) -> float | None:
    """Height of a figure on a narrow screen [px], where it has one."""
    narrow = (chart.layout.meta or {}).get("narrow", {})
    height: float | None = narrow.get("height")
    return height


def picture_address(pixels: npt.NDArray[np.uint8], quality: int = PICTURE_QUALITY) -> str:
    """An RGB picture (h, w, 3) as the address of a compressed image within the page."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", quality=quality, method=2)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def floats(values: npt.NDArray[np.floating]) -> str:
    """Numbers as base64 of little-endian float32, in C order, for ``toile.floats`` in figures.js."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def number(value: float) -> str:
    """Three significant digits as HTML, without an exponent where that reads well; a dash for none."""
    if not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        digits = max(0, 2 - math.floor(math.log10(abs(value))))
        text = f"{value:.{min(digits, 5)}f}"
        return text.replace("-", "−")
    mantissa, exponent = f"{value:.2e}".split("e")
    power = str(int(exponent)).replace("-", "−")
    return f"{mantissa.replace('-', '−')}·10<sup>{power}</sup>"


def with_unit(value: float, unit: str) -> str:
    """Number and unit as HTML, held together."""
    return number(value) + (NARROW_NO_BREAK_SPACE + escape(unit) if unit else "")


def in_sentence(title: str) -> str:
    """A title in the middle of a sentence, as HTML: lower case, but for an abbreviation or a name."""
    return escape(title if title.startswith("L1") else title[:1].lower() + title[1:])


def _style() -> str:
    values = {
        "font": palette.FONT,
        "ink": palette.INK,
        "muted": palette.MUTED,
        "rule": palette.RULE,
        "accent": palette.RECONSTRUCTION,
        "truth": palette.GROUND_TRUTH,
    }
    root = "".join(f"--{name}: {value}; " for name, value in values.items())
    return f":root {{ {root}}}\n{_package_text('page.css')}"


def _package_text(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
