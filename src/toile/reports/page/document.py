"""What all pages share: the templates, numbers as HTML, embedded pictures and arrays.

The markup is in ``templates/*.html.j2`` (Jinja2). Whatever is put into a template is escaped there, but for
what is ``Markup`` already; a name that a template does not find is an error.
"""

from __future__ import annotations

import base64
import io
import json
import math
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image
from plotly.offline import get_plotlyjs

from toile.reports import palette

PICTURE_QUALITY = 62
"""Of WebP: textures stay sharp, and a second of video with three views fits into 5 MB."""
NARROW_NO_BREAK_SPACE = "\u202f"


def render(template: str, **content: Any) -> str:
    """A whole page that needs no network, and that the browser keeps from using one.

    Args:
        template: name of a template that extends ``page.html.j2``.
        content: what the template shows, by name.
    """
    return _environment().get_template(template).render(content)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "with_unit": with_unit, "picture": picture_address}
    environment.filters["in_sentence"] = in_sentence
    environment.tests["finite"] = math.isfinite
    environment.globals |= {"palette": palette, "asset": _asset, "plotly": lambda: Markup(get_plotlyjs())}
    environment.policies["json.dumps_function"] = _json
    environment.policies["json.dumps_kwargs"] = {}
    return environment


def _asset(name: str) -> Markup:
    """A style sheet or a script of the package."""
    return Markup(files(__package__).joinpath(name).read_text(encoding="utf-8"))


def _json(content: Any) -> str:
    """Plain data or a plotly figure as JSON; the filter ``tojson`` makes it safe within a page."""
    if isinstance(content, go.Figure):
        return str(content.to_json())
    return json.dumps(content, ensure_ascii=False)


def picture_address(pixels: npt.NDArray[np.uint8], quality: int = PICTURE_QUALITY) -> str:
    """An RGB picture (h, w, 3) as the address of a compressed image within the page."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "WEBP", quality=quality, method=2)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def floats(values: npt.NDArray[np.floating]) -> str:
    """Numbers as base64 of little-endian float32, in C order, for ``toile.floats`` in figures.js."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def number(value: float) -> Markup:
    """Three significant digits as HTML, without an exponent where that reads well; a dash for none."""
    if not math.isfinite(value):
        return Markup("–")
    if value == 0:
        return Markup("0")
    if 1e-3 <= abs(value) < 1e5:
        digits = max(0, 2 - math.floor(math.log10(abs(value))))
        return Markup(f"{value:.{min(digits, 5)}f}".replace("-", "−"))
    mantissa, exponent = f"{value:.2e}".split("e")
    return Markup(f"{mantissa}·10<sup>{int(exponent)}</sup>".replace("-", "−"))


def with_unit(value: float, unit: str) -> Markup:
    """Number and unit as HTML, held together."""
    return number(value) + (NARROW_NO_BREAK_SPACE + unit if unit else "")


def in_sentence(title: str) -> str:
    """A title in the middle of a sentence: lower case, but for an abbreviation or a name."""
    return title if title.startswith("L1") else title[:1].lower() + title[1:]
