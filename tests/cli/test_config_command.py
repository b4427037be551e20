"""`gausim config`: what it says of wrong configurations, and a schema that knows every file of conf/."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft7Validator
from omegaconf import OmegaConf

from gausim.cli.main import main
from gausim.compose import validate as _validate
from gausim.compose.config import compose
from gausim.compose.root import conf_dir
from gausim.compose.schema import training_schema
from gausim.core import ConfigError


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    return training_schema()


@pytest.fixture
def once(schema, monkeypatch):
    """The schema is the same every time, and takes a moment to make."""
    monkeypatch.setattr(_validate, "training_schema", lambda: schema)


def plain(*overrides: str) -> dict[str, Any]:
    return OmegaConf.to_container(compose("train", overrides), resolve=True)


def violations(schema: dict[str, Any], config: Any) -> list[str]:
    return [f"{error.json_path}: {error.message}" for error in Draft7Validator(schema).iter_errors(config)]


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("model.simulator.template.mode", 3, "model.simulator.template"),
        ("trainer.max_epochs", "ten", "trainer.max_epochs"),
        (
            "model.simulator.hierarchy.levels",
            [{"diameter": "wide", "edge_length": 1.0}],
            "model.simulator.hierarchy.levels[0].diameter",
        ),
        ("callbacks.progess", {"refresh_rate": 2}, "callbacks.progess"),
        ("optimiser", {}, "$"),
        ("sweep.retry", True, "sweep"),
        ("data.curriculum.t_start", None, "data.curriculum.t_start"),
    ],
)
def test_the_schema_refuses_what_is_wrong(key: str, value: Any, told: str, schema) -> None:
    config = plain("model=gausim_elastic")
    *parents, last = key.split(".")
    node = config
    for parent in parents:
        node = node[parent]
    node[last] = value
    (found,) = violations(schema, config)
    assert found.startswith(f"{told if told == '$' else f'$.{told}'}: ")


def test_the_schema_is_printed(capsys, schema, monkeypatch) -> None:
    monkeypatch.setattr("gausim.compose.schema.training_schema", lambda: schema)
    Draft7Validator.check_schema(schema)
    assert main(["config", "schema"]) == 0
    assert json.loads(capsys.readouterr().out) == schema


@pytest.mark.parametrize(
    "what",
    [
        ["bunny_points"],
        ["model=spring_mass", "seed=3"],
        [f"{conf_dir()}/ablation/no_mass.yaml"],
        [f"{conf_dir()}/train.yaml"],
    ],
)
def test_what_is_in_order(what: list[str], once, capsys) -> None:
    assert main(["config", "validate", *what]) == 0
    assert "in order" in capsys.readouterr().out


def test_a_file_beside_conf_is_composed_as_with_config_dir(once, tmp_path, capsys) -> None:
    own = tmp_path / "my conf" / "experiment" / "mine.yaml"
    own.parent.mkdir(parents=True)
    text = "# @package _global_\ndefaults:\n- override /model: gausim\nmodel: {simulator: {head: {anchor: false}}}"
    own.write_text(text)
    assert main(["config", "validate", str(own)]) == 0
    own.write_text(text.replace("anchor", "achor"))
    capsys.readouterr()
    assert main(["config", "validate", str(own), "sed=1"]) == 1
    assert capsys.readouterr().out.splitlines() == [
        "sed: unknown key. Did you mean 'seed'?",
        "model.simulator.head.achor: unknown key of gausim.models.step.head.Head. Did you mean 'anchor'?",
    ]


def test_every_wrong_override_is_named_with_the_nearest_right_key(once, capsys) -> None:
    wrong = ["sed=1", "model.simulator.template.peroid=1", "trainer.max_epoch=3", "render=nope", "seed=x", "freeze=5"]
    assert main(["config", "validate", *wrong, "model=gausim", "trainer.max_minutes=soon"]) == 1
    told = capsys.readouterr()
    for expected in (
        "sed: unknown key. Did you mean 'seed'?",
        # Which only this model has.
        "model.simulator.template.peroid: unknown key. Did you mean 'model.simulator.template.period'?",
        "trainer.max_epoch: unknown key. Did you mean 'trainer.max_epochs'?",
        "Available options in 'render': auto cpu gsplat reference",
        "seed=x: Value 'x' of type 'str' could not be converted to Integer",
        "trainer.max_minutes: expected a number or null, got 'soon'.",
    ):
        assert expected in told.out
    assert told.err == "6 faults\n"


def test_keys_that_hydra_merges_silently_are_named(once, capsys) -> None:
    wrong = ["+model.simulator.network.layer=3", "+callbacks.progess.refresh_rate=3", "+model.plan=null"]
    wrong += ["+model.plans=null"]
    assert main(["config", "validate", *wrong]) == 1
    told = capsys.readouterr().out
    assert (
        "model.simulator.network.layer: unknown key of gausim.nn.meshgraphnet.MeshGraphNet. Did you mean 'layers'?"
        in told
    )
    assert "callbacks.progess: expected a node with `_target_`" in told and "Did you mean 'progress'?" in told
    assert "model.plans: unknown key. Did you mean 'plan'?" in told and told.count("\n") == 3


def test_a_saved_configuration(once, tmp_path, capsys) -> None:
    config = plain("model=gausim")
    saved = tmp_path / "run" / "config.yaml"
    saved.parent.mkdir()
    saved.write_text(yaml.safe_dump(config))
    assert main(["config", "validate", str(saved.parent)]) == 0
    config["optimiser"] = config.pop("optimizer")
    config["data"]["curriculum"]["tmax"] = 3
    saved.write_text(yaml.safe_dump(config))
    capsys.readouterr()
    assert main(["config", "validate", str(saved)]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told == [
        "optimizer: missing. Every configuration that is trained has it.",
        "data.curriculum.tmax: unknown key of gausim.data.curriculum.Curriculum. Did you mean 't_max'?",
        "optimiser: unknown key. Did you mean 'optimizer'?",
    ]


def test_all_targets_that_may_not_be_built_are_named(once, tmp_path) -> None:
    config = plain()
    config["render"] = {"_target_": "os.system", "command": f"touch {tmp_path / 'canary'}"}
    config["loss"]["image"]["_target_"] = "gausim.losses.image.ImageLos"
    first, second = sorted(_validate.check(config), reverse=True)
    assert first.startswith("render._target_: ") and "'os.system'" in first
    assert second.startswith("loss.image: ") and "ImageLos" in second
    assert not (tmp_path / "canary").exists()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (["bunyy"], "Did you mean 'bunny'?"),
        (["nowhere.yaml"], "expected a YAML file or a run directory"),
        (["part.yaml"], "is composed with others"),
        (["list.yaml"], "expected a mapping, got list"),
        (["torn.yaml"], "cannot be read as YAML"),
        (["list.yaml", "seed=1"], "expected a saved configuration alone"),
    ],
)
def test_what_is_no_configuration(what: list[str], message: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("part.yaml").write_text("defaults:\n  - override /model: gausim\n")
    Path("list.yaml").write_text("- 3\n")
    Path("torn.yaml").write_text("a: [\n")
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        _validate.faults(what)
