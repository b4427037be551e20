"""Where numba keeps compiled functions if the installation and the home are read-only."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numba
import pytest

from gausim.kernels.jit import caching


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The temporary folder of the process is another; numba's configuration is as before afterwards."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    yield tmp_path
    monkeypatch.undo()
    numba.config.reload_config()


def nowhere() -> None:
    raise RuntimeError("cannot cache function: no locator available")


def test_usual_places_are_taken_first(temporary: Path) -> None:
    assert caching(lambda: None)
    assert not list(temporary.iterdir())


def test_read_only_places_give_a_private_folder(temporary: Path) -> None:
    assert caching(nowhere)
    (folder,) = temporary.iterdir()
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder) == numba.config.CACHE_DIR
    assert folder.stat().st_mode & 0o077 == 0


def test_a_folder_that_others_could_write_is_not_trusted(temporary: Path, caplog) -> None:
    (temporary / f"gausim-numba-{os.getuid()}").mkdir()
    (temporary / f"gausim-numba-{os.getuid()}").chmod(0o777)
    assert not caching(nowhere)
    assert "NUMBA_CACHE_DIR" in caplog.text


def test_without_any_place_functions_are_compiled_each_time(monkeypatch, temporary: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/proc/none")
    assert not caching(nowhere)
