"""Run every notebook in a fresh kernel; a warning or an exception fails it. `make notebooks` calls this.

The executed notebooks go to build/notebooks, from where the documentation takes their outputs.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from traitlets.config import Config

HERE = Path(__file__).resolve().parent
OUTPUT = HERE.parent / "build" / "notebooks"
SECONDS_PER_CELL = 300
# Warnings are errors, as in the tests, but for those of the kernel itself when it is shut down.
SETUP = """%matplotlib inline
import warnings
import pandas
warnings.simplefilter("error")
warnings.filterwarnings("ignore", module="ipykernel")
pandas.set_option("display.width", 110)
"""


async def run(source: Path) -> nbformat.NotebookNode:
    """The notebook with its outputs."""
    notebook = jupytext.read(source)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(SETUP))
    # Sockets in the file system: nobody else on the machine can listen to them.
    config = Config({"KernelManager": {"transport": "ipc"}})
    client = NotebookClient(notebook, config=config, kernel_name="python3", timeout=SECONDS_PER_CELL)
    await client.async_execute()
    del notebook.cells[0]
    return notebook


def main() -> None:
    """Run the notebooks named as arguments, else all."""
    OUTPUT.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    named = [HERE / f"{name}.py" for name in sys.argv[1:]]
    for source in named or sorted(path for path in HERE.glob("*.py") if path.name != Path(__file__).name):
        begun = time.perf_counter()
        nbformat.write(asyncio.run(run(source)), OUTPUT / f"{source.stem}.ipynb")
        print(f"{source.name}: {time.perf_counter() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
