"""The configuration of every command, shipped with the package as ``toile.conf``; see docs/extending.md."""
