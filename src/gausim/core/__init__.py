"""Types, errors and contracts that every other room builds on."""

from gausim.core.camera import Cameras
from gausim.core.errors import BusyError, ConfigError, DataError, DivergenceError, GausSimError, RunError, SceneError
from gausim.core.fitted import FittedDynamics, FittedMethod, FittedState, TakesOver
from gausim.core.protocols import (
    Dynamics,
    Forces,
    Rendered,
    Renderer,
    Steppable,
    SteppedFrame,
    Stepper,
    roll_out,
    trajectory_of,
)
from gausim.core.scene import GaussianScene
from gausim.core.smooth import SmoothMotions
from gausim.core.state import SimState, Trajectory

__all__ = [
    "Cameras",
    "BusyError",
    "ConfigError",
    "DataError",
    "DivergenceError",
    "Dynamics",
    "FittedDynamics",
    "FittedMethod",
    "FittedState",
    "Forces",
    "GausSimError",
    "GaussianScene",
    "Rendered",
    "Renderer",
    "RunError",
    "SceneError",
    "SimState",
    "SmoothMotions",
    "Steppable",
    "SteppedFrame",
    "Stepper",
    "TakesOver",
    "Trajectory",
    "roll_out",
    "trajectory_of",
]
