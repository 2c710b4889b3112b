"""Another name of ``toile.atomic_file``."""

from toile.atomic_file import write_text, written_atomically

__all__ = ["write_text", "written_atomically"]
