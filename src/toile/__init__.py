"""toile: physics-based reconstruction of real cloth from one ordinary RGB video.

From Python: ``toile.load_scene``, ``generate``, ``simulate``, ``render``, ``fit``, ``evaluate``, ``diagnose``
and ``load_run`` (see ``toile.api``). They are loaded when they are first asked for, because PyTorch,
Lightning and Hydra come with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from toile.api import (
        diagnose,
        evaluate,
        fit,
        generate,
        load_run,
        load_scene,
        render,
        simulate,
    )

__version__ = "0.1.0"

__all__ = [
    "__version__",
    "diagnose",
    "evaluate",
    "fit",
    "generate",
    "load_run",
    "load_scene",
    "render",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("toile.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
