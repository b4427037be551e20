"""`gausim prepare STAGE` finds the stages in a checkout and in an installed wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from argparse import ArgumentParser
from dataclasses import dataclass
from pathlib import Path

import pytest

import gausim
from data_prep.common.command import Options, add_options, chosen, names, option
from gausim.cli.main import main
from gausim.cli.prepare import STAGES, stages_root
from gausim.core import ConfigError

ROOT = Path(__file__).resolve().parents[2]


def test_every_stage_has_a_command_and_every_command_a_stage() -> None:
    modules = {path.stem for path in (ROOT / "data_prep").glob("*.py")} - {"__init__"}
    assert {*modules, "public"} == set(STAGES) and stages_root() == ROOT


@pytest.mark.parametrize("stage", STAGES)
def test_help_names_the_command(stage: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["prepare", stage, "--help"])
    text = capsys.readouterr().out
    assert f"usage: gausim prepare {stage} " in text and "(None)" not in text


def test_names_may_have_hyphens(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["prepare", "blender-bunny", "--help"])
    assert "--mesh" in capsys.readouterr().out


def test_stages_load_no_torch_before_they_work() -> None:
    code = f"import sys, {', '.join(f'data_prep.{stage}' for stage in STAGES)}; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@dataclass(frozen=True)
class Chosen(Options):
    """Options of every kind."""

    size: tuple[int, int] = option((4, 4), "of a picture", least=1, nargs=2)
    names: tuple[str, ...] = option((), "several", type=names)
    mark: tuple[tuple[str, str], ...] = option((), "repeatable", nargs=2, action="append")
    part: float | None = option(None, "of something", least=0, most=1)
    quick: bool = option(False, "flag")
    hidden: int = 3


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", Chosen()),
        ("--size 2 3 --names a,b --part 0.5 --quick", Chosen((2, 3), ("a", "b"), (), 0.5, True)),
        ("--mark a b --mark c d", Chosen(mark=(["a", "b"], ["c", "d"]))),
        ("--names none", Chosen()),
        ("--part 1.5", "--part: expected 0 to 1, got 1.5"),
        ("--part nan", "--part: expected 0 to 1, got nan"),
        ("--size 2 0", "--size: expected at least 1, got 0"),
    ],
)
def test_options_are_fields(line: str, expected: Chosen | str) -> None:
    parser = ArgumentParser()
    add_options(parser, Chosen)
    arguments = parser.parse_args(line.split())
    if isinstance(expected, str):
        with pytest.raises(ConfigError, match=expected):
            chosen(Chosen, arguments)
    else:
        assert chosen(Chosen, arguments) == expected


def test_the_wheel_has_the_stages_where_the_command_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    targets = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]
    place = tmp_path / "site" / targets["wheel"]["force-include"]["data_prep"]
    monkeypatch.setattr(gausim, "__file__", str(tmp_path / "site" / "gausim" / "__init__.py"))
    with pytest.raises(ConfigError, match="Reinstall gausim"):
        stages_root()
    place.mkdir(parents=True)
    (place / "__init__.py").touch()
    assert stages_root() == place.parent


@pytest.mark.slow
def test_an_installed_wheel_makes_a_set_outside_of_the_checkout(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    built = subprocess.run([*pip, "wheel", "--no-deps", "-w", str(tmp_path), str(ROOT)], capture_output=True, text=True)
    if built.returncode and "No matching distribution found for hatchling" in built.stderr:
        pytest.skip("no package index has hatchling, which builds the wheel")
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("gausim-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(tmp_path / "site"), str(wheel)], check=True)
    (tmp_path / "empty").mkdir()
    command = [sys.executable, "-m", "gausim.cli.main", "prepare", "synthesize", "--quick", "--objects", "pudding_soft"]
    subprocess.run(
        [*command, "--sequences", "1", "--workers", "1", "--out", "set"],
        cwd=tmp_path / "empty", env={**os.environ, "PYTHONPATH": str(tmp_path / "site")}, check=True,
    )  # fmt: skip
    assert (tmp_path / "empty" / "set" / "pudding_soft" / "dataset.json").is_file()
