"""gausim: learn, compare and play with neural simulators of elastic objects made of 3D Gaussians.

``gausim.load_run(RUN)`` gives a trained run back: model, scenes, data, renderer (:class:`gausim.cli._run.LoadedRun`).
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """``load_run``, imported when it is first asked for: it needs torch, which ``import gausim`` does not wait for."""
    if name == "load_run":
        return import_module("gausim.cli._run").load_run
    raise AttributeError(f"module 'gausim' has no attribute {name!r}")
