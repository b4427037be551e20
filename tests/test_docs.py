"""The documentation names pages, commands and options that exist."""

from __future__ import annotations

import contextlib
import io
import pkgutil
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from gausim.cli.main import COMMANDS
from gausim.cli.main import command as command_of

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
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


def test_modules_and_functions_named_in_the_pages_exist() -> None:
    named = {name for page in PAGES for name in re.findall(r"`(gausim(?:\.\w+)+)(?:\(|`)", page.read_text())}
    assert len(named) > 5
    for name in named:
        assert pkgutil.resolve_name(name) is not None


def test_pages_named_in_code_and_configurations_exist() -> None:
    named = set()
    for entry in (ROOT / name for name in NAMES_PAGES):
        for path in entry.rglob("*") if entry.is_dir() else [entry]:
            if path.suffix in (".py", ".yaml", ".toml", ".md", ".cpu", ".cuda", "") and path.is_file():
                named |= {(path, page) for page in re.findall(r"\b(?:docs|research)/[\w./-]+\.md", path.read_text())}
    assert len(named) > 10
    assert not {(str(path), page) for path, page in named if not (ROOT / page).is_file()}


@pytest.mark.slow
def test_training_commands_of_the_pages_compose() -> None:
    from gausim.compose.command import jobs_of
    from gausim.compose.config import compose
    from gausim.compose.root import options

    known = options("data")
    for page, (name, *words) in _commands():
        if page == "docs/results.md":  # its commands are those of the commit that each record names
            continue
        if name == "train" and words and not {"--config-dir", "--shell-completion"} & set(words):
            asked = [word for word in words if word not in ("-m", "--cfg", "job")]
            asked = ["data=object" if w.startswith("data=") and w[5:] not in known else w for w in asked]
            for job in jobs_of(asked):
                compose(job)
