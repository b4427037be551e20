"""What every test shares: run-time checks of shapes and types, one thread, and the external data set."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest
import torch
from helpers.shared import Shared
from jaxtyping import _import_hook, install_import_hook

if TYPE_CHECKING:
    from helpers.toy_runs import Trainings

torch.set_num_threads(1)
# Tables must not depend on whether this machine happens to have the weights of LPIPS.
os.environ["GAUSIM_LPIPS_WEIGHTS"] = os.devnull


def _left_unchecked(decorator: ast.AST, *, marked=_import_hook._is_no_type_check) -> bool:
    """numba and Warp cannot compile a function that the checker has wrapped, so their kernels go unchecked."""
    names = {node.id for node in ast.walk(decorator) if isinstance(node, ast.Name)}
    names |= {node.attr for node in ast.walk(decorator) if isinstance(node, ast.Attribute)}
    return marked(decorator) or bool(names & {"njit", "jit", "vectorize", "guvectorize", "wp"} and "torch" not in names)


# `make test-types` sets it: the checks double the time of the suite.
if os.environ.get("GAUSIM_CHECK_TYPES"):
    _import_hook._is_no_type_check = _left_unchecked
    # Before anything imports gausim: every annotated signature, shapes included, is checked in every test. An int is a
    # float as it is to mypy (PEP 484), or `lr: 1` in a configuration would fail under test and nowhere else.
    install_import_hook("gausim", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")


@pytest.fixture(scope="session")
def data_root() -> Path:
    """Directory that holds external data sets, one folder each (e.g. bunny)."""
    value = os.environ.get("GAUSIM_TEST_DATA")
    if not value:
        pytest.skip("GAUSIM_TEST_DATA is not set: it names the directory of the external data sets")
    path = Path(value)
    if not path.is_dir():
        pytest.fail(f"GAUSIM_TEST_DATA: expected a directory, got {path}. Correct or unset it.")
    return path


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    """Makes a folder once for all processes of the session: ``shared("name", function that writes it)``."""
    base = tmp_path_factory.getbasetemp()
    return Shared((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared")


@pytest.fixture(scope="session")
def toy(shared: Shared) -> Path:
    """The toy object on disk: 36 kernels, two sequences of 20 frames (8 seen), three views of 32 x 32 pixels."""
    from helpers.toy_object import write_toy_object  # not before the checks of types are installed

    return shared("toy", write_toy_object)


@pytest.fixture(scope="session")
def trainings(shared: Shared) -> Iterator[Trainings]:
    """Runs of `gausim train` on the toy object, in processes of their own."""
    from helpers.toy_runs import Trainings

    with Trainings(shared) as made:
        yield made


@pytest.fixture(scope="session")
def toy_run(trainings: Trainings) -> Path:
    """The directory of a finished run of three epochs on a toy of three sequences; not to be changed."""
    return trainings.whole("whole", "trainer=cpu", "plan.epochs=3")


@pytest.fixture(scope="session")
def quick_evaluations() -> Iterator[None]:
    """Collecting garbage before the memory is counted takes most of a prediction."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gausim.runs.cost._begin", lambda cuda: None)
        yield


@pytest.fixture(scope="session")
def _played(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    from helpers.played import played_run

    return played_run(tmp_path_factory.mktemp("played"))


@pytest.fixture
def played(_played: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A run that was never trained, which is what loading any run gives; not to be changed."""
    # All who name it at their top are imported before it is replaced at home.
    names = ("cli.simulate_run", "cli.evaluate_run", "api", "compose.build")
    for home in names:
        monkeypatch.setattr(f"gausim.{home}.load_run", lambda path, **_: _played)
    return _played


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: "browser" not in item.path.name)  # the longest first, or one process waits for another
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
