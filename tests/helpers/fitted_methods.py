"""Fitted methods of the toy object and what they predict."""

from typing import Any

from gausim.baselines.fitted import Fitted, FittedState
from gausim.core import GaussianScene
from helpers.toy_object import toy_scene


def recorded(*scenes: GaussianScene, seen: int = 7) -> dict[str, Any]:
    """The arguments of every fitted method: two sequences of each scene, by default of the toy object."""
    scenes = scenes or (toy_scene(),)
    count = len(scenes)
    return {"scenes": scenes, "fps": [24.0] * count, "scene_of_sequence": [*range(count)] * 2, "seen": seen}


def rolled(method: Fitted, frames: int, state: FittedState | None = None) -> list[FittedState]:
    """The beginning of sequence 0, or a given state, and the frames that follow."""
    states = [state or method.begin(0)]
    for _ in range(frames):
        states.append(method.advance(states[-1]))
    return states
