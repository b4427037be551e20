"""Types, errors and interfaces that all other packages of gausim use."""

import importlib
from typing import TYPE_CHECKING, Any

from gausim.core.errors import BusyError, ConfigError, DataError, DivergenceError, GausSimError, RunError, SceneError

# Only the errors are imported eagerly, so that the command line can report errors without loading torch.
if TYPE_CHECKING:
    from gausim.core.camera import Cameras
    from gausim.core.protocols import (
        Adjustable,
        Dynamics,
        Forces,
        Frame,
        Handled,
        Hands,
        Rendered,
        Renderer,
        Steppable,
        Stepper,
        roll_out,
        trajectory_of,
    )
    from gausim.core.scene import GaussianScene
    from gausim.core.state import SimState, SmoothMotions, Trajectory
    from gausim.core.surroundings import Floor, HandPath, HandPose, Surroundings

__all__ = [
    "Adjustable", "BusyError", "Cameras", "ConfigError", "DataError", "DivergenceError", "Dynamics",
    "Floor", "Forces", "GausSimError", "GaussianScene", "HandPath",
    "HandPose", "Handled", "Hands", "Rendered", "Renderer", "RunError", "SceneError", "SimState", "SmoothMotions",
    "Steppable", "Frame", "Stepper", "Surroundings", "Trajectory", "roll_out", "trajectory_of",
]  # fmt: skip

_LATE = ("camera", "protocols", "scene", "state", "surroundings")


def __getattr__(name: str) -> Any:
    if name in __all__:
        for module in _LATE:
            found = importlib.import_module(f"{__name__}.{module}")
            if name in vars(found):
                return vars(found)[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
