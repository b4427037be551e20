"""Builds training modules from configurations, and loads trained modules from run directories."""

import copy
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from omegaconf import DictConfig, OmegaConf

from gausim.baselines.fitting import FittedModule
from gausim.compose.config import instantiate
from gausim.compose.data_paths import absolute, located
from gausim.compose.device import find_device
from gausim.compose.targets import check_seed
from gausim.core import ConfigError, Renderer
from gausim.data.datamodule import ReadyDataModule
from gausim.data.objects import ObjectData
from gausim.losses.objective import Objective
from gausim.render.auto import AutoRenderer
from gausim.render.cpu import CpuRenderer
from gausim.render.gsplat import GsplatRenderer
from gausim.runs.checkpoint import check_scenes, load_weights, read_checkpoint
from gausim.runs.choices import hydra_record
from gausim.runs.data_print import changed_files
from gausim.runs.directory import RunDirectory
from gausim.runs.names import TEST
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.plan import DataFacts, TrainingPlan
from gausim.training.supervision.images import Sources

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class LoadedRun:
    """A trained run, loaded for evaluation or simulation."""

    config: dict[str, Any]  # the resolved configuration
    module: GausSimModule | FittedModule  # the module in evaluation mode, with the run's weights
    objects: list[ObjectData]  # the objects; their index is the ``scene_id`` of the module's scenes
    datamodule: ReadyDataModule  # the data
    renderer: Renderer  # the renderer of the training, or the one that fits the device
    run_dir: Path  # the run directory
    device: torch.device = torch.device("cpu")  # where the module is


class Opened(NamedTuple):
    """A training configuration and its data."""

    config: DictConfig  # states what its plan leaves to the data, and absolute paths
    data: ReadyDataModule  # with the resolved plan


def opened(cfg: DictConfig | Mapping[str, Any], *, sealed: bool = True) -> Opened:
    """Opens the data of a training configuration and resolves its plan for them.

    ``sealed`` refuses unseen frames and the true motion of the test part.

    Raises:
        GausSimError: a node is wrong, the data are missing or damaged, or the plan does not fit them.
    """
    config = copy.deepcopy(cfg) if isinstance(cfg, DictConfig) else OmegaConf.create(dict(cfg))
    check_seed(config.seed)
    data: ReadyDataModule = instantiate(config.data, seed=int(config.seed))
    data.sealed = sealed
    data.plan = plan = _resolved_plan(config, data)
    OmegaConf.set_struct(config, False)
    config.plan = {**config.plan, **plan.settings()}
    config.data = absolute(cast("dict[str, Any]", OmegaConf.to_container(config.data, resolve=True)))
    if "method" in config.model:
        config.plan.repeats = plan.repeats
    OmegaConf.set_struct(config, True)
    return Opened(config, data)


def build(
    cfg: DictConfig | Mapping[str, Any], *, sealed: bool = True
) -> tuple[GausSimModule | FittedModule, ReadyDataModule]:
    """The module and the data of a training configuration; ``sealed`` and errors are those of :func:`opened`."""
    config, data = opened(cfg, sealed=sealed)
    return build_module(config, data), data


def build_module(config: DictConfig, data: ReadyDataModule) -> GausSimModule | FittedModule:
    """The module of an opened configuration.

    Raises:
        GausSimError: a node is wrong, the model cannot be trained, or a rest scene is missing or damaged.
    """
    if "method" in config.model:
        return _fitted(config, data)
    if "simulator" in config.model and "initial_states" in config.model:
        return _simulator(config, data)
    raise ConfigError(
        "model: expected the entries 'simulator' and 'initial_states' of a model that learns (gausim, ...), or "
        f"'method' and 'plan' of one that is fitted (spring_mass, ...), got {sorted(str(k) for k in config.model)}."
    )


def _fitted(config: DictConfig, datamodule: ReadyDataModule) -> FittedModule:
    method = instantiate(
        config.model.method,
        scenes=[item.scene() for item in datamodule.objects],
        fps=[item.fps for item in datamodule.objects],
        scene_of_sequence=[scene_id for scene_id, _ in datamodule.index.entries],
        seen=cast(TrainingPlan, datamodule.plan).t_max,
    )()
    explosion = (instantiate(config.loss) if config.get("loss") else Objective()).explosion
    return FittedModule(
        method, instantiate(config.model.plan), renderer=instantiate(config.render), explosion=explosion
    )


def _simulator(config: DictConfig, datamodule: ReadyDataModule) -> GausSimModule:
    scenes = [item.scene() for item in datamodule.objects]
    renderer, objective = instantiate(config.render), instantiate(config.loss)
    model = instantiate(config.model.simulator, scenes=scenes, fps=[item.fps for item in datamodule.objects])()
    entries, node = datamodule.index.entries, config.get("supervision")
    scene_of_sequence = [scene_id for scene_id, _ in entries]
    states = instantiate(config.model.initial_states, model=model, scene_of_sequence=scene_of_sequence)()
    method = SharedSimulator(model, states, scene_of_sequence, [record.hands for _, record in entries])
    truth, references = datamodule.index.ground_truth, method.references
    sources = Sources(scenes, truth, model.smooth_motions, renderer, objective.image, references)
    return GausSimModule(
        method=method,
        renderer=renderer,
        objective=objective,
        optimizer=instantiate(config.optimizer),
        supervision=instantiate(node)(sources) if node else None,
        plan=cast(TrainingPlan, datamodule.plan),
        seed=int(config.seed),
    )


def _resolved_plan(config: DictConfig, datamodule: ReadyDataModule) -> TrainingPlan:
    plan: TrainingPlan = instantiate(config.plan)
    trainer, count = config.trainer, len(datamodule.index)
    ranks = int(trainer.get("devices", 1)) * int(trainer.get("num_nodes", 1))
    frames = min(len(item.train_frames) for item in datamodule.objects)
    if "method" not in config.model:
        can = _can_warm_start(config, datamodule)
        held = can and any(record.hands is not None for _, record in datamodule.index.entries)
        free = any(item.surroundings.free for item in datamodule.objects)
        return plan.resolved(DataFacts(count, frames, can, can and not held, free), ranks=ranks)
    # The sequences are fitted independently, in stages of their own.
    own = instantiate(config.model.plan)
    plan = replace(plan, epochs=max(1, own.epochs), repeats=own.shows, batch_size=plan.batch_size or 1)
    return plan.resolved(DataFacts(count, frames, can_warm_start=False))


def _can_warm_start(config: DictConfig, datamodule: ReadyDataModule) -> bool:
    bodies = [item.surroundings for item in datamodule.objects]
    if any(body.free or body.floor is not None for body in bodies):
        return False
    compared = str((config.get("supervision") or {}).get("_target_", "")).rpartition(".")[2]
    return compared != "PointSupervision" or all(record.hands is None for _, record in datamodule.index.entries)


def load_run(run_dir: Path | str, *, data: Mapping[str, Any] | None = None, device: str = "cpu") -> LoadedRun:
    """Loads a run; its test part is sealed until `gausim evaluate --test` has looked at it.

    ``data`` replaces keys of the data configuration, e.g. ``{"root": "/elsewhere"}``; ``device`` as for
    :func:`gausim.compose.device.find_device`.

    Raises:
        ConfigError: there is no such device.
        RunError: the run or checkpoint is missing, or the scene differs from the one it was trained on.
        DataError: the data set or scene of the configuration is not on this machine, and no replacement is given.
    """
    directory, place = RunDirectory(run_dir), find_device(device)
    config, module, datamodule = _load(directory, data)
    # A renderer of the other kind of device gives way to the one that fits.
    renderer: Renderer = module.renderer
    if isinstance(renderer, CpuRenderer if place.type == "cuda" else GsplatRenderer):
        renderer = cast(Renderer, AutoRenderer())
    return LoadedRun(config, module.to(place), datamodule.objects, datamodule, renderer, directory.path, place)


def _load(
    directory: RunDirectory, data: Mapping[str, Any] | None
) -> tuple[dict[str, Any], GausSimModule | FittedModule, ReadyDataModule]:
    """Configuration, module and data of a run, in evaluation mode with the run's weights."""
    config = directory.config()
    loaded = read_checkpoint(directory.checkpoint)
    config["data"] = located(directory.path, config.get("data", {}), data or {})
    module, datamodule = build(config, sealed=not (directory.path / TEST).is_file())
    if changed := changed_files(directory.path, datamodule.objects):
        logger.warning("%s What follows is of the data as they are now.", changed)
    check_scenes(loaded, module.scenes, str(directory.checkpoint))
    load_weights(module, loaded)
    module.take_notes(loaded)
    if isinstance(module, GausSimModule) and (name := hydra_record(directory.path)[1].get("model")):
        module.method.name = name
    module.eval()
    return config, module, datamodule
