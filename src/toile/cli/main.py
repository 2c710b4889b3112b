"""The console script ``toile <command> [overrides]``: dispatch to one Hydra application per command."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any

from toile import __version__
from toile.cli.commands import COMMANDS, overview
from toile.cli.streams import accept_any_text
from toile.cli.threads import disk_failures_of_threads

USAGE_ERROR = 2
RESUMABLE = {"fit": "fit", "train": "training", "diagnose": "diagnosis"}
"""Commands that take ``resume=<run folder>``, and what such a folder holds."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status.

    0: done. 2: bad input or usage. 3: the simulation failed. 130: interrupted. Anything else is a mistake in
    the program and ends in a traceback; with HYDRA_FULL_ERROR=1 every failure does.
    """
    accept_any_text()
    # A log that a full disk refuses is no reason for a traceback; a result that it refuses has a message.
    logging.raiseExceptions = False
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with disk_failures_of_threads() as failures:
            status = _dispatch(given)
        # Here and not at exit, where nobody could catch it if the reader has gone.
        sys.stdout.flush()
        return status or (_report(failures[0], full=False) if failures else 0)
    except KeyboardInterrupt:
        from toile.cli.failures import INTERRUPTED

        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output (head, less) has gone; keep Python from complaining when it flushes.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _dispatch(given: Sequence[str]) -> int:
    if not given or given[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    name, *rest = given
    if "--version" in given:
        print(f"toile {__version__}")
        return 0
    if name == "completion":
        from toile.cli.completion import completion

        return completion(rest)
    if name not in COMMANDS:
        from toile.cli.suggestions import did_you_mean

        guess = did_you_mean(name, [*COMMANDS, "completion"])
        known = f"There are {', '.join(COMMANDS)}. See toile --help."
        print(f"error: no command {name!r}{guess or '.'} {known}", file=sys.stderr)
        return USAGE_ERROR
    if {"-sc", "--shell-completion"} & set(rest):
        print("error: say toile completion bash, zsh or fish, for all commands at once", file=sys.stderr)
        return USAGE_ERROR
    return _run(name, rest)


def _run(name: str, arguments: Sequence[str]) -> int:
    import hydra

    from toile.cli.configuration import (
        CONF,
        flags_first,
        name_plain_arguments,
        name_scenes,
        name_sessions,
        renamed_arguments,
    )
    from toile.cli.failures import FULL_ERROR_VARIABLE, CommandError
    from toile.cli.path_arguments import quote_paths
    from toile.cli.sweep import print_summary

    full = os.environ.get(FULL_ERROR_VARIABLE) == "1"
    argv = [f"toile {name}"]
    with _hydra_leaves_errors_to_us(FULL_ERROR_VARIABLE), _argv(argv):
        try:
            if name in RESUMABLE and any(a.startswith("resume=") for a in arguments):
                from toile.cli.resume import resume_arguments

                arguments = resume_arguments(arguments, RESUMABLE[name])
            arguments = renamed_arguments(arguments, COMMANDS[name].aliases)
            arguments = quote_paths(name_plain_arguments(arguments, COMMANDS[name].plain))
            argv += flags_first(name_sessions(name_scenes(arguments)))
            if {"-h", "--help"} & set(argv):
                from toile.cli.shown import help_text

                print(help_text(name, argv[1:]))
                return 0
            task = _reporting(_imported_when_called(COMMANDS[name].module), full)
            hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)(task)()
        except CommandError as failed:
            return failed.status
        except SystemExit as leaving:
            return leaving.code if isinstance(leaving.code, int) else 0
        except Exception as error:
            return _report(error, full, _suggestion(error, name, argv[1:]))
        finally:
            print_summary()
    return 0


def _imported_when_called(module: str) -> Callable[[Any], Any]:
    """``run`` of a module that is imported when a command really runs: not for --cfg, --info and mistakes."""
    from toile.cli.configuration import register_resolvers

    def run(cfg: Any) -> Any:
        # A launcher's worker process gets this function and nothing else of the program, but it resolves a
        # configuration before it calls it; naming this has the worker import the module that registers.
        register_resolvers()
        return importlib.import_module(module).run(cfg)

    # Hydra calls the job, and its folder, after the module of the function.
    run.__module__ = module
    return run


def _suggestion(error: Exception, command: str, arguments: Sequence[str]) -> str:
    """What the user may have meant, as a line to add to the message; "" where nothing is close."""
    from hydra.errors import ConfigCompositionException

    if not isinstance(error, ConfigCompositionException):
        return ""
    from toile.cli.suggestions import suggestion

    return suggestion(error, command, arguments)


def _reporting(run: Callable[[Any], Any], full: bool) -> Callable[[Any], Any]:
    """The task with its failures reported at once, so that the other runs of a sweep go on."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from toile.cli.failures import CommandError
    from toile.cli.settings import check_settings
    from toile.cli.sweep import noting_failures

    @wraps(run)
    def task(cfg: Any) -> Any:
        try:
            with noting_failures():
                check_settings(cfg)
                return run(cfg)
        except BrokenPipeError:
            raise
        except Exception as error:
            status = error.status if isinstance(error, CommandError) else _report(error, full)
            if HydraConfig.get().mode is RunMode.MULTIRUN:
                raise CommandError(status) from None
            # Nothing is left to do; Hydra passes this one on without a word of its own.
            raise SystemExit(status) from None

    return task


def _report(error: Exception, full: bool, suggestion: str = "") -> int:
    """Print the message of a failure and return its status; mistakes in the program are raised again."""
    from toile.cli.failures import explain

    failure = explain(error)
    if failure is None:
        raise error
    if full:
        traceback.print_exception(error)
    else:
        print(failure.message + suggestion, file=sys.stderr)
    return failure.status


@contextmanager
def _hydra_leaves_errors_to_us(variable: str) -> Iterator[None]:
    """With this variable Hydra raises what it would otherwise print as a cropped traceback."""
    before = os.environ.get(variable)
    os.environ[variable] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[variable]
        else:
            os.environ[variable] = before


@contextmanager
def _argv(arguments: list[str]) -> Iterator[None]:
    """Hydra reads its arguments from ``sys.argv`` only."""
    before = sys.argv
    sys.argv = arguments
    try:
        yield
    finally:
        sys.argv = before


if __name__ == "__main__":
    sys.exit(main())
