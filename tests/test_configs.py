"""Every file in conf/ composes, names only what may be built, fits the signatures it names, and builds where it can."""

from __future__ import annotations

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
from jsonschema import Draft7Validator
from omegaconf import DictConfig, ListConfig, OmegaConf

from gausim.compose import config as _config
from gausim.compose import root as _conf
from gausim.compose.config import check_targets, compose, instantiate, run_hydra
from gausim.compose.places import more_settings, option_of, read_places
from gausim.compose.root import conf_dir
from gausim.compose.schema import training_schema
from gausim.core.errors import ConfigError
from gausim.training.ranks.launch import Crew
from gausim.training.ranks.layout import Layout, LocalRanks, RanksStrategy
from gausim.training.trainer import make_trainer

FILES = sorted(
    path.relative_to(conf_dir()).with_suffix("") for path in conf_dir().rglob("*.yaml") if path.parent.name != "base"
)
# Searches of one method each, which are composed with the values that they try.
OPTIONS = [path.as_posix() for path in FILES if len(path.parts) > 1]
# They set keys of other groups or of Hydra, and so build nothing of their own under their name.
NOT_BUILT = ("hydra", "paths")
# They change other groups under `@package _global_`: everything is built with them.
GLOBAL = ("experiment", "ablation", "budget", "sweep", "method", "protocol")
SPECIAL = ("_target_", "_partial_", "_recursive_", "_convert_", "_args_")


def compose_option(option: str) -> DictConfig:
    group, name = option_of(conf_dir() / f"{option}.yaml")
    overrides = [f"{group}={name}"]
    return compose("train", [*overrides, *(["model=gausim"] if group == "ablation" else [])])


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
    """Whether the file alone can build the object; otherwise code injects the missing arguments."""
    signature, arguments = signature_of(node)
    try:
        signature.bind(*node.get("_args_", []), **arguments)
    except TypeError:
        return False
    return True


def needs_other_hardware(config: DictConfig) -> bool:
    accelerator = str(OmegaConf.select(config, "trainer.accelerator", default="cpu"))
    return accelerator not in ("cpu", "auto") and not torch.cuda.is_available()


@pytest.fixture(scope="module")
def schema() -> Draft7Validator:
    return Draft7Validator(training_schema())


@pytest.mark.parametrize("option", OPTIONS)
def test_option_composes_fits_the_signatures_and_builds(
    option: str, schema: Draft7Validator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "disabled")
    config, group = compose_option(option), option.split("/")[0]
    check_targets(config)
    for node in targets(config):
        signature, arguments = signature_of(node)
        signature.bind_partial(*node.get("_args_", []), **arguments)  # TypeError: a key that the target does not take
    assert list(schema.iter_errors(OmegaConf.to_container(config, resolve=True))) == []
    if group == "experiment":  # it wins over the root file
        written = OmegaConf.load(conf_dir() / f"{option}.yaml")
        assert all(config[key] == written[key] for key in {"name", "seed"} & set(written))
    if group in NOT_BUILT:
        return
    if needs_other_hardware(config):
        pytest.skip(f"{option} asks for trainer.accelerator={config.trainer.accelerator}, which this machine lacks")
    if group == "trainer" and config.trainer.get("devices", 1) > 1:
        crew = Crew(Layout(config.trainer.devices, accelerator="cpu"))
        crew.environment = LocalRanks(0, config.trainer.devices, port=1)  # as if the others had started
        made = make_trainer(instantiate(config.trainer, accelerator="cpu"), epochs=1, crew=crew)
        assert made.world_size == config.trainer.devices and isinstance(made.strategy, RanksStrategy)
        return
    for node in config.values() if group in GLOBAL or group not in config else [config[group]]:
        build(node)


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


def test_settings_that_no_configuration_lists_are_the_constructors_defaults() -> None:
    root = read_places()
    for key, value in more_settings().items():
        *parents, name = key.split(".")
        place = functools.reduce(lambda node, part: node.children[part], parents, root)
        takers = [inspect.signature(hydra.utils.get_object(target)).parameters for target in place.targets]
        defaults = [parameters[name].default for parameters in takers if name in parameters]
        assert defaults and all((list(d) if isinstance(d, tuple) else d) == value for d in defaults), key


def test_settings_that_no_configuration_lists_are_set_like_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(leaves(compose("train"))) <= 90
    config = compose("train", ["trainer.progress=false", "loss.image.window=7", "trainer.overwrite=true"])
    assert config.trainer.progress is False and config.loss.image.window == 7 and config.overwrite is True
    assert "trainer.overwrite is called overwrite now" in capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"model\.simulator\.network\.compile: unknown key"):
        compose("train", ["model=spring_mass", "model.simulator.network.compile=true"])


def sweep_of(path: Path) -> dict[str, list[str]]:
    """The values of every key that a file sweeps over."""
    node = yaml.safe_load((conf_dir() / path.with_suffix(".yaml")).read_text())
    params = node["hydra"]["sweeper"]["params"]
    return {key: re.findall(r"\[[^]]*\]|[^,]+", str(value)) for key, value in params.items()}


TABLES = [path for path in FILES if path.parts[:2] == ("experiment", "tables")]


@pytest.mark.parametrize("path", TABLES, ids=[path.name for path in TABLES])
def test_jobs_of_a_table_compose(path: Path) -> None:
    params = sweep_of(path)
    config = compose("train", [f"experiment=tables/{path.name}", *(f"{key}={v[-1]}" for key, v in params.items())])
    assert config.evaluate is True
    for key, values in params.items():
        known = OmegaConf.select(config, key) if "." in key or key == "seed" else None
        assert known is None or known == yaml.safe_load(values[-1]), key


def test_a_comparison_is_at_strength_on_sealed_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("GAUSIM_SYNTHETIC_TEST", raising=False)
    config = compose("train", ["experiment=tables/comparison", "method=physdreamer", "protocol=bunny_test"])
    assert config.model.method.discretisation.filling.dense == 1.0 and config.model.method.discretisation.cells == 32
    assert config.data.sequences == config.data.test.sequences == ["seq_008", "seq_009", "seq_010", "seq_011"]
    assert config.protocol.part == "test" and config.plan.max_minutes == 10
    config = compose("train", ["method=gausim_paper", "protocol=pudding_soft_test", "budget=gpu"])
    assert config.plan.repeats == 70 and config.loss.backprop_steps == 1 and config.data.names == ["pudding_soft"]
    assert config.data.test.seeds == list(range(101, 121)) and str(config.data.root).endswith("synthetic_test")


def leaves(node: Any) -> list[Any]:
    """Settings below a node; what is built there aside."""
    if isinstance(node, DictConfig):
        return [leaf for key in node if key not in SPECIAL for leaf in leaves(node._get_node(key))]
    return [node]


@pytest.mark.parametrize(
    "swept",
    [
        ["plan.max_minutes=1,2", "ablation=none,no_mass"],
        ["data.root=a/b,a/../b,a_b"],
        ["experiment=bunny,bunny_paper", "name=rose"],
    ],
)
def test_jobs_of_a_sweep_never_share_a_directory(
    swept: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[Path] = []
    arguments = ["-m", *swept, "paths.output_root=o", *(() if swept[-1].startswith("name") else ("name=rose",))]
    run_hydra("train", lambda config: seen.append(_config.run_dir()), arguments)
    assert len(seen) == math.prod(len(override.split(",")) for override in swept)
    assert len(set(seen)) == len(seen)
    for path in seen:
        inside = path.resolve().relative_to(tmp_path / "o")
        assert inside.name.startswith("seed_")
        assert not re.search(r"(name|seed|ablation|model|output_root)=", str(inside))  # said by the path already


def test_a_list_of_ablations_is_named_by_all_its_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[tuple[str, str]] = []
    swept = ["-m", "ablation=none,[no_mass,no_momentum],[no_momentum,no_mass]", "model=gausim"]
    run_hydra("train", lambda config: seen.append((config.ablation.name, _config.run_dir().parts[-3])), swept)
    assert seen == [(name, name) for name in ("none", "no_mass+no_momentum", "no_momentum+no_mass")]


def test_a_folder_name_is_one_short_component_and_tells_texts_apart() -> None:
    assert _conf.folder_name("") == "" and _conf.folder_name("a.b=1,+c=x") == "a.b=1,+c=x"
    texts = ["a/b", "a_b", "a//b", "a b", "../b", "k=" + 200 * "x", "k=" + 201 * "x"]
    names = [_conf.folder_name(text) for text in texts]
    assert len(set(names)) == len(names)
    assert all("/" not in name and len(name) <= 120 for name in names)


@pytest.mark.parametrize(
    ("override", "key", "meant"),
    [("modle=gausim", "modle", "model"), ("sed=1", "sed", "seed"), ("plan.epoch=3", "plan.epoch", None)],
)
def test_unknown_keys_are_named_with_what_was_meant(override: str, key: str, meant: str | None) -> None:
    with pytest.raises(ConfigError, match=key) as caught:
        compose("train", [override])
    assert meant is None or f"Did you mean {meant}" in str(caught.value)


@pytest.mark.parametrize(
    "target",
    [
        "os.system", "builtins.eval", "subprocess.run", "hydra.utils.get_method", "gausimulator.Evil",
        "torch.os.system", "torch.load", "torch.hub.load", "torch.utils.collect_env.run", "torch.distributed.run.main",
        "torch.ops.load_library", "torch.fx.graph_module._exec_with_source",
        "torch._inductor.codecache.PyCodeCache.load", "torch.nn.modules.module.torch.load",
        "lightning.fabric.plugins.io.torch_io.TorchCheckpointIO.load_checkpoint",
        "gausim.runs.files.sole_writer", "gausim.io.files.write_durably", "gausim.cli.main.main", "lightning",
    ],
)  # fmt: skip
def test_allow_list_refuses_and_names_key_and_target(target: str) -> None:
    config = OmegaConf.create({"callbacks": [{"_target_": "torch.nn.ReLU", "inner": {"_target_": target}}]})
    with pytest.raises(ConfigError) as caught:
        instantiate(config)
    assert "callbacks[0].inner" in str(caught.value)
    assert repr(target) in str(caught.value)


def test_refused_targets_are_not_reached_through_interpolation() -> None:
    config = OmegaConf.create({"a": {"_target_": "${b}"}, "b": "os.getcwd"})
    with pytest.raises(ConfigError, match=r"os\.getcwd"):
        instantiate(config.a)


def test_targets_and_arguments_that_do_not_exist_are_named() -> None:
    with pytest.raises(ConfigError, match=r"torch\.nn\.Linearr"):
        instantiate({"_target_": "torch.nn.Linearr"})
    config = OmegaConf.create({"model": {"_target_": "torch.nn.Linear", "in_features": 2, "out_features": 3, "foo": 1}})
    with pytest.raises(ConfigError, match=r"model(.|\n)*foo"):
        instantiate(config.model)
    with pytest.raises(ConfigError, match="foo"):
        instantiate(config)
    with pytest.raises(TypeError):  # a defect inside the constructor stays what it is
        instantiate({"_target_": "torch.nn.Linear", "in_features": "two", "out_features": 3})


def test_injected_objects_are_not_copied_and_partials_await_their_arguments() -> None:
    layer = torch.nn.Linear(2, 3)
    optimizer = instantiate({"_target_": "torch.optim.SGD", "lr": 0.5}, params=layer.parameters())
    assert optimizer.param_groups[0]["params"][0] is layer.weight
    factory = instantiate({"_target_": "torch.optim.SGD", "_partial_": True, "lr": 0.5})
    optimizer = factory(torch.nn.Linear(2, 3).parameters())
    assert optimizer.param_groups[0]["lr"] == 0.5
