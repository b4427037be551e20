"""Small samples of public sets, written once; tests that damage them mend them again."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import public_sets
from helpers.public_sets import Sample


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("public")


@pytest.fixture(scope="session")
def springgaus(folder: Path) -> Sample:
    return public_sets.write_springgaus(folder / "render" / "torus")


@pytest.fixture(scope="session")
def real(folder: Path) -> Sample:
    return public_sets.write_springgaus_real(folder / "real_capture")


@pytest.fixture(scope="session")
def pacnerf(folder: Path) -> Sample:
    return public_sets.write_pacnerf(folder / "data" / "bird")


@pytest.fixture(scope="session")
def phystwin(folder: Path) -> Sample:
    return public_sets.write_phystwin(folder / "different_types" / "double_stretch_sloth")


@pytest.fixture(scope="session")
def genesis(folder: Path) -> Sample:
    return public_sets.write_3dgsim(folder / "genesis" / "dog")


@pytest.fixture(scope="session")
def physdreamer(folder: Path) -> Path:
    return public_sets.write_physdreamer(folder / "physics_dreamer" / "hat").root
