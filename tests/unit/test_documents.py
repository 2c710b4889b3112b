"""Links of the pages that the documentation site does not hold, and code that pages show."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CONTRIBUTING.md")
LINK = re.compile(r"\]\(([^)\s]+)\)")


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def anchors(page: str) -> set[str]:
    """Anchors of a page's headings, as GitHub and the site make them."""
    titles = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", page, flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_somewhere(name: str) -> None:
    page = text(name)
    for target in LINK.findall(page):
        if target.startswith(("https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        there = (ROOT / name).parent / path if path else ROOT / name
        assert there.exists(), target
        if anchor:
            assert anchor in anchors(there.read_text(encoding="utf-8")), target


def test_no_table_shows_a_number_that_is_none() -> None:
    for name in (*PAGES, *(str(p.relative_to(ROOT)) for p in (ROOT / "docs" / "results").glob("*.md"))):
        for line in text(name).splitlines():
            if line.startswith("|"):
                assert not re.search(r"\|\s*nan\b", line), (name, line)


def test_readme_is_about_use_before_results() -> None:
    headings = re.findall(r"^## (.+)$", text("README.md"), re.MULTILINE)
    results = headings.index("Results")
    for use in ("From Python", "Your own video", "Everyday use", "Why is my simulation still wrong?"):
        assert headings.index(use) < results


def test_formulas_of_the_pages_become_mathml() -> None:
    """Nothing of TeX is left over; a browser draws what there is."""
    pytest.importorskip("sphinx")
    formula = runpy.run_path(str(ROOT / "docs" / "conf.py"))["formula"]
    found = []
    for path in (ROOT / "docs").rglob("*.md"):
        page = re.sub(r"```.*?```|`[^`\n]*`", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        found += re.findall(r"\$\$(.+?)\$\$", page, re.DOTALL)
        found += re.findall(r"(?<![\w$\\])\$([^$\n]+)\$(?![\w$])", page)
    assert len(found) > 50
    for tex in found:
        mathml = formula(tex, "block")
        assert mathml.startswith("<math"), tex
        assert "\\" not in re.sub(r"<annotation.*?</annotation>", "", mathml), tex
