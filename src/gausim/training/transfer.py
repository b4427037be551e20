"""What a run may take over from another: the network that scenes share with its statistics, or all of the simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from torch import Tensor, nn

from gausim.core import ConfigError, RunError
from gausim.runs.checkpoint import averaged_weights, fingerprints, read_checkpoint, tell
from gausim.runs.directory import RunDirectory, differing_keys
from gausim.training.contracts import Transferable

# Prefix of the simulator's weights in a checkpoint of the training module.
_PREFIX = "model."
_SHOWN = 3


def load_shared(simulator: Transferable, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads what a trained run's scenes shared into a simulator of any scenes; everything else of it stays as it is.

    ``model`` is the configuration of the simulator, to tell what differs.

    Raises:
        RunError: there is no run or no readable checkpoint.
        ConfigError: its network is of another shape; nothing was loaded.
    """
    source = _Source(run_dir)
    parts = simulator.shared()
    found = {name: _below(source.weights, f"{name}.") for name in parts}
    problems = [
        f"{name}.{problem}" for name, part in parts.items() for problem in _mismatches(found[name], part.state_dict())
    ]
    source.refuse(problems, "network", model)
    for name, part in parts.items():
        part.load_state_dict(found[name])


def load_simulator(simulator: Transferable, run_dir: Path | str, model: Mapping[str, Any]) -> None:
    """Loads all of a trained simulator into one of some of its scenes, which are told by name, size and positions.

    ``model`` is the configuration of the simulator, to tell what differs.

    Raises:
        RunError: there is no run or no readable checkpoint, or it was not trained on a scene.
        ConfigError: its weights are of another shape; nothing was loaded.
    """
    source = _Source(run_dir)
    there, trained = source.weights, source.scenes
    shared = tuple(f"{name}." for name in simulator.shared())
    found = {name: value for name, value in there.items() if name.startswith(shared)}
    for scene_id, scene in enumerate(fingerprints(simulator.scenes)):
        if scene not in trained:
            raise RunError(f"{source.run.checkpoint} was trained on {tell(trained)}, not on {tell([scene])}.")
        for old, new in zip(simulator.own(trained.index(scene)), simulator.own(scene_id), strict=True):
            found |= {new + name[len(old) :]: value for name, value in there.items() if _is_below(name, old)}
    module = cast(nn.Module, simulator)
    source.refuse(_mismatches(found, module.state_dict()), "model", model)
    module.load_state_dict(found)


class _Source:
    """A trained run: its simulator's weights by name, averaged where it averaged, and the scenes it knows."""

    def __init__(self, run_dir: Path | str) -> None:
        self.run = RunDirectory(run_dir)
        self._model = self.run.config().get("model", {})
        checkpoint = read_checkpoint(self.run.checkpoint)
        self.weights = _below(averaged_weights(checkpoint), _PREFIX)
        self.scenes: list[dict[str, Any]] = checkpoint["gausim"]["scenes"]

    def refuse(self, problems: Sequence[str], what: str, model: Mapping[str, Any]) -> None:
        """Raises ConfigError if there are problems, with the settings of ``model`` that differ from the run's."""
        if problems:
            changed = [f"model.{key}" for key in differing_keys(self._model, model)]
            raise ConfigError(
                f"init_from: the {what} of {self.run.checkpoint} does not fit this model: "
                f"{'; '.join(problems[:_SHOWN])}"
                f"{f' and {len(problems) - _SHOWN} more' if len(problems) > _SHOWN else ''}. "
                f"Set the model as {self.run.path}/config.yaml has it; what differs: {', '.join(changed) or 'nothing'}."
            )


def _is_below(name: str, prefix: str) -> bool:
    """Whether a name is the prefix or lies below it; ``attributes.10`` does not lie below ``attributes.1``."""
    return name == prefix or (prefix.endswith(".") and name.startswith(prefix))


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
