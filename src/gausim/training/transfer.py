"""What a run may take over from another: the network that scenes share with its statistics, or all of the simulator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from gausim.core import ConfigError, RunError
from gausim.models.step.simulator import GausSim
from gausim.runs.checkpoint import averaged_weights, fingerprints, read_checkpoint, scene_text
from gausim.runs.directory import RunDirectory, differing_keys

# Prefix of the simulator's weights in a checkpoint of the training module.
_PREFIX = "model."
_SHOWN = 3


def load_shared(simulator: GausSim, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads what a trained run's scenes shared into a simulator of any scenes; everything else of it stays as it is.

    ``model`` is the configuration of the simulator, to tell what differs.

    Raises:
        RunError: there is no run or no readable checkpoint.
        ConfigError: its network is of another shape; nothing was loaded.
    """
    there, _ = _read(run_dir)
    shared = tuple(f"{name}." for name in simulator.shared())
    found, own = (
        {name: value for name, value in weights.items() if name.startswith(shared)}
        for weights in (there, simulator.state_dict())
    )
    _check(found, own, "network", run_dir, model)
    simulator.load_state_dict(found, strict=False)


def load_simulator(simulator: GausSim, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads all of a trained simulator into one of some of its scenes, which are told by name, size and positions.

    ``model`` is the configuration of the simulator, to tell what differs.

    Raises:
        RunError: there is no run or no readable checkpoint, or it was not trained on a scene.
        ConfigError: its weights are of another shape; nothing was loaded.
    """
    there, trained = _read(run_dir)
    shared = tuple(f"{name}." for name in simulator.shared())
    found = {name: value for name, value in there.items() if name.startswith(shared)}
    for scene_id, scene in enumerate(fingerprints(simulator.scenes)):
        if scene not in trained:
            raise RunError(
                f"{RunDirectory(run_dir).checkpoint} was trained on {scene_text(trained)}, not on "
                f"{scene_text([scene])}."
            )
        for old, new in zip(simulator.own(trained.index(scene)), simulator.own(scene_id), strict=True):
            found |= {new + name[len(old) :]: value for name, value in there.items() if _is_below(name, old)}
    _check(found, simulator.state_dict(), "model", run_dir, model)
    simulator.load_state_dict(found)


def _read(run_dir: Path | str) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """A trained simulator's weights by name, averaged where the run averaged, and the scenes that it knows."""
    checkpoint = read_checkpoint(RunDirectory(run_dir).checkpoint)
    weights = averaged_weights(checkpoint).items()
    own = {name.removeprefix(_PREFIX): value for name, value in weights if name.startswith(_PREFIX)}
    return own, checkpoint["gausim"]["scenes"]


def _is_below(name: str, prefix: str) -> bool:
    """Whether a name is the prefix or lies below it; ``attributes.10`` does not lie below ``attributes.1``."""
    return name == prefix or (prefix.endswith(".") and name.startswith(prefix))


def _check(
    found: Mapping[str, Tensor], own: Mapping[str, Tensor], what: str, run_dir: Path | str, model: Mapping[str, Any]
) -> None:
    """Raises ConfigError where weights cannot be loaded, with the settings of ``model`` that differ from the run's."""
    problems = []
    for name in sorted(set(found) | set(own)):
        shapes = [tuple(side[name].shape) if name in side else None for side in (found, own)]
        if shapes[0] != shapes[1]:
            there, here = ("absent" if shape is None else f"of shape {shape}" for shape in shapes)
            problems.append(f"{name} is {there} there, {here} here")
    if problems:
        run = RunDirectory(run_dir)
        changed = [f"model.{key}" for key in differing_keys(run.config().get("model", {}), model)]
        more = f" and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        raise ConfigError(
            f"init_from: the {what} of {run.checkpoint} does not fit this model: {'; '.join(problems[:_SHOWN])}{more}. "
            f"Set the model as {run.path}/config.yaml has it; what differs: {', '.join(changed) or 'nothing'}."
        )
