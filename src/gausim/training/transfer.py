"""Weights from another run: the network with its input statistics, or the whole simulator."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from gausim.core import ConfigError, RunError
from gausim.models.step.predictor import with_floor_columns
from gausim.models.step.simulator import GausSim
from gausim.runs.checkpoint import fingerprints, read_checkpoint, scene_text
from gausim.runs.comparison import differing_keys
from gausim.runs.directory import RunDirectory

# Prefix of the simulator's weights in a checkpoint of the training module.
_PREFIX = "model."
_SHOWN = 3


def load_shared(simulator: GausSim, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads the weights common to a trained run's scenes into a simulator of any scenes; the others stay unchanged.

    ``model`` is the configuration of the simulator, for the message of an error.

    Raises:
        RunError: there is no run or no readable checkpoint.
        ConfigError: the networks' shapes differ; nothing was loaded.
    """
    there, _ = _read(run_dir)
    shared = simulator.shared()
    found, own = (
        {name: value for name, value in weights.items() if name.startswith(shared)}
        for weights in (there, simulator.state_dict())
    )
    found = with_floor_columns(found, own)
    _check(found, own, "network", run_dir, model)
    simulator.load_state_dict(found, strict=False)


def load_simulator(simulator: GausSim, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads all weights of a trained simulator into one of some of its scenes, identified by name, size and positions.

    ``model`` is the configuration of the simulator, for the message of an error.

    Raises:
        RunError: there is no run or no readable checkpoint, or it was not trained on a scene.
        ConfigError: the weights' shapes differ; nothing was loaded.
    """
    there, trained = _read(run_dir)
    shared = simulator.shared()
    found = {name: value for name, value in there.items() if name.startswith(shared)}
    for scene_id, scene in enumerate(fingerprints(simulator.scenes)):
        if scene not in trained:
            raise RunError(
                f"{RunDirectory(run_dir).checkpoint} was trained on {scene_text(trained)}, not on "
                f"{scene_text([scene])}."
            )
        for old, new in zip(simulator.own(trained.index(scene)), simulator.own(scene_id), strict=True):
            found |= {new + name[len(old) :]: value for name, value in there.items() if _is_below(name, old)}
    found = with_floor_columns(found, simulator.state_dict())
    _check(found, simulator.state_dict(), "model", run_dir, model)
    simulator.load_state_dict(found)


def unlike(run_dir: Path | str, model: Mapping[str, Any]) -> list[str]:
    """Dotted settings of a simulator that a run has otherwise; weights of equal shape mean something else with them."""
    there = RunDirectory(run_dir).config().get("model", {})
    keys = differing_keys({"simulator": there.get("simulator", {})}, {"simulator": model.get("simulator", {})})
    return [f"model.{key}" for key in keys]


def _read(run_dir: Path | str) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """A trained simulator's weights by name, and its scenes."""
    checkpoint = read_checkpoint(RunDirectory(run_dir).checkpoint)
    weights = checkpoint["state_dict"].items()
    own = {name.removeprefix(_PREFIX): value for name, value in weights if name.startswith(_PREFIX)}
    return own, checkpoint["gausim"]["scenes"]


def _is_below(name: str, prefix: str) -> bool:
    """Whether a name equals the prefix or is below it; ``attributes.10`` is not below ``attributes.1``."""
    return name == prefix or (prefix.endswith(".") and name.startswith(prefix))


def _check(
    found: Mapping[str, Tensor], own: Mapping[str, Tensor], what: str, run_dir: Path | str, model: Mapping[str, Any]
) -> None:
    """Raises ConfigError where weights do not fit, naming the settings of ``model`` that differ from the run's."""
    problems = []
    for name in sorted(set(found) | set(own)):
        shapes = [tuple(side[name].shape) if name in side else None for side in (found, own)]
        if shapes[0] != shapes[1]:
            there, here = ("absent" if shape is None else f"of shape {shape}" for shape in shapes)
            problems.append(f"{name} is {there} there, {here} here")
    if problems:
        run, changed = RunDirectory(run_dir), unlike(run_dir, model)
        more = f" and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        raise ConfigError(
            f"init_from: the {what} of {run.checkpoint} does not fit this model: {'; '.join(problems[:_SHOWN])}{more}. "
            f"Set the model as {run.path}/config.yaml has it; what differs: {', '.join(changed) or 'nothing'}."
        )
