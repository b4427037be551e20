from __future__ import annotations

import ast
import importlib.util
import sys
import types
from pathlib import Path

import pytest

from gausim.cli import main as cli
from gausim.core.errors import SceneError


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch):
    """Puts a sub-command `fake` into the table that runs the given function."""

    def install(function) -> None:
        module = types.ModuleType("gausim_fake_command")
        module.main = function
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(cli.COMMANDS, "fake", cli.Command(module.__name__, "A command for the tests."))

    monkeypatch.delenv("GAUSIM_DEBUG", raising=False)
    return install


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name, entry in cli.COMMANDS.items():
        assert name in shown
        assert entry.help in shown


def test_no_command_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: gausim" in capsys.readouterr().err


def test_unknown_command_suggests_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trian"]) == 2
    assert "Did you mean 'train'?" in capsys.readouterr().err


def test_unknown_command_unlike_any_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["xyzzy"]) == 2
    shown = capsys.readouterr().err
    assert all(name in shown for name in cli.COMMANDS)


def test_arguments_and_status_pass_through(command) -> None:
    seen: list[str] = []
    command(lambda argv: seen.extend(argv) or 7)
    assert cli.main(["fake", "--size", "3"]) == 7
    assert seen == ["--size", "3"]


def test_our_errors_are_one_line_without_traceback(command, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(argv: list[str]) -> int:
        raise SceneError("rose.ply: expected 3 values, got 2. Export it again.")

    command(fail)
    assert cli.main(["fake"]) == 2
    assert capsys.readouterr().err == "error: rose.ply: expected 3 values, got 2. Export it again.\n"


def test_debug_shows_where_our_errors_come_from(command, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(argv: list[str]) -> int:
        raise SceneError("broken")

    command(fail)
    monkeypatch.setenv("GAUSIM_DEBUG", "1")
    with pytest.raises(SceneError, match="broken"):
        cli.main(["fake"])


def test_defects_keep_their_traceback(command) -> None:
    def fail(argv: list[str]) -> int:
        raise ZeroDivisionError("a defect")

    command(fail)
    with pytest.raises(ZeroDivisionError):
        cli.main(["fake"])


def test_interrupt_has_the_shells_status(command) -> None:
    def interrupt(argv: list[str]) -> int:
        raise KeyboardInterrupt

    command(interrupt)
    assert cli.main(["fake"]) == 130


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_table_agrees_with_the_modules(name: str) -> None:
    """Reads the source instead of importing it: some commands import half the world."""
    spec = importlib.util.find_spec(cli.COMMANDS[name].module)
    assert spec is not None, f"{cli.COMMANDS[name].module} does not exist"
    tree = ast.parse(Path(str(spec.origin)).read_text())
    values = {}
    for node in tree.body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name) and isinstance(node, ast.Assign | ast.AnnAssign):
            values[target.id] = node.value
    assert ast.literal_eval(values["HELP"]) == cli.COMMANDS[name].help
    assert any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in tree.body)
