"""Stages of data preparation: commands, options, and results that are whole or not at all."""

from __future__ import annotations  # options are read from annotations as texts

import json
import os
import subprocess
import sys
from argparse import ArgumentParser
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from data_prep.common.command import Options, add_options, chosen, names, option
from data_prep.common.stage import MANIFEST, Stage, read_manifest, run_stage
from gausim.cli.prepare import STAGES, stages_root
from gausim.core import ConfigError, DataError
from gausim.io.files import write_durably

ROOT = Path(__file__).resolve().parents[2]


def test_every_stage_has_a_command_and_loads_no_torch_before_it_works() -> None:
    modules = {path.stem for path in (ROOT / "data_prep").glob("*.py")} - {"__init__"}
    assert {*modules, "public"} == set(STAGES) and stages_root() == ROOT
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


@pytest.mark.parametrize(("line", "expected"), [
    ("", Chosen()),
    ("--size 2 3 --names a,b --part 0.5 --quick", Chosen((2, 3), ("a", "b"), (), 0.5, True)),
    ("--mark a b --mark c d", Chosen(mark=(["a", "b"], ["c", "d"]))),
    ("--names none", Chosen()),
    ("--part 1.5", "--part: expected 0 to 1, got 1.5"),
    ("--part nan", "--part: expected 0 to 1, got nan"),
    ("--size 2 0", "--size: expected at least 1, got 0"),
])  # fmt: skip
def test_options_are_fields(line: str, expected: Chosen | str) -> None:
    parser = ArgumentParser()
    add_options(parser, Chosen)
    arguments = parser.parse_args(line.split())
    if isinstance(expected, str):
        with pytest.raises(ConfigError, match=expected):
            chosen(Chosen, arguments)
    else:
        assert chosen(Chosen, arguments) == expected


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


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    film = tmp_path / "film.bin"
    film.write_bytes(b"frames")
    return Stage("ingest", 1, {"film": film}, {"rate": 24, "names": ("a", "b")}, packages=("numpy", "no-such-package"))


def make(work: Path) -> dict[str, Any]:
    write_durably(work / "a.txt", b"made")
    return {"frames": 6}


def test_result_carries_what_it_was_made_of(stage: Stage, tmp_path: Path) -> None:
    manifest = run_stage(stage, tmp_path / "out", make)
    stored = read_manifest(tmp_path / "out", "ingest")
    assert manifest == {**stored, "made": True}
    assert stored["results"] == {"frames": 6} and stored["settings"] == {"rate": 24, "names": ["a", "b"]}
    assert stored["inputs"]["film"]["bytes"] == 6 and len(stored["inputs"]["film"]["sha256"]) == 64
    assert stored["versions"]["no-such-package"] == "absent" and stored["versions"]["numpy"][0].isdigit()
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.txt", MANIFEST]


@pytest.mark.parametrize("change", ["input", "setting", "revision"])
def test_another_result_is_replaced_only_by_force(stage: Stage, tmp_path: Path, change: str) -> None:
    run_stage(stage, tmp_path / "out", make)
    if change == "input":
        stage.inputs["film"].write_bytes(b"other!")
    other = Stage("ingest", 2 if change == "revision" else 1, stage.inputs,
                  {"rate": 25} if change == "setting" else stage.settings)  # fmt: skip
    with pytest.raises(DataError, match="--overwrite"):
        run_stage(other, tmp_path / "out", make)
    assert read_manifest(tmp_path / "out")["results"] == {"frames": 6}
    assert run_stage(other, tmp_path / "out", lambda work: {"frames": 7}, overwrite=True)["results"] == {"frames": 7}
    assert not (tmp_path / "out" / "a.txt").exists()


@pytest.mark.parametrize("same", [True, False])
def test_interrupted_work_goes_on_with_the_same_settings_alone(stage: Stage, tmp_path: Path, same: bool) -> None:
    def fail(work: Path) -> dict[str, Any]:
        write_durably(work / "first", b"1")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_stage(stage, tmp_path / "out", fail)
    assert not (tmp_path / "out").exists()
    again = stage if same else Stage("ingest", 1, stage.inputs, {"rate": 25})
    run_stage(again, tmp_path / "out", lambda work: {})
    assert (tmp_path / "out" / "first").is_file() == same


def test_strangers_are_not_touched(stage: Stage, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    for overwrite in (False, True):
        with pytest.raises(DataError, match="not the result of a stage"):
            run_stage(stage, tmp_path / "out", make, overwrite=overwrite)
    assert (tmp_path / "out" / "thesis.tex").read_text() == "x"


def test_missing_inputs_and_broken_manifests_are_named(stage: Stage, tmp_path: Path) -> None:
    stage.inputs["film"].unlink()
    with pytest.raises(DataError, match=r"film\.bin: not found"):
        run_stage(stage, tmp_path / "out", make)
    with pytest.raises(DataError, match=r"stage\.json: not found"):
        read_manifest(tmp_path)
    for text, what in (("{", "not the manifest"), ("[]", "not the manifest"), (json.dumps({"stage": "x"}), "expected")):
        (tmp_path / MANIFEST).write_text(text)
        with pytest.raises(DataError, match=what):
            read_manifest(tmp_path, "ingest")
