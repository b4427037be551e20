"""What every test shares: run-time checks of shapes and types, one thread, and the external data set."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
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
def trainings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Trainings]:
    """Runs of `gausim train` in processes of their own, on a toy object."""
    from helpers.toy_runs import trainings  # not before the checks of types are installed

    base = tmp_path_factory.getbasetemp()
    with trainings((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "toy_runs") as made:
        yield made


@pytest.fixture(scope="session")
def toy_run(trainings: Trainings) -> Path:
    """The directory of a finished run of three epochs, for all tests that need one; not to be changed."""
    return trainings.whole("whole", "trainer=cpu", "trainer.max_epochs=3")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
