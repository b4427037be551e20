"""Every file in conf/ composes, names only what may be built, fits the signatures it names, and builds where it can."""

import functools
import inspect
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import pytest
import torch
import yaml
from omegaconf import DictConfig, ListConfig, OmegaConf

from gausim.cli.sweeps.jobs import TRAINED, JobResult
from gausim.compose.command import run_dir, run_hydra
from gausim.compose.config import compose, instantiate
from gausim.compose.root import conf_dir, folder_name, options
from gausim.compose.targets import check_targets
from gausim.core.errors import ConfigError
from gausim.runs.comparison import flatten
from gausim.training.plan import DataFacts

GROUPS = sorted(path.name for path in conf_dir().iterdir() if path.is_dir() and path.name != "hydra")
OPTIONS = [f"{group}={name}" for group in GROUPS for name in options(group)]
TABLES = [name for name in options("experiment") if name.startswith("tables/")]
SPECIAL = ("_target_", "_partial_", "_recursive_", "_convert_", "_args_")


def leaves(config: DictConfig) -> dict[str, Any]:
    """The settings of a configuration; what is built there aside."""
    plain = OmegaConf.to_container(config, resolve=True)
    return {key: value for key, value in flatten(plain) if key.rpartition(".")[2] not in SPECIAL}


def targets(node: Any) -> Iterator[DictConfig]:
    """Every node below that has a `_target_`, the node itself included."""
    if isinstance(node, DictConfig):
        if node.get("_target_") is not None:
            yield node
        for key in node:
            yield from targets(node[key])
    elif isinstance(node, ListConfig):
        for child in node:
            yield from targets(child)


def signature_of(node: DictConfig) -> tuple[inspect.Signature, dict[str, Any]]:
    target = hydra.utils.get_object(node._target_)
    return inspect.signature(target), {str(key): None for key in node if key not in SPECIAL}


def is_complete(node: DictConfig) -> bool:
    """Whether the node alone can build the object; otherwise code injects the missing arguments."""
    signature, arguments = signature_of(node)
    try:
        signature.bind(*node.get("_args_", []), **arguments)
    except TypeError:
        return False
    return True


def build(node: Any) -> None:
    """Builds the topmost complete nodes; below an incomplete one, its complete parts."""
    if isinstance(node, DictConfig) and node.get("_target_") is not None:
        if is_complete(node) or node.get("_partial_"):
            made = instantiate(node)
            assert made is not None
            assert isinstance(made, functools.partial) == bool(node.get("_partial_"))
            return
    for child in node if isinstance(node, ListConfig) else node.values() if isinstance(node, DictConfig) else ():
        build(child)


@pytest.mark.parametrize(
    "option", [pytest.param(o, marks=[pytest.mark.slow] * (o == "logger=mlflow")) for o in OPTIONS]
)
def test_option_composes_fits_the_signatures_and_builds(option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "disabled")
    config = compose([option])
    check_targets(config)
    for node in targets(config):
        signature, arguments = signature_of(node)
        signature.bind_partial(*node.get("_args_", []), **arguments)  # TypeError: a key that the target does not take
    if option == "render=gsplat" and not torch.cuda.is_available():
        pytest.skip("gsplat needs a GPU")
    group = option.partition("=")[0]
    for key in ("model", "loss", "optimizer", "plan") if group == "model" else [group]:
        build(config.get(key))


def test_the_chooser_is_small_and_every_setting_of_the_default_model_is_visible() -> None:
    assert len(GROUPS) <= 10 and len(list(conf_dir().rglob("*.yaml"))) <= 70
    assert len(leaves(compose())) <= 75


# Other values of settings whose default does not tell their kind, or that take some texts only.
OTHER: dict[str, Any] = {
    "data.names": ["a"], "data.part": "test", "data.root": "elsewhere",
    "data.scene": "a.ply", "data.selections": {"pinned": "low"}, "data.sequences": 3, "data.test.seeds": [1],
    "model.simulator.hierarchy.edges": "union", "model.simulator.network.norm": "joint",
    "data.law": "springs",
    "model.simulator.hierarchy.levels": [{"diameter": 0.3, "edge_length": 1.0}],
    "plan.schedule": "halving", "plan.clock": "cpu", "trainer.accelerator": "cpu",
    "name": "other", "output_root": "elsewhere", "init_from": "run", "freeze": "network",
    "ablation.name": "no_mass", "plan.t_start": 2,
}  # fmt: skip


def test_every_setting_of_the_default_model_can_be_set() -> None:
    asked = {}
    for key, value in leaves(compose()).items():
        other = not value if isinstance(value, bool) else 7 if value is None else value
        asked[key] = OTHER.get(key, other if isinstance(value, bool) or value is None else 2 * value or 0.25)
        asked[key] = int(asked[key] or 3) if isinstance(value, int) and not isinstance(value, bool) else asked[key]
    texts = [f"{key}={yaml.safe_dump(value, default_flow_style=True, width=10_000).split(chr(10))[0]}"
             for key, value in asked.items()]  # fmt: skip
    config = compose(texts)
    found = OmegaConf.to_container(config, resolve=True)
    for key, value in asked.items():
        assert functools.reduce(dict.__getitem__, key.split("."), found) == value, key
    for key in ("data", "model", "loss", "optimizer", "plan", "supervision", "render", "trainer"):
        build(config[key])


def test_defaults_of_constructors_are_those_of_the_default_configuration() -> None:
    config = compose()
    for section in ("model", "loss", "optimizer", "plan", "trainer"):
        for node in targets(config[section]):
            if not node._target_.startswith("gausim."):
                continue
            for name, parameter in signature_of(node)[0].parameters.items():
                value = OmegaConf.to_container(node).get(name, parameter.default)
                if parameter.default is not parameter.empty and not isinstance(value, dict):
                    default = list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default
                    assert default == value, (node._target_, name)


def test_the_paper_is_one_word() -> None:
    config = compose(["model=gausim_paper"])
    simulator = config.model.simulator
    assert (simulator.network.hidden, simulator.network.layers, simulator.network.norm) == (128, 16, "joint")
    assert simulator.hierarchy.max_neighbours == 16 and simulator.hierarchy.edges == "union"
    assert simulator.features.velocities and not simulator.features.rest_inputs and simulator.features.attributes == 4
    assert simulator.template is None and simulator.head.lever == 0 and simulator.rollout.energy_guard_frames == 0
    assert config.model.initial_states._target_.endswith(".FreeInitialStates")
    loss = config.loss
    assert (loss.image.balance, loss.backprop_steps, loss.rest_image_weight) == (0.9, 1, 1)
    rates = {config.optimizer[name] for name in ("network_lr", "scene_lr", "initial_lr")}
    assert rates == {4 * 2e-4} and config.plan.batch_size == 4  # one sequence on each of four GPUs
    assert config.optimizer.optimizer._target_ == "torch.optim.Adam"
    plan = instantiate(config.plan).resolved(DataFacts(sequences=30, frames=16, can_warm_start=True))
    assert (plan.epochs, plan.repeats, plan.t_max, plan.warm_start) == (25, 70, 15, None)
    assert [plan.steps(epoch) for epoch in (0, 1, 13, 14, 24)] == [1, 2, 14, 15, 15]
    factors = [plan.rate_factor("network", epoch / 25) for epoch in (0, 15.9, 16, 18, 24)]
    assert factors == [1, 1, 0.5, 0.25, 0.5**5]


CHOICES = [
    ("model=gausim_paper", ("model", "loss", "optimizer", "plan")), ("data=bunny", ("data",)),
    ("trainer=ddp", ("trainer",)), ("supervision=tracks", ("supervision",)), ("render=cpu", ("render",)),
]  # fmt: skip


@functools.cache
def chosen_alone(choice: str) -> DictConfig:
    return compose([choice])


@pytest.mark.parametrize("name", options("experiment"))
def test_an_experiment_never_undoes_the_command_line(name: str) -> None:
    chosen = compose([f"experiment={name}", *(choice for choice, _ in CHOICES)])
    for choice, sections in CHOICES:
        assert all(chosen[section] == chosen_alone(choice)[section] for section in sections), choice
    words = [f"experiment={name}", "model=gausim_paper", "plan.epochs=3", "seed=5", "name=mine", "evaluate=false"]
    config = compose(words)
    assert (config.plan.epochs, config.seed, config.name, config.evaluate) == (3, 5, "mine", False)


def sweep_of(name: str) -> dict[str, list[str]]:
    """The values of every key that an experiment sweeps over."""
    params = compose([f"experiment={name}"], with_hydra=True).hydra.sweeper.params
    return {key: re.findall(r"\[[^]]*\]|[^,]+", str(value)) for key, value in params.items()}


@pytest.mark.parametrize("name", TABLES)
def test_jobs_of_a_table_compose(name: str) -> None:
    params = sweep_of(name)
    config = compose([f"experiment={name}", *(f"{key}={values[-1]}" for key, values in params.items())])
    assert config.evaluate is True
    for key, values in params.items():
        if key not in GROUPS:
            assert OmegaConf.select(config, key) == yaml.safe_load(values[-1]), key


def test_the_comparison_is_on_sealed_data_with_equal_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GAUSIM_SYNTHETIC_TEST", raising=False)
    for data in sweep_of("tables/comparison")["data"]:
        config = compose(["experiment=tables/comparison", "model=physdreamer", f"data={data}"])
        assert config.data.part == "test" and config.trials == 4 and config.plan.max_minutes == 10
    config = compose(["data=test/pudding_soft"])
    assert str(config.data.root).endswith("synthetic_test") and list(config.data.names) == ["pudding_soft"]
    assert list(config.data.test.seeds) == list(range(101, 121))


@pytest.mark.parametrize(
    "swept",
    [["plan.max_minutes=1,2", "ablation=none,no_mass"], ["data.root=a/b,a/../b,a_b"], ["data=bunny,synthetic"]],
)
def test_jobs_of_a_sweep_never_share_a_directory(swept, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[Path] = []

    def job(config: DictConfig) -> JobResult:
        seen.append(run_dir())
        return JobResult(TRAINED, str(seen[-1]))

    run_hydra(job, ["-m", *swept, "output_root=o"])
    assert len(set(seen)) == len(seen) == math.prod(len(override.split(",")) for override in swept)
    for path in seen:
        inside = path.resolve().relative_to(tmp_path / "o")
        assert inside.name.startswith("seed_") and (inside.parts[0] == "sweep") == (swept[0].startswith("data="))
        assert not re.search(r"(name|seed|ablation|model|output_root)=", str(inside))  # said by the path already


def test_a_folder_name_is_one_short_component_and_tells_texts_apart() -> None:
    assert folder_name("") == "" and folder_name("a.b=1,+c=x") == "a.b=1,+c=x"
    names = [folder_name(text) for text in ["a/b", "a_b", "a//b", "a b", "../b", "k=" + 200 * "x", "k=" + 201 * "x"]]
    assert len(set(names)) == len(names)
    assert all("/" not in name and len(name) <= 120 for name in names)


def test_a_directory_is_a_data_set_and_names_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my objects" / "vase").mkdir(parents=True)
    seen: list[tuple[str, str]] = []
    run_hydra(lambda config: seen.append((config.data.root, config.name)), ["data=my objects/vase"])
    assert seen == [(str(tmp_path / "my objects" / "vase"), "vase")]
    assert (tmp_path / "outputs" / "vase" / "seed_0").is_dir()


def test_the_configurations_of_all_jobs_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    run_hydra(lambda config: None, ["-m", "ablation=none,no_mass", "seed=0,1", "--cfg", "job"])
    found = list(yaml.safe_load_all(capsys.readouterr().out))
    chosen = [(one["model"]["simulator"]["conserve_mass"], one["seed"]) for one in found]
    assert chosen == [(True, 0), (True, 1), (False, 0), (False, 1)]


@pytest.mark.parametrize(("words", "message"), [
    ("modle=gausim", "modle: unknown key. Did you mean 'model'?"),
    ("trainer.thread=2", "trainer.thread: unknown key. Did you mean 'trainer.threads'?"),
    ("model=gausm", "model=gausm: unknown choice. Did you mean 'gausim'?"),
    ("data=syntetic", "data=syntetic: neither a directory nor a name of conf/data. Did you mean 'synthetic'?"),
    ("seed=x", "seed: Value 'x' of type 'str' could not be converted to Integer."),
    ("experiment=tables/joint", "experiment=tables/joint: is several trainings, so add -m."),
    ("ablation=no_mass model=static",
     "ablation=no_mass: does not fit this model, which has no key model.simulator.conserve_mass."),
    ("ablation=joint",
     "ablation=joint: changes nothing of this configuration, so it would repeat ablation=none."),
])  # fmt: skip
def test_a_wrong_command_is_one_sentence_and_leaves_nothing(words, message, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments in (words.split(), ["-m", *words.split(), "name=sweep"]):
        if "several" in message and "-m" in arguments:
            continue
        with pytest.raises(ConfigError) as caught:
            run_hydra(lambda config: None, arguments)
        assert str(caught.value) == message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("target", [
    "os.system", "builtins.eval", "subprocess.run", "hydra.utils.get_method", "gausimulator.Evil",
    "torch.os.system", "torch.load", "torch.hub.load", "torch.utils.collect_env.run", "torch.distributed.run.main",
    "torch.ops.load_library", "torch.fx.graph_module._exec_with_source",
    "torch._inductor.codecache.PyCodeCache.load", "torch.nn.modules.module.torch.load",
    "lightning.fabric.plugins.io.torch_io.TorchCheckpointIO.load_checkpoint",
    "gausim.runs.files.sole_writer", "gausim.io.files.write_durably", "gausim.cli.main.main", "lightning",
])  # fmt: skip
def test_allow_list_refuses_and_names_key_and_target(target: str) -> None:
    config = OmegaConf.create({"callbacks": [{"_target_": "torch.nn.ReLU", "inner": {"_target_": target}}]})
    with pytest.raises(ConfigError) as caught:
        instantiate(config)
    assert "callbacks[0].inner" in str(caught.value)
    assert repr(target) in str(caught.value)


def test_what_may_not_be_built_or_does_not_exist_is_named() -> None:
    config = OmegaConf.create({"a": {"_target_": "${b}"}, "b": "os.getcwd"})
    with pytest.raises(ConfigError, match=r"os\.getcwd"):
        instantiate(config.a)
    with pytest.raises(ConfigError, match=r"torch\.nn\.Linearr"):
        instantiate({"_target_": "torch.nn.Linearr"})
    config = OmegaConf.create({"model": {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3, "foo": 1}})
    with pytest.raises(ConfigError, match=r"model(.|\n)*foo"):
        instantiate(config.model)
    with pytest.raises(ConfigError, match="foo"):
        instantiate(config)
    with pytest.raises(TypeError):  # a defect inside the constructor stays what it is
        instantiate({"_target_": "torch.nn.Linear", "in_features": "two", "out_features": 3})
