"""Small samples of public sets, written once; tests that damage them mend them again."""

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
from helpers.public_sets import WRITERS


@pytest.fixture(scope="session")
def sample_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """The sample of a public set by its kind, and the truth about it."""
    folder = tmp_path_factory.mktemp("public")

    @cache
    def written(kind: str) -> Any:
        write, place = WRITERS[kind]
        return write(folder / place)

    return written
