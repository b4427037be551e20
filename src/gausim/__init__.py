"""gausim: learn, compare and play with neural simulators of elastic objects made of 3D Gaussians.

``gausim.load(RUN)`` gives a learned object that can be pushed, watched and drawn (:class:`gausim.api.Simulation`);
``gausim.load_run(RUN)`` a trained run: model, scenes, data, renderer (:class:`gausim.compose.build.LoadedRun`).
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_LATE = {"load": "gausim.api", "load_run": "gausim.compose.build"}


def __getattr__(name: str) -> Any:
    """Imported when first asked for: they need torch, which ``import gausim`` does not wait for."""
    if name in _LATE:
        return getattr(import_module(_LATE[name]), name)
    raise AttributeError(f"module 'gausim' has no attribute {name!r}")
