from pathlib import Path

import pytest
from helpers.report_runs import write_sweep


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """See :func:`write_sweep`; a test may change it."""
    return write_sweep(tmp_path / "sweep")
