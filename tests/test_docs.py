"""Pages name pages, commands and options that exist; notebooks are stripped; dependencies are pinned."""

import contextlib
import inspect
import io
import json
import os
import pkgutil
import re
import shlex
import subprocess
import tomllib
from functools import cache
from pathlib import Path

import pytest

from gausim.cli.main import COMMANDS
from gausim.cli.main import command as command_of

ROOT = Path(__file__).resolve().parents[1]


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_dependencies_are_pinned_and_named_pages_and_functions_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    declared = {normal(re.split(r"[^\w.-]", line)[0]) for group in groups for line in group}
    pinned = {normal(line.split("==")[0]) for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert len(declared) > 30 and declared <= pinned, declared - pinned
    pattern = r"(?:`|::: )(gausim(?:\.\w+)+)(?:\(|`|\n)"
    named = {name for page in PAGES for name in re.findall(pattern, page.read_text())}
    assert len(named) > 5
    for name in named:
        assert pkgutil.resolve_name(name) is not None
    named = set()
    for entry in (ROOT / name for name in NAMES_PAGES):
        for path in entry.rglob("*") if entry.is_dir() else [entry]:
            if path.suffix in (".py", ".yaml", ".toml", ".md", ".cpu", ".cuda", "") and path.is_file():
                named |= {(path, page) for page in re.findall(r"\b(?:docs|research)/[\w./-]+\.md", path.read_text())}
    assert len(named) > 10
    assert not {(str(path), page) for path, page in named if not (ROOT / page).is_file()}


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def text(path: Path) -> str:
    return "\n".join("".join(cell["source"]) for kind in ("markdown", "code") for cell in cells(path, kind))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped_any_environment_has_the_kernel_and_named_files_exist(path: Path) -> None:
    for cell in cells(path, "code"):
        assert cell["outputs"] == [] and cell["execution_count"] is None, f"{path.name}: run nbstripout"
        assert "execution" not in cell["metadata"]
    assert json.loads(path.read_text())["metadata"]["kernelspec"]["name"] == "python3"
    named = re.findall(r"`((?:docs|notebooks|conf)/[\w./-]+|README\.md)`", text(path))
    assert named, f"{path.name} points nowhere"
    for name in named:
        assert (ROOT / name).exists(), f"{path.name} names {name}, which is not there"


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SCRIPTS = sorted((ROOT / "docs" / "results" / "commands").glob("*.sh"))
NAMES_PAGES = ("src", "conf", "data_prep", "Makefile", "CHANGELOG.md", "CONTRIBUTING.md", "docker")


def _commands() -> list[tuple[str, list[str]]]:
    """Every `gausim COMMAND …` in code of a page, without its comment: (page, words)."""
    found = []
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for line in re.findall(r"^ {4}(gausim .*)", text, re.MULTILINE) + re.findall(r"`(gausim [^`]+)`", text):
            # What stands for something is no word: … and | between alternatives.
            words = shlex.split(line, comments=True)
            found.append((page.relative_to(ROOT).as_posix(), [word for word in words[1:] if word != "…"]))
    return found


@cache
def _help(command: str, *part: str) -> str:
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        command_of(command)([*part, "--help"])
    return said.getvalue()


def test_commands_and_options_of_the_pages_exist() -> None:
    commands = _commands()
    assert len(commands) > 100
    for page, (name, *words) in commands:
        assert name in COMMANDS or name in ("COMMAND", "--help", "--version"), (page, name)
        if name in COMMANDS and name not in ("train", "config"):  # the words of these two are Hydra's
            options = {word.split("=")[0] for word in words if word.startswith("--")} - {"--help"}
            before = words[: 2 if words[:1] == ["public"] else 1]
            text = _help(name, *(before if name == "prepare" and before != ["STAGE"] else ()))
            missing = {option for option in options if not re.search(rf"(?<![\w-]){option}(?![\w-])", text)}
            assert not missing, (page, name, missing)


def _composed(argv: list[str]) -> None:
    from omegaconf import OmegaConf

    from gausim.compose.command import jobs_of
    from gausim.compose.config import compose
    from gausim.compose.root import options

    known = options("data")
    asked = [word for word in argv if word not in ("-m", "--cfg", "job")]
    asked = ["data=object" if w.startswith("data=") and not set(w[5:].split(",")) <= set(known) else w for w in asked]
    for job in jobs_of(asked):
        _check_arguments(OmegaConf.to_container(compose(job), resolve=True))


def _check_arguments(node: object) -> None:
    """Every key beside a `_target_` is an argument of it."""
    if isinstance(node, dict):
        if "_target_" in node:
            target = pkgutil.resolve_name(node["_target_"])
            inspect.signature(target).bind_partial(**{name: None for name in node if not name.startswith("_")})
        for child in node.values():
            _check_arguments(child)
    elif isinstance(node, list):
        for child in node:
            _check_arguments(child)


@pytest.mark.slow
def test_training_commands_of_the_pages_compose() -> None:
    for _, (name, *words) in _commands():
        if name == "train" and words and not {"--config-dir", "--shell-completion"} & set(words):
            _composed(words)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_scripts_of_the_tables_name_commands_options_and_keys_that_exist(script: Path, tmp_path: Path) -> None:
    stub = '#!/bin/sh\nfor word in "$@"; do printf "%s\\0" "$word"; done >> "$CALLS"; printf "\\n" >> "$CALLS"\n'
    for name in ("gausim", "make", "python"):
        (tmp_path / name).write_text(stub)
        (tmp_path / name).chmod(0o755)
    calls = tmp_path / "calls"
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "CALLS": str(calls)}
    subprocess.run(["bash", str(script)], check=True, cwd=tmp_path, env=environment)
    lines = [line.rstrip("\0").split("\0") for line in calls.read_text().splitlines()]
    assert lines
    for name, *words in lines:
        if name == "train":
            _composed(words)
        elif name in COMMANDS:
            text = _help(name, *words[: 1 if name == "prepare" else 0])
            options = {word.split("=")[0] for word in words if word.startswith("--")}
            assert all(re.search(rf"(?<![\w-]){option}(?![\w-])", text) for option in options), (name, words)


# What stands for something in the pages, and options that make every command small.
RUN = "outputs/mine/seed_0"
STANDS_FOR = {
    "MINE": "data/pudding_soft", "MINE/scene.ply": "data/pudding_soft/scene.ply", "NEW": "data/pudding_soft",
    "RUN": RUN, "RUN2": RUN, "SCENE.ply": "data/pudding_soft/scene.ply", "data=MINE": "data=data/pudding_soft",
    "seed=0,1,2": "seed=0", "push.json": f"{RUN}/simulation/pudding_soft/forces/session.json",
    "outputs/demo/seed_0": RUN, "DIR…": RUN,
}  # fmt: skip
SMALL = {
    "train": ["plan.epochs=1", "plan.repeats=1", "plan.t_max=3", "plan.warm_start.updates=3", "trainer.panel_epochs=0"],
    "reconstruct": ["--kernels", "80", "--iterations", "40"], "view": ["--seconds", "1", "--port", "0"],
    "adapt": ["--epochs", "1", "--overwrite"],
}  # fmt: skip
RUNNABLE = ("README.md", "docs/tutorials/own-object.md", "docs/tutorials/pushing.md", "docs/how-to/export.md",
            "docs/how-to/own-splat.md")  # fmt: skip


@pytest.mark.slow
def test_command_blocks_of_readme_tutorials_and_how_tos_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the pages, on a tiny object; what needs a network, a GPU, films or minutes is left out."""
    from data_prep.synthesize import main as synthesize
    from gausim.cli.main import main

    monkeypatch.chdir(tmp_path)
    tiny = "--quick --objects pudding_soft --sequences 2 --frames 20 --kernels 80 --resolution 32 --workers 1"
    assert synthesize([*tiny.split(), "--out", "data"]) == 0
    done = 0
    for page in RUNNABLE:
        text = (ROOT / page).read_text().replace("\\\n", " ")
        for line in re.findall(r"^ {4}(gausim .*)", text, re.MULTILINE):
            name, *words = [STANDS_FOR.get(word, word) for word in shlex.split(line, comments=True)[1:]]
            if name == "export" and "FORMAT" in words:
                continue
            if name == "train" and Path(RUN, "FINISHED").is_file() and "name=mine" in words:
                continue  # the tutorial repeats README's training
            status = main([name, *words, *SMALL.get(name, [])])
            assert status in ((0, 1) if name in ("verify", "doctor") else (0,)), (page, line)
            done += 1
    assert done > 20
