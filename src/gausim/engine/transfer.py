"""What a run may take over from another: the network that all scenes share, with the statistics of its inputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from gausim.core import ConfigError
from gausim.engine.checkpoint import averaged_weights, read_checkpoint
from gausim.engine.contracts import Simulator
from gausim.engine.run import RunDirectory, differing_keys

# Prefix of the simulator's weights in a checkpoint of the training module.
_PREFIX = "model."
_SHOWN = 3


def load_shared(simulator: Simulator, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads what a trained run's scenes shared into a simulator of any scenes; everything else of it stays as it is.

    Args:
        simulator: what is to be trained.
        run_dir: the trained run; its averaged weights are taken where it averaged.
        model: the configuration of the simulator, to tell what differs.

    Raises:
        RunError: there is no run or no readable checkpoint.
        ConfigError: its network is of another shape; nothing was loaded.
    """
    run = RunDirectory(run_dir)
    trained = run.config().get("model", {})
    weights = averaged_weights(read_checkpoint(run.checkpoint))
    parts = simulator.shared()
    found = {name: _below(weights, f"{_PREFIX}{name}.") for name in parts}
    problems = [
        f"{name}.{problem}" for name, part in parts.items() for problem in _mismatches(found[name], part.state_dict())
    ]
    if problems:
        changed = [f"model.{key}" for key in differing_keys(trained, model)]
        raise ConfigError(
            f"init_from: the network of {run.checkpoint} does not fit this model: {'; '.join(problems[:_SHOWN])}"
            f"{f' and {len(problems) - _SHOWN} more' if len(problems) > _SHOWN else ''}. "
            f"Set the model as {run.path}/config.yaml has it; what differs: {', '.join(changed) or 'nothing'}."
        )
    for name, part in parts.items():
        part.load_state_dict(found[name])


def _below(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}


def _mismatches(found: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> list[str]:
    """What keeps one from being loaded into the other, in words."""
    said = []
    for name in sorted(set(found) | set(own)):
        shapes = [tuple(side[name].shape) if name in side else None for side in (found, own)]
        if shapes[0] != shapes[1]:
            there, here = ("absent" if shape is None else f"of shape {shape}" for shape in shapes)
            said.append(f"{name} is {there} there, {here} here")
    return said
