"""Tables of sessions with open labels that keep their lines, and the pages beside them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd
import torch
from holders import added

from toile.atomic_file import write_text
from toile.cli.configuration import register_resolvers


def asked_for(doc: str | None) -> argparse.ArgumentParser:
    """The arguments of a program that adds sessions to its table; it computes on one thread."""
    torch.set_num_threads(1)
    register_resolvers()
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", nargs="+", default=[], help="to add, see session_ladder")
    return parser


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
