"""Completion of the command line: what is offered where, and the scripts in real shells."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gausim.cli.completion import _hydra_parser, complete
from gausim.cli.main import COMMANDS, main


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ev", {"evaluate"}),
        ("--v", {"--version"}),
        ("evaluate --vi", {"--views"}),
        ("evaluate RUN --views ", {"all", "train", "heldout"}),
        ("evaluate RUN --out ", set()),  # files, which the shell knows better
        ("nonsense ", set()),
        ("config ", {"validate", "schema", "completion"}),
        ("config completion ", {"bash", "zsh", "fish"}),
        ("prepare lpips --f", {"--from"}),
        ("train --mu", {"--multirun"}),
        ("train model=gausim_", {"model=gausim_elastic", "model=gausim_paper"}),
        ("train mod", {"model=", "model.", "model_for_data="}),
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
        ("adapt RUN --set trainer.max_e", {"trainer.max_epochs="}),
        ("benchmark train experiment=demo_", {"experiment=demo_tiny"}),
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
        ("gausim evaluate RUN --views ", breaks, ["all", "train", "heldout"]),
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
