"""Pages as a browser shows them: pictures and DOM by a headless Chromium, without the network."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

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


def show(address: str, picture: Path, *, width: int, height: int, timeout: float = 300) -> str:
    """Open a page, write what a window of that size shows as PNG, and return the page's DOM as text.

    Args:
        address: e.g. "file:///tmp/index.html#frame=3".
        picture: the PNG to write.
        width: of the window [px].
        height: of the window [px].
        timeout: for the browser to be done [s].

    Raises:
        RuntimeError: there is no Chromium, or it wrote no picture.
    """
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
