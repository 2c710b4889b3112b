"""Pages as a browser shows them: pictures and DOM by a headless Chromium, without the network."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from html import escape
from pathlib import Path

from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
    "--hide-scrollbars",
    # Time of the page, not of the clock: a slow machine is waited for.
    "--virtual-time-budget=20000",
)


def executable() -> str | None:
    """Path of a Chromium, or None."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


PHONE = 390
"""Width of a usual phone's screen [px]."""
NARROWEST_WINDOW = 600
"""Chromium makes no window much narrower than this [px]; narrower pages are shown in a frame."""
_FRAME = """<!doctype html><body style="margin: 0">
<iframe src="{address}" style="border: 0; width: {width}px; height: {height}px"></iframe>
<script>addEventListener("message", ({{ data }}) => {{
  const note = document.createElement("pre");
  document.body.append(Object.assign(note, {{ id: "probe", hidden: true, textContent: data }}));
}});</script>"""


def show(address: str, picture: Path, *, width: int, height: int, timeout: float = 300) -> str:
    """Open a page, write what a window of that size shows as PNG, and return the page's DOM as text.

    Below ``NARROWEST_WINDOW`` the text holds instead what the page has sent by ``parent.postMessage``.

    Args:
        address: e.g. "file:///tmp/index.html#frame=3".
        picture: the PNG to write.
        width: of the page [px].
        height: of the window [px].
        timeout: for the browser to be done [s].

    Raises:
        RuntimeError: there is no Chromium, or it wrote no picture.
    """
    if width < NARROWEST_WINDOW:
        return _show_in_frame(address, picture, width, height, timeout)
    browser = executable()
    if browser is None:
        raise RuntimeError(f"no Chromium found; looked for {', '.join(NAMES)}")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            browser,
            *FLAGS,
            f"--user-data-dir={profile}",
            f"--window-size={width},{height}",
            f"--screenshot={picture}",
            "--dump-dom",
            address,
        ]
        done = subprocess.run(command, capture_output=True, timeout=timeout, check=False)
    if not picture.is_file():
        raise RuntimeError(f"Chromium wrote no picture: {done.stderr.decode(errors='replace')[-2000:]}")
    return done.stdout.decode("utf-8", errors="replace")


def _show_in_frame(address: str, picture: Path, width: int, height: int, timeout: float) -> str:
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "frame.html"
        page.write_text(_FRAME.format(address=escape(address), width=width, height=height), encoding="utf-8")
        dom = show(page.as_uri(), picture, width=NARROWEST_WINDOW, height=height, timeout=timeout)
    with Image.open(picture) as shown:
        cut = shown.crop((0, 0, width, height))
    cut.save(picture)
    return dom
