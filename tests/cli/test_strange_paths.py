"""Every command with a path that is none or closed, or on a full disk: a sentence, status 2, nothing left."""

from __future__ import annotations

import ctypes
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers.toy_object import write_toy_object

from gausim.cli import main as cli
from gausim.cli.prepare import STAGES

SUBJECTS = ("missing", "empty", "file", "binary", "locked")
CALLS = {
    "inspect": ["{}"], "reconstruct": ["{}", "--out", "out.ply"], "verify": ["{}"], "doctor": ["{}"],
    "train": ["data={}"], "adapt": ["{}"], "evaluate": ["{}"], "simulate": ["{}"], "view": ["{}"],
    "export": ["{}", "--format", "html"], "report": ["{}"],
    "prepare ingest": ["{}", "--out", "out"], "prepare poses": ["--images", "{}", "--out", "out"],
    "prepare segment": ["{}", "--backend", "alpha", "--out", "out"],
    "prepare select": ["{}", "--pinned", "below z=0.1", "--out", "out"],
    "prepare assemble": ["{}", "--out", "out"], "prepare pack": ["{}", "--out", "out"],
    "prepare public": ["physdreamer", "{}", "--out", "out", "--cameras", "p0"],
    "prepare blender_bunny": ["--mesh", "{}", "--out", "out", "--blender-python", sys.executable],
    "prepare poses --colmap": ["--colmap", "{}", "--images", "empty", "--out", "out"],
    "prepare poses --transforms": ["--transforms", "{}", "--out", "out"],
}  # fmt: skip
# What commands write; the scene, the object, the run.
WRITERS = {
    "inspect": ["{scene}", "--out", "{out}/a.png"], "inspect --clean": ["{scene}", "--clean", "{out}/a.ply"],
    "doctor": ["{object}", "--out", "{out}/d"],
    "evaluate": ["{run}", "--out", "{out}/e"], "simulate": ["{run}", "--frames", "2", "--out", "{out}/s"],
    "export": ["{run}", "--format", "html", "--frames", "2", "--out", "{out}/m.html"],
    "report": ["{run}", "--out", "{out}/r"], "prepare pack": ["{object}", "--out", "{out}/p"],
    "prepare select": ["{scene}", "--pinned", "below z=0.1", "--out", "{out}/q"],
    "prepare segment": ["{stills}", "--backend", "alpha", "--out", "{out}/g"],
    "train": ["data={object}", "output_root={out}"],
}  # fmt: skip


@contextmanager
def without_privileges() -> Iterator[None]:
    """Permissions of files hold for this thread even if root runs the tests."""
    libc, header, data = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    assert libc.capget(header, data) == 0
    held = data[0]
    data[0] &= ~0b110  # CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH
    assert libc.capset(header, data) == 0
    try:
        yield
    finally:
        data[0] = held
        assert libc.capset(header, data) == 0


@contextmanager
def full_disk() -> Iterator[None]:
    """No file can grow, as on a disk without room."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def status_of(name: str, words: list[str]) -> int:
    parts = name.split()
    try:
        return cli.main([*(part for part in parts if not part.startswith("--")), *words])
    except SystemExit as error:  # of argparse
        return int(error.code or 0)


def test_every_command_and_stage_is_tried() -> None:
    stages = {f"prepare {stage}" for stage in STAGES} - {"prepare synthesize", "prepare lpips"}  # they read nothing
    assert set(CALLS) >= set(cli.COMMANDS) - {"prepare"} | stages


@pytest.mark.parametrize("subject", SUBJECTS)
@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_input_is_refused_in_a_sentence(name: str, subject: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GAUSIM_DEBUG", raising=False)
    (tmp_path / "empty").mkdir()
    (tmp_path / "locked").mkdir(mode=0)
    (tmp_path / "file").write_text("text\n")
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with without_privileges():
        status = status_of(name, [word.format(subject) for word in CALLS[name]])
    (tmp_path / "locked").chmod(0o700)
    shown = capsys.readouterr().err
    assert status == 2 and subject in shown and "Traceback" not in shown, shown
    left = {path.name for path in tmp_path.iterdir()} - {"outputs"}
    assert left == {"binary", "empty", "file", "locked"}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory, toy_run: Path) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("given")
    toy = write_toy_object(root / "object").root
    return {"scene": toy / "scene.ply", "object": toy, "run": toy_run, "stills": toy / "sequences"}


@pytest.mark.parametrize("disk", ["locked", "full", "in a file"])
@pytest.mark.parametrize("name", WRITERS)
def test_what_cannot_be_written_is_named(name: str, disk: str, given, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GAUSIM_DEBUG", raising=False)
    out = tmp_path / "out"
    out.mkdir(mode=0o500 if disk == "locked" else 0o700)
    if disk == "in a file":
        out.rmdir()
        out.write_text("")
    words = [word.format(out=out, **given) for word in WRITERS[name]]
    with full_disk() if disk == "full" else without_privileges():
        status = status_of(name, words)
    shown = capsys.readouterr().err
    assert status == 2 and str(out) in shown and "Traceback" not in shown, shown
    assert shown.strip().splitlines()[-1].startswith("error: ")
    if disk == "in a file":
        assert out.read_text() == ""
    else:
        out.chmod(0o700)
        assert [path for path in out.rglob("*") if path.is_file()] == []
