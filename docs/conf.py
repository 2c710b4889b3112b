"""The documentation site: `make docs` builds it with Sphinx, without network, warnings as errors.

Pages are the Markdown files of this folder, which read well on GitHub as they are. Formulas become MathML,
which browsers draw themselves, so that nothing is loaded from elsewhere. Notebooks are converted from
notebooks/, with their outputs where `make notebooks` has run them.
"""

from __future__ import annotations

import base64
import re
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

HERE = Path(__file__).parent
ROOT = HERE.parent
EXECUTED = ROOT / "build" / "notebooks"
PAGES = HERE / "notebooks"

project = "toile"
author = "the toile authors"
release = version = version_of("toile")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["images/*", "results/independent"]

html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"toile {release}"
html_theme_options = {"navigation_with_keys": True}
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# Formulas between dollars only: file names hold many underscores.
myst_dmath_double_inline = False
copybutton_exclude = ".linenos, .gp, .go"

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say what arguments are, with shapes and units
autodoc_class_signature = "separated"
autodoc_type_aliases = {"Settings": "Settings"}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True


def formula(text: str, display: str) -> str:
    """A formula as MathML.

    latex2mathml knows neither sizes of brackets nor names of operators; both are matters of looks alone.
    """
    plain = re.sub(r"\\(?:big|Big|bigg|Bigg)[lrm]?(?![a-z])", "", text)
    # A name of a function stands apart from its argument.
    plain = re.sub(r"\\log (?=[a-z])", r"\\log\\, ", plain)
    plain = plain.replace(r"\tfrac", r"\frac").replace(r"\operatorname", r"\mathrm")
    return convert(plain, display=display)


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(formula(node.astext(), "inline"))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="formula">{formula(node.astext(), "block")}</div>\n')
    raise nodes.SkipNode


# Tables that other pages hold as they are have no title of their own.
TITLES = {
    "results/ablations_tracking": "Ablations of the default recipe (`make ablations`)",
    "results/ablations_paper": "Ablations of the paper's recipe (`make ablations RECIPE=paper`)",
    "results/identification": "Stiffness and wind of a generated scene (`make results`)",
    "results/masks": "Masks (`make masks`)",
    "results/results": "Every scene (`make results`)",
    "results/simulators": "Solver, hybrid and surrogate (`make simulators`)",
    "results/stability": "Long fits (`make stability`)",
    "results/variants": "Variants of the default recipe (`make results`)",
}


def title_of_tables(app: Sphinx, name: str, source: list[str]) -> None:
    """Put a title over a table."""
    if name in TITLES:
        source[0] = f"# {TITLES[name]}\n\n{source[0]}"


def notebook_pages(app: Sphinx) -> None:
    """Write a page of every notebook; one that has not changed is left as it is."""
    PAGES.mkdir(exist_ok=True)
    for source in sorted((ROOT / "notebooks").glob("*.py")):
        if source.name == "run.py":
            continue
        executed = EXECUTED / f"{source.stem}.ipynb"
        fresh = executed.is_file() and executed.stat().st_mtime >= source.stat().st_mtime
        notebook = nbformat.read(executed, as_version=4) if fresh else jupytext.read(source)
        text = "\n\n".join(
            filter(None, (_cell(cell, source.stem, k) for k, cell in enumerate(notebook.cells)))
        )
        note = f"This page is the notebook `notebooks/{source.name}`; `make notebooks` runs it."
        head, _, rest = text.partition("\n\n")
        _write(PAGES / f"{source.stem}.md", f"{head}\n\n*{note}*\n\n{rest}\n".encode())


def _cell(cell: Any, stem: str, number: int) -> str:
    if cell.cell_type != "code":
        return str(cell.source).replace("](../docs/", "](../")
    parts = [f"```python\n{cell.source}\n```"]
    for k, output in enumerate(cell.get("outputs", ())):
        data = output.get("data", {})
        if "image/png" in data:
            name = f"{stem}_{number}_{k}.png"
            _write(PAGES / name, base64.b64decode(data["image/png"]))
            parts.append(f"![Output of the cell above]({name})")
        elif "text/plain" in data or output.get("name") == "stdout":
            text = data.get("text/plain", output.get("text", ""))
            parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts)


def _write(path: Path, content: bytes) -> None:
    if not path.is_file() or path.read_bytes() != content:
        path.write_bytes(content)


def setup(app: Sphinx) -> None:
    """Sphinx calls this."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    app.connect("builder-inited", notebook_pages)
    app.connect("source-read", title_of_tables)
