from pathlib import Path

import pytest
from helpers.blob import make_object


@pytest.fixture(scope="session")
def blob(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One object, not to be changed."""
    return make_object(tmp_path_factory.mktemp("data") / "blob")


@pytest.fixture
def spoilt(tmp_path: Path) -> Path:
    """One object of one sequence, to be spoilt."""
    return make_object(tmp_path / "blob", sequences=1)
