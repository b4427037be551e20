"""The notebooks as they lie in the repository; `make test-notebooks` executes them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(path: Path, kind: str) -> list[dict]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def text(path: Path) -> str:
    return "\n".join("".join(cell["source"]) for kind in ("markdown", "code") for cell in cells(path, kind))


def test_the_four_are_there() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["01_quickstart", "02_physics", "03_ablation_report", "04_forces"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped_any_environment_has_the_kernel_and_named_files_exist(path: Path) -> None:
    for cell in cells(path, "code"):
        assert cell["outputs"] == [] and cell["execution_count"] is None, f"{path.name}: run nbstripout"
        assert "execution" not in cell["metadata"]
    assert json.loads(path.read_text())["metadata"]["kernelspec"]["name"] == "python3"
    named = re.findall(r"`((?:docs|notebooks|conf)/[\w./-]+|README\.md)`", text(path))
    assert named, f"{path.name} points nowhere"
    for name in named:
        assert (ROOT / name).exists(), f"{path.name} names {name}, which is not there"
