"""Commands in processes of their own: forks of one that has imported toile, or real ones."""

from __future__ import annotations

import gc
import importlib
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from bad_inputs.verdict import Answer

_POLL = 0.02  # s


def warm_up() -> None:
    """Import what every command would, so that forks need not."""
    from toile.cli.commands import COMMANDS
    from toile.cli.main import main  # noqa: F401

    for command in COMMANDS.values():
        importlib.import_module(command.module)
    for name in (
        "hydra",
        "tensorboard.summary.writer.event_file_writer",
        "toile.reconstruction.gauss_newton.recipe",
        "toile.reconstruction.adam",
        "toile.rendering",
        "toile.physics.implicit.assembly",
    ):
        importlib.import_module(name)
    # What is there now is not to be copied because the garbage collector looks at it.
    gc.collect()
    gc.freeze()


@dataclass
class Running:
    """A command under way.

    Attributes:
        pid: of its process, which leads a group.
        out: file of its standard output.
        err: file of its standard error.
        started: time since some moment.
        began: time of the clock.
    """

    pid: int
    out: Path
    err: Path
    started: float
    began: float

    def wait(self, at_most: float) -> Answer:
        """Its answer; what takes longer is killed, with all that it has started."""
        status = None
        while time.monotonic() - self.started < at_most:
            pid, code = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                status = os.waitstatus_to_exitcode(code)
                break
            time.sleep(_POLL)
        else:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
        # Nor does anything that it has started live longer.
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        return Answer(status, _text(self.out), _text(self.err), time.monotonic() - self.started, self.began)

    def has_ended(self) -> bool:
        """Whether it has; its answer can still be had."""
        return os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None

    def interrupt(self) -> None:
        """Ctrl-C."""
        os.kill(self.pid, signal.SIGINT)


def start(
    arguments: Sequence[str],
    folder: Path,
    logs: Path,
    environment: Mapping[str, str],
    *,
    process: bool,
    largest_file: int | None = None,
) -> Running:
    """Start ``toile <arguments>`` in a folder.

    Args:
        arguments: of toile.
        folder: the current one.
        logs: path without suffix, for the outputs.
        environment: changes; "" removes a variable.
        process: a real process instead of a fork.
        largest_file: bytes that a file may have, where no file system could be made.
    """
    out, err = logs.with_suffix(".out"), logs.with_suffix(".err")
    variables = {**os.environ, **environment}
    variables = {k: v for k, v in variables.items() if v}
    # File systems keep time more coarsely.
    started, began = time.monotonic(), time.time() - 0.1
    if process:
        command = [sys.executable, "-c", "import sys; from toile.cli.main import main; sys.exit(main())"]
        with out.open("wb") as o, err.open("wb") as e:
            made = subprocess.Popen(
                [*command, *arguments],
                cwd=folder,
                env=variables,
                stdin=subprocess.DEVNULL,
                stdout=o,
                stderr=e,
                start_new_session=True,
            )
        # The answer is waited for by its number, as a fork's is.
        made.returncode = 0
        return Running(made.pid, out, err, started, began)
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        _be(arguments, folder, out, err, variables, largest_file)
    return Running(pid, out, err, started, began)


def _be(
    arguments: Sequence[str],
    folder: Path,
    out: Path,
    err: Path,
    variables: Mapping[str, str],
    largest_file: int | None,
) -> None:
    """Be the command, as its console script is; never returns."""
    status = 1
    try:
        os.setsid()
        for stream, path in ((1, out), (2, err)):
            to = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            os.dup2(to, stream)
            os.close(to)
        # Whoever has forked may have put something else there.
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
        nowhere = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nowhere, 0)
        os.close(nowhere)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(variables)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        if largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
        from toile.cli.main import main

        sys.argv = ["toile", *arguments]
        try:
            status = main(list(arguments))
        except SystemExit as leaving:
            status = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status & 0xFF)


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")
