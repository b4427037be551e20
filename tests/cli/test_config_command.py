"""`gausim config`: what it says of wrong configurations, a schema that knows conf/, and completion in the shell."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft7Validator
from omegaconf import OmegaConf

from gausim.cli.completion import _hydra_parser, complete
from gausim.cli.main import COMMANDS, main
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
    wrong = ["sed=1", "model.simulator.template.peroid=1", "plan.epoch=3", "render=nope", "seed=x", "freeze=5"]
    assert main(["config", "validate", *wrong, "model=gausim", "plan.max_minutes=soon"]) == 1
    told = capsys.readouterr()
    for expected in (
        "sed: unknown key. Did you mean 'seed'?",
        # Which only this model has.
        "model.simulator.template.peroid: unknown key. Did you mean 'model.simulator.template.period'?",
        "plan.epoch: unknown key. Did you mean 'plan.epochs'?",
        "Available options in 'render': auto cpu gsplat reference",
        "seed=x: Value 'x' of type 'str' could not be converted to Integer",
        "plan.max_minutes: expected a number or null, got 'soon'.",
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
    config = plain("model=gausim_elastic")
    saved = tmp_path / "run" / "config.yaml"
    saved.parent.mkdir()
    saved.write_text(yaml.safe_dump(config))
    assert main(["config", "validate", str(saved.parent)]) == 0
    config["optimiser"] = config.pop("optimizer")
    config["plan"] |= {"tmax": 3}
    config["model"]["simulator"]["template"]["mode"] = 3
    config["model"]["simulator"]["hierarchy"]["levels"] = [{"diameter": "wide", "edge_length": 1.0}]
    config["sweep"]["retry"] = True
    config["plan"]["epochs"] = "ten"
    saved.write_text(yaml.safe_dump(config))
    capsys.readouterr()
    assert main(["config", "validate", str(saved)]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told == [
        "optimizer: missing. Every configuration that is trained has it.",
        "model.simulator.hierarchy.levels.0.diameter: expected a number, got 'wide'.",
        "model.simulator.template.mode: unknown key of gausim.models.template.elastic.ElasticTemplate. "
        "Did you mean 'modes'?",
        "optimiser: unknown key. Did you mean 'optimizer'?",
        "plan.epochs: expected a whole number or null, got 'ten'.",
        "plan.tmax: unknown key of gausim.training.plan.TrainingPlan. Did you mean 't_max'?",
        "sweep.retry: unknown key. Known: retry_failed.",
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


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ev", {"evaluate"}),
        ("--v", {"--version"}),
        ("evaluate --cam", {"--cameras"}),
        ("evaluate RUN --cameras ", {"all", "train", "heldout"}),
        ("evaluate RUN --out ", set()),  # files, which the shell knows better
        ("nonsense ", set()),
        ("config ", {"validate", "schema", "completion"}),
        ("config completion ", {"bash", "zsh", "fish"}),
        ("prepare lpips --f", {"--from"}),
        ("train --mu", {"--multirun"}),
        ("train model=gausim_", {"model=gausim_elastic", "model=gausim_paper"}),
        ("train mod", {"model=", "model."}),
        ("train model=spring_mass model.", {"model.method.", "model.plan."}),
        ("train model=gausim model.simulator.template.perio", {"model.simulator.template.period="}),
        ("train loss.image.win", {"loss.image.window="}),  # which no configuration lists
        ("train model=spring_mass model.simulator.network.comp", set()),
        ("train model.simulator.template.spac", set()),  # the default model has none
        ("train -m ablation=none,no_hier", {"ablation=none,no_hierarchy"}),
        ("train trainer.progress=", {"trainer.progress=true", "trainer.progress=false"}),
        ("train hydra/swee", {"hydra/sweeper="}),
        ("train sed=1 model.simu", set()),  # beside what is wrong nothing composes
        ("config validate experiment=demo_", {"experiment=demo_tiny"}),
    ],
)  # fmt: skip
def test_what_may_follow(line: str, expected: set[str]) -> None:
    assert set(complete(line.split(" "))) == expected


def test_directories_are_completed_behind_a_key(tmp_path: Path) -> None:
    (tmp_path / "stores").mkdir()
    assert complete(["train", f"data.root={tmp_path}/st"]) == [f"data.root={tmp_path}/stores/"]


def test_every_command_offers_its_options() -> None:
    for name in COMMANDS:
        parser = getattr(importlib.import_module(f"gausim.cli.{name}"), "_parser", _hydra_parser)()
        named = set(re.findall(r"--[\w-]+", parser.format_usage()))
        assert named | {"--help"} <= set(complete([name, "--"])), name
        assert len(named) > 1 or name in ("config", "prepare")


ASK = """gausim() { "$PYTHON" -m gausim.cli.main "$@"; }
source "$1"; complete -p gausim
COMP_LINE=$2 COMP_POINT=${#2} COMP_WORDBREAKS=$3
_gausim 2>/dev/null; printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_the_script_in_bash(tmp_path: Path, capsys) -> None:
    assert main(["config", "completion", "bash"]) == 0
    script = tmp_path / "gausim.bash"
    script.write_text(capsys.readouterr().out)
    breaks = " \t\n\"'><=;|&(:"
    for line, where, expected in (
        ("gausim eval", breaks, ["evaluate"]),
        ("gausim evaluate RUN --cameras ", breaks, ["all", "train", "heldout"]),
        # Readline has `model` and `=` behind it already, unless = breaks no words.
        ("gausim train model=gausim_p", breaks, ["gausim_paper"]),
        ("gausim train model=gausim_p", " \t\n", ["model=gausim_paper"]),
        ("gausim evaluate outp", breaks, []),
    ):
        told = subprocess.run(
            ["bash", "--norc", "-c", ASK, "bash", str(script), line, where],
            capture_output=True, text=True, check=True, env={**os.environ, "PYTHON": sys.executable},
        )  # fmt: skip
        registered, *reply = told.stdout.splitlines()
        assert registered == "complete -o default -F _gausim gausim"
        assert [choice for choice in reply if choice] == expected, line


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_the_scripts_of_other_shells_are_well_formed(shell: str, tmp_path: Path, capsys) -> None:
    assert main(["config", "completion", shell]) == 0
    script = tmp_path / f"gausim.{shell}"
    script.write_text(capsys.readouterr().out)
    assert "config complete" in script.read_text()
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    assert subprocess.run([shell, "-n", str(script)]).returncode == 0
