import errno
import importlib.util
import os
import subprocess
import sys
import types

import pytest

from gausim.cli import main as cli
from gausim.core.errors import SceneError


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch):
    """Puts a sub-command `fake` into the table that runs the given function."""

    def install(function) -> None:
        module = types.ModuleType("gausim.cli.fake")
        module.main = function
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(cli.COMMANDS, "fake", "A command for the tests.")

    monkeypatch.delenv("GAUSIM_DEBUG", raising=False)
    return install


def raising(error: BaseException):
    def fail(argv: list[str]) -> int:
        raise error

    return fail


def test_help_names_every_command_and_each_has_a_module(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name, line in cli.COMMANDS.items():
        assert name in shown and line in shown and importlib.util.find_spec(f"gausim.cli.{name}") is not None


@pytest.mark.parametrize(
    ("argv", "told"),
    [([], "usage: gausim"), (["trian"], "Did you mean 'train'?"), (["xyzzy"], ", ".join(cli.COMMANDS))],
)
def test_what_is_no_command_is_wrong_usage(argv, told, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(argv) == 2
    assert told in capsys.readouterr().err


def test_our_errors_are_one_line_without_traceback(command, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    command(raising(SceneError("rose.ply: expected 3 values, got 2. Export it again.")))
    assert cli.main(["fake"]) == 2
    assert capsys.readouterr().err == "error: rose.ply: expected 3 values, got 2. Export it again.\n"
    monkeypatch.setenv("GAUSIM_DEBUG", "1")
    with pytest.raises(SceneError, match="rose"):
        cli.main(["fake"])


def test_defects_keep_their_traceback_and_an_interrupt_has_the_shells_status(command) -> None:
    command(raising(ZeroDivisionError("a defect")))
    with pytest.raises(ZeroDivisionError):
        cli.main(["fake"])
    command(raising(KeyboardInterrupt()))
    assert cli.main(["fake"]) == 130

    def interrupted(argv: list[str]) -> int:  # as Lightning does
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            sys.exit(1)

    command(interrupted)
    assert cli.main(["fake"]) == 130
    command(raising(SystemExit(3)))
    with pytest.raises(SystemExit):
        cli.main(["fake"])


@pytest.mark.parametrize(("error", "told"), [
    (OSError(errno.ENOSPC, "No space left on device", "out/a.png"), "out/a.png: No space left on device. Make room"),
    (PermissionError(errno.EACCES, "Permission denied", "/locked"), "/locked: Permission denied. Correct the perm"),
    (OSError(errno.EROFS, "Read-only file system", "a", None, "b"), "a -> b: Read-only file system. The disk is"),
    (OSError(errno.ENOENT, "No such file", "/proc/.a.png.77.tmp.png"), "error: /proc/a.png: No such file. Check"),
    (OSError(errno.ENOSPC, "No space left on device"), "error: No space left on device. Make room"),
    (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "Save the file as UTF-8"),
    (ValueError("two\nlines"), "two lines (ValueError). GAUSIM_DEBUG=1"),
])  # fmt: skip
def test_errors_of_files_and_values_are_one_line(command, capsys, error: Exception, told: str) -> None:
    command(raising(error))
    assert cli.main(["fake"]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("error: ") and told in shown and shown.count("\n") == 1


def test_text_that_the_terminal_lacks_is_escaped() -> None:
    code = "import sys; sys.modules['gausim.cli.report'] = m = type(sys)('x'); "
    code += "m.main = lambda argv: print('a \\u2026 b \\u2013') or 0; "
    code += "from gausim.cli.main import main; main(['report'])"
    environment = {**os.environ, "PYTHONIOENCODING": "cp437"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    assert done.stdout.strip() == b"a \\u2026 b \\u2013"
