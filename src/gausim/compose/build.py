"""Builds training modules from configurations, and loads trained modules from run directories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from gausim.compose.config import instantiate
from gausim.compose.data_paths import located
from gausim.core import ConfigError, Renderer
from gausim.data.datamodule import ReadyDataModule
from gausim.data.objects import ObjectData
from gausim.data.pretraining import CorpusDataModule
from gausim.losses.objective import Objective
from gausim.runs.checkpoint import check_scenes, load_weights, read_checkpoint
from gausim.runs.directory import RunDirectory
from gausim.runs.names import TEST
from gausim.training.fitted.fitting import StagedFit
from gausim.training.fitted.stages import StagedCurriculum
from gausim.training.method import SharedSimulator
from gausim.training.module import GausSimModule
from gausim.training.pretraining import KnownStates
from gausim.training.supervision.images import Sources


@dataclass(frozen=True, eq=False)
class LoadedRun:
    """A trained run, loaded for evaluation or simulation."""

    config: dict[str, Any]  # the resolved configuration
    module: GausSimModule  # the module in evaluation mode, with the run's weights (averaged ones if there are any)
    objects: list[ObjectData]  # the objects; their index is the ``scene_id`` of the module's scenes
    datamodule: ReadyDataModule  # the data
    renderer: Renderer  # the renderer of the training
    run_dir: Path  # the run directory


def build(cfg: DictConfig | Mapping[str, Any], *, sealed: bool = True) -> tuple[GausSimModule, ReadyDataModule]:
    """Builds the module and the data of a training configuration.

    ``sealed`` refuses unseen frames and the true motion of the test part.

    Raises:
        GausSimError: a node is wrong, the model cannot be trained, or the data or a rest scene is missing or damaged.
    """
    config = cfg if isinstance(cfg, DictConfig) else OmegaConf.create(dict(cfg))
    fits = "method" in config.model
    if not fits and ("simulator" not in config.model or "initial_states" not in config.model):
        raise ConfigError(
            "model: expected the entries 'simulator' and 'initial_states' of a model that learns (gausim, "
            "gausim_paper), or 'method' and 'plan' of one that is fitted (spring_mass, ...), got "
            f"{sorted(str(k) for k in config.model)}."
        )
    plan, settings = None, {}
    if fits:  # the plan sets T and the shows per epoch; sequences are fitted independently
        plan = instantiate(config.model.plan)
        curriculum = StagedCurriculum(t_start=1, t_max=int(config.data.curriculum.t_max), plan=plan)
        settings = {"curriculum": curriculum, "repeats": plan.shows, "batch_size": config.data.batch_size or 1}
    datamodule = instantiate(config.data, **settings)
    datamodule.sealed = sealed
    scenes = [item.scene() for item in datamodule.objects]
    given = {"scenes": scenes, "fps": [item.fps for item in datamodule.objects]}
    renderer, objective = instantiate(config.render), instantiate(config.loss)
    if plan is None:
        model = instantiate(config.model.simulator, **given)()
        method: SharedSimulator | StagedFit = _shared_simulator(config, model, datamodule)
        smooth, learns = model.smooth_motions, objective
    else:
        given |= {"scene_of_sequence": [scene_id for scene_id, _ in datamodule.index.entries]}
        fitted = instantiate(config.model.method, **given, seen=datamodule.curriculum.t_max)()
        method = StagedFit(fitted, plan, datamodule.curriculum, objective.explosion)
        smooth, learns = (lambda scene_id: None), Objective(explosion=objective.explosion)
    sources = Sources(scenes, datamodule.index.ground_truth, smooth, renderer, objective.image, method.references)
    node = config.get("supervision")
    module = GausSimModule(
        method=method,
        renderer=renderer,
        objective=learns,
        optimizer=None if fits else instantiate(config.optimizer),
        supervision=instantiate(node)(sources) if node else None,
        seed=int(config.seed),
    )
    return module, datamodule


def _shared_simulator(config: DictConfig, model: Any, datamodule: ReadyDataModule) -> SharedSimulator:
    entries = datamodule.index.entries
    scene_of_sequence = [scene_id for scene_id, _ in entries]
    if isinstance(datamodule, CorpusDataModule):
        return KnownStates(model, datamodule, scene_of_sequence)
    states = instantiate(config.model.initial_states, model=model, scene_of_sequence=scene_of_sequence)()
    return SharedSimulator(model, states, scene_of_sequence, [record.hands for _, record in entries])


def load_run(run_dir: Path | str, *, checkpoint: str = "last.ckpt", data: Mapping[str, Any] | None = None) -> LoadedRun:
    """Loads a run; its test part is sealed until `gausim evaluate --test` has looked at it.

    ``data`` replaces keys of the data configuration, e.g. ``{"root": "/elsewhere"}``.

    Raises:
        RunError: the run or checkpoint is missing, or the scene differs from the one it was trained on.
        DataError: the data set or scene of the configuration is not on this machine, and no replacement is given.
    """
    directory = RunDirectory(run_dir)
    if is_pretrained(directory.path):
        raise ConfigError(
            f"{directory.path}: pretrained on a corpus of bodies, of which there are no videos. Start a training from "
            f"it: `gausim train experiment=finetune model=gausim init_from={directory.path} data.root=OBJECT`."
        )
    config, module, datamodule = _load(directory, checkpoint, data)
    return LoadedRun(config, module, datamodule.objects, datamodule, module.renderer, directory.path)


def is_pretrained(run_dir: Path | str) -> bool:
    """Whether a run was trained on, or fitted to, bodies of a corpus."""
    target = RunDirectory(run_dir).config().get("data", {}).get("_target_")
    return bool(target == "gausim.data.pretraining.CorpusDataModule")


def load_corpus_run(
    run_dir: Path | str, *, data: Mapping[str, Any] | None = None
) -> tuple[GausSimModule, CorpusDataModule]:
    """Loads a run of which :func:`is_pretrained` is true; arguments and errors are those of :func:`load_run`."""
    _, module, datamodule = _load(RunDirectory(run_dir), "last.ckpt", data)
    return module, cast(CorpusDataModule, datamodule)


def _load(
    directory: RunDirectory, checkpoint: str, data: Mapping[str, Any] | None
) -> tuple[dict[str, Any], GausSimModule, ReadyDataModule]:
    """Configuration, module and data of a run, in evaluation mode with the run's weights."""
    config = directory.config()
    loaded = read_checkpoint(directory.path / checkpoint)
    config["data"] = located(directory.path, config.get("data", {}), data or {})
    module, datamodule = build(config, sealed=not (directory.path / TEST).is_file())
    check_scenes(loaded, module.simulator.scenes, str(directory.path / checkpoint))
    load_weights(module, loaded)
    module.take_notes(loaded)
    module.eval()
    return config, module, datamodule
