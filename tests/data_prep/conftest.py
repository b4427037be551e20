"""Small samples of public sets, written once; tests that damage them mend them again."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
from helpers import public_sets

WRITERS: dict[str, tuple[Callable[..., Any], str]] = {
    "springgaus": (public_sets.write_springgaus, "render/torus"),
    "real": (public_sets.write_springgaus_real, "real_capture"),
    "pacnerf": (public_sets.write_pacnerf, "data/bird"),
    "phystwin": (public_sets.write_phystwin, "different_types/double_stretch_sloth"),
    "genesis": (public_sets.write_3dgsim, "genesis/dog"),
    "physdreamer": (public_sets.write_physdreamer, "physics_dreamer/hat"),
}


@pytest.fixture(scope="session")
def sample_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """The sample of a public set by its name, and the truth about it."""
    folder = tmp_path_factory.mktemp("public")

    @cache
    def written(name: str) -> Any:
        write, place = WRITERS[name]
        return write(folder / place)

    return written
