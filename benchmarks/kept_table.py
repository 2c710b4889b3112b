"""Tables of sessions with open labels that keep their lines, and the pages beside them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pandas as pd
import torch
from holders import added
from session_ladder import made

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers
from toile.generation.clip_plan import DEFAULT_CLIPS


def asked_for(doc: str | None) -> argparse.ArgumentParser:
    """The arguments of a program that adds sessions to its table; it computes on one thread."""
    torch.set_num_threads(1)
    register_resolvers()
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", nargs="+", default=[], help="to add, see session_ladder")
    return parser


def of_first_clips(
    names: Sequence[str], folder: Path, ways: Mapping[str, Callable[[Path], list[dict[str, object]]]]
) -> pd.DataFrame:
    """Lines of first clips of sessions, in several ways; what is kept in the folder is not found anew.

    Args:
        names: of sessions, see session_ladder.
        folder: where they are made, and what is found is kept.
        ways: what is found of a session's folder, by what the file's name ends with.
    """
    rows: list[dict[str, object]] = []
    for name in names:
        session = made(name, folder, DEFAULT_CLIPS[:1])
        for ending, found in ways.items():
            kept = folder / f"{session.name}{ending}.json"
            if not kept.is_file():
                write_text(kept, json.dumps(found(session)))
            new = json.loads(kept.read_text())
            print(pd.DataFrame(new).to_string(index=False), flush=True)
            rows += new
    return pd.DataFrame(rows)


def update(path: Path, new: pd.DataFrame, keys: Sequence[str], page: Callable[[pd.DataFrame], str]) -> None:
    """Add rows to a table, in place of those that are the same by these columns, and write its page."""
    table = pd.read_csv(path) if path.is_file() else pd.DataFrame()
    table = added(table, new, keys)
    write_text(path, table.to_csv(index=False, float_format="%.5g"))
    write_text(path.with_suffix(".md"), page(table))


def revisions(table: pd.DataFrame) -> str:
    """At which its lines were found, shortened."""
    return ", ".join(dict.fromkeys(str(revision)[:7] for revision in table["revision"]))


def in_markdown(table: pd.DataFrame) -> str:
    """The table without revisions, with a dash where nothing is known."""
    shown = table.drop(columns="revision", errors="ignore").astype(object)
    return str(shown.where(shown.notna(), "–").to_markdown(index=False))
